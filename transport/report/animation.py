"""Animation of a run as GIF or MP4."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console
from rich.progress import track

from model.arrays import Array
from transport.analysis.series import Series, series_of
from transport.log.run_folder import open_run
from transport.report.animation_page import DPI, AnimationPage
from transport.report.style import COMPONENTS, RC, REFERENCE
from transport.scene.colours import UAV_COLOURS
from transport.scene.geometry import age_colour
from transport.scene.scene import SceneBuilder

KINDS = (".gif", ".mp4")
# Frames per second; length of the animation of a run, whatever its duration, s.
FPS, LENGTH_S = 10.0, 6.0
# Palette of a GIF: the colours used, each in several shades towards white for the edges of lines.
_INKS = ("#000000", "#555555", REFERENCE, *UAV_COLOURS, *COMPONENTS[1:])
_SHADES = (1.0, 0.8, 0.6, 0.4, 0.2)
_GREYS = (1.0, 0.95, 0.9, 0.85, 0.7)


class AnimationError(RuntimeError):
    """The animation cannot be made; the text says what is needed."""


def check_animation(out: Path | None) -> None:
    """Raise AnimationError if the file to write, if any, is neither GIF nor MP4, or is an MP4 without ffmpeg."""
    if out is not None and out.suffix not in KINDS:
        raise AnimationError(f"expected a file that ends in {' or '.join(KINDS)}, got {out}")
    if out is not None and out.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise AnimationError("an MP4 needs ffmpeg, which is not installed; a .gif does not")


def animate_run(folder: Path, out: Path) -> Path:
    """Animate the run in a folder as a .gif or .mp4 file, with a progress bar on a terminal; return the file.

    Raises: AnimationError: another kind of file, an MP4 without ffmpeg; LogError: no state to draw.
    """
    run = open_run(folder)
    return animate(SceneBuilder.of(run.setup, run.log), series_of(run.setup, run.log), out)


def animate(builder: SceneBuilder, series: Series, out: Path, *, speed: float | None = None) -> Path:
    """Animate a run of at least one tick as far as its log goes; return the file.

    It takes `LENGTH_S`, or as given a multiple of real time.

    Raises: AnimationError: another kind of file, or an MP4 without ffmpeg.
    """
    check_animation(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    period_s = builder.setup.settings.sampling_period_s
    speed = speed or max(1.0, len(series.ticks) * period_s / LENGTH_S)
    ticks = np.arange(series.ticks[0], series.ticks[-1] + 1, speed / FPS / period_s)
    shown = list(dict.fromkeys(builder.history.nearest(round(tick)) for tick in ticks))

    def frames() -> Iterator[Figure]:
        with mpl.rc_context(RC):
            page = AnimationPage(builder, series)
            for tick in track(shown, "animation", console=Console(stderr=True), transient=True):
                page.show(builder.at(tick))
                yield page.figure

    (_write_gif if out.suffix == ".gif" else _write_mp4)(frames(), out)
    return out


def _write_gif(frames: Iterator[Figure], out: Path) -> None:
    # With one palette for all frames, pixels that do not change take no bytes.
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette().astype(int).reshape(-1).tolist())
    images = [Image.fromarray(_pixels(f)).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    images[0].save(
        out, save_all=True, append_images=images[1:], duration=round(1e3 / FPS), loop=0, optimize=True, disposal=1
    )


def _palette() -> Array:
    """Return the palette of a GIF, (k, 3), 0..255, at most 256 colours."""
    inks = [to_rgb(ink) for ink in _INKS] + [
        np.divide(age_colour(age_s, 0.0), 255.0) for age_s in (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)
    ]
    faded = [1.0 - share * (1.0 - np.asarray(ink)) for ink in inks for share in _SHADES]
    return np.round(255.0 * np.vstack([*(np.full(3, grey) for grey in _GREYS), *faded]))


def _write_mp4(frames: Iterator[Figure], out: Path) -> None:
    writer = FFMpegWriter(fps=FPS, codec="libx264", extra_args=["-pix_fmt", "yuv420p"])  # type: ignore[arg-type]
    first = next(frames)
    with writer.saving(first, str(out), DPI):
        writer.grab_frame()
        for _ in frames:
            writer.grab_frame()


def _pixels(figure: Figure) -> Any:
    """Return the pixels of a figure, (height, width, 3), 0..255."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
