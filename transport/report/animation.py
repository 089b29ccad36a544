"""A run as a moving picture: the team in space and from above, cost and attitude, to GIF or MP4."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from model.arrays import Array
from transport.analysis.series import Series, series_of
from transport.log.run_folder import open_run
from transport.report.animation_page import DPI, Page
from transport.report.style import COMPONENTS, RC, REFERENCE
from transport.scene.colours import UAV_COLOURS
from transport.scene.geometry import age_colour
from transport.scene.scene import Scenes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = (".gif", ".mp4")
# Pictures per second, and how much faster than it was flown, by default.
FPS, SPEED = 10.0, 2.0
# Colours of a GIF: those of all that is drawn, and how far they fade into the white paper at the edges of lines.
_INKS = ("#000000", "#555555", REFERENCE, *UAV_COLOURS, *COMPONENTS[1:])
_SHADES = (1.0, 0.8, 0.6, 0.4, 0.2)
_GREYS = (1.0, 0.95, 0.9, 0.85, 0.7)


class AnimationError(RuntimeError):
    """The picture cannot be made; the text says what it takes."""


def check_animation(out: Path | None) -> None:
    """Refuse what cannot be made before anything is done.

    Args:
        out: File to be written, if any.
    Raises: AnimationError: another kind of file, or an MP4 without ffmpeg.
    """
    if out is not None and out.suffix not in KINDS:
        raise AnimationError(f"expected a file that ends in {' or '.join(KINDS)}, got {out}")
    if out is not None and out.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise AnimationError("an MP4 takes ffmpeg, which is not installed; a .gif does not")


def animate_run(folder: Path, out: Path) -> Path:
    """Draw the run in a folder, with a progress bar on a terminal.

    Args:
        folder: Run folder.
        out: File to write, .gif or .mp4.
    Returns: The file.
    Raises: AnimationError: another kind of file, an MP4 without ffmpeg; LogError: no state to draw.
    """
    from rich.console import Console
    from rich.progress import Progress

    run = open_run(folder)
    scenes = Scenes.of(run.setup, run.log)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("animation")

        def progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return animate(scenes, series_of(run.setup, run.log), out, progress=progress)


def animate(
    scenes: Scenes,
    series: Series,
    out: Path,
    *,
    speed: float = SPEED,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Draw a run as far as its log goes.

    Args:
        scenes: Of the run, its whole record read.
        series: Of the same run; at least one tick.
        out: File to write, .gif or .mp4.
        speed: How much faster than it was flown.
        progress: Called with how many pictures are drawn, and of how many.
    Returns: The file.
    Raises: AnimationError: another kind of file, or an MP4 without ffmpeg.
    """
    import matplotlib as mpl

    check_animation(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    period_s = scenes.setup.settings.sampling_period_s
    ticks = np.arange(series.ticks[0], series.ticks[-1] + 1, speed / FPS / period_s)
    shown = list(dict.fromkeys(scenes.record.nearest(round(tick)) for tick in ticks))

    def pictures() -> "Iterator[Figure]":
        with mpl.rc_context(RC):
            page = Page(scenes, series)
            for number, tick in enumerate(shown, start=1):
                page.show(scenes.at(tick))
                yield page.figure
                if progress is not None:
                    progress(number, len(shown))

    (_write_gif if out.suffix == ".gif" else _write_mp4)(pictures(), out)
    return out


def _write_gif(pictures: "Iterator[Figure]", out: Path) -> None:
    from PIL import Image

    # One palette for all: what stands still has the same colours in all of them, and costs nothing.
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette().astype(int).reshape(-1).tolist())
    images = [Image.fromarray(_pixels(f)).quantize(palette=palette, dither=Image.Dither.NONE) for f in pictures]
    images[0].save(
        out, save_all=True, append_images=images[1:], duration=round(1e3 / FPS), loop=0, optimize=True, disposal=1
    )


def _palette() -> Array:
    """Colours of a GIF, (k, 3), 0..255, at most 256."""
    from matplotlib.colors import to_rgb

    inks = [to_rgb(ink) for ink in _INKS] + [
        np.divide(age_colour(age_s), 255.0) for age_s in (0.05, 0.1, 0.2, 0.3, 0.5)
    ]
    faded = [1.0 - share * (1.0 - np.asarray(ink)) for ink in inks for share in _SHADES]
    return np.round(255.0 * np.vstack([*(np.full(3, grey) for grey in _GREYS), *faded]))


def _write_mp4(pictures: "Iterator[Figure]", out: Path) -> None:
    from matplotlib.animation import FFMpegWriter

    writer = FFMpegWriter(fps=FPS, codec="libx264", extra_args=["-pix_fmt", "yuv420p"])  # type: ignore[arg-type]
    first = next(pictures)
    with writer.saving(first, str(out), DPI):
        writer.grab_frame()
        for _ in pictures:
            writer.grab_frame()


def _pixels(figure: "Figure") -> Any:
    """What a figure shows, (height, width, 3), 0..255."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
