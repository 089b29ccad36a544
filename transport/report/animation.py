"""Animation of a run as GIF or MP4: the team in space and from above, cost and attitude so far."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image
from rich.console import Console
from rich.progress import track

from protocol.wire.errors import TransportError
from transport.analysis.series import Series, series_of
from transport.log.run_log import open_run
from transport.report.figures_3d import UP, draw_parts, frame, line
from transport.report.style import COMPONENTS, RC, REFERENCE, scale_cost, shade_phases
from transport.scene.drawing import Drawing
from transport.scene.scene import Scene, SceneBuilder

KINDS = (".gif", ".mp4")
# Frames per second; length of the animation of a run, whatever its duration, s.
FPS, LENGTH_S = 10.0, 6.0
_DPI = 100
_SIZE_IN = (7.2, 4.4)
_FADED = "#d0d0d0"
_DECADES = 4
# Frames of a GIF whose colours all of its frames have.
_PALETTE = 6
# Values from which a colour is that of the paper.
_PAPER = 246


class AnimationError(TransportError, RuntimeError):
    """The animation cannot be made; the text says what is needed."""


def check_animation(out: Path | None) -> None:
    """Raise AnimationError if the file to write, if any, is neither GIF nor MP4, or is an MP4 without ffmpeg."""
    if out is not None and out.suffix not in KINDS:
        raise AnimationError(f"expected a file that ends in {' or '.join(KINDS)}, got {out}")
    if out is not None and out.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise AnimationError("an MP4 needs ffmpeg, which is not installed; a .gif does not")


def animate_run(folder: Path, out: Path, *, speed: float | None = None) -> Path:
    """Animate the run in a folder as a .gif or .mp4 file, as far as its log goes, with a progress bar on a terminal.

    It takes `LENGTH_S`, or as given a multiple of real time.

    Returns: The file.
    Raises: AnimationError: another kind of file, an MP4 without ffmpeg; LogError: no state to draw.
    """
    check_animation(out)
    run = open_run(folder)
    builder, series = SceneBuilder.of(run.setup, run.log), series_of(run.setup, run.log)
    out.parent.mkdir(parents=True, exist_ok=True)
    period_s = builder.setup.settings.sampling_period_s
    speed = speed or max(1.0, len(series.ticks) * period_s / LENGTH_S)
    ticks = np.arange(series.ticks[0], series.ticks[-1] + 1, speed / FPS / period_s)
    shown = list(dict.fromkeys(builder.history.nearest(round(tick)) for tick in ticks))

    def frames() -> Iterator[Figure]:
        page = AnimationPage(builder, series)
        for tick in track(shown, "animation", console=Console(stderr=True), transient=True):
            page.show(builder.at(tick))
            yield page.figure

    # Not within `frames`: a context that ends inside that of a writer would leave its settings to all later figures.
    with mpl.rc_context(RC):
        (_write_gif if out.suffix == ".gif" else _write_mp4)(frames(), out)
    return out


class AnimationPage:
    """Figure of one run, of at least one tick, whose moving parts are redrawn for every frame."""

    def __init__(self, builder: SceneBuilder, series: Series) -> None:
        self._series, self._drawing = series, Drawing(builder)
        self._cost_shown = np.where(series.cost > 0.0, series.cost, np.nan)  # a logarithmic axis has no zeros
        self._reach_m = float(np.ptp(builder.start_I[:, :2], axis=0).max(initial=0.0)) / 2.0 + 0.4
        self._moving: list[Any] = []
        self.figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
        space: Any = self.figure.add_axes((-0.04, 0.0, 0.58, 0.95), projection="3d")
        self._space, self._above = space, self.figure.add_axes((0.54, 0.42, 0.44, 0.47))
        self._cost, self._attitude = (self.figure.add_axes((0.62, y, 0.36, 0.11)) for y in (0.25, 0.10))
        line(space, series.payload_reference_I, color=REFERENCE, linewidth=0.8, linestyle="--")
        frame(space, np.concatenate([series.uavs_I.reshape(-1, 3), series.x[:, :3]]) * UP, zoom=0.85)
        space.view_init(elev=20.0, azim=-62.0)
        space.tick_params(labelsize=7.0, pad=-2.0)
        space.set(xlabel="", ylabel="", zlabel="")
        space.yaxis.set_major_locator(MaxNLocator(2))
        self.figure.text(0.03, 0.03, "x, y, altitude in m", fontsize=7.0)
        self._above.set(aspect="equal", xticks=[], yticks=[])
        self._above.spines[["top", "right"]].set_visible(True)
        title = "from above, with predicted paths\nlinks grey: fresh, orange: delayed, black: no plan"
        self._above.set_title(title, fontsize=7.5)
        for axes, label in ((self._cost, "cost"), (self._attitude, "attitude\n(deg)")):
            axes.tick_params(labelsize=7.0)
            axes.set_ylabel(label, fontsize=7.5)
        self._cost.tick_params(labelbottom=False)
        scale_cost(self._cost, float(series.cost.max()), _DECADES)
        largest = 1.05 * max(0.05, float(series.attitude_max_deg.max()))
        self._attitude.set_ylim(-largest, largest)
        for k, (name, colour) in enumerate(zip(("roll", "pitch", "yaw"), COMPONENTS, strict=True)):
            at = 0.01 + 0.11 * k, 0.97
            self._attitude.text(*at, name, color=colour, fontsize=7.0, va="top", transform=self._attitude.transAxes)
        self._attitude.set_xlabel("time (s)", fontsize=7.5, labelpad=1.0)
        shade_phases(builder.setup, [self._cost, self._attitude], float(series.times_s[-1]) + 1e-9, named=False)
        self._cost.plot(series.times_s, self._cost_shown, color=_FADED, linewidth=0.8)
        self._attitude.plot(series.times_s, series.attitude_deg, color=_FADED, linewidth=0.8)

    def show(self, scene: Scene) -> None:
        """Draw a scene in place of the previous one."""
        for artist in self._moving:
            artist.remove()
        poses, parts = self._drawing.poses(scene), [*self._drawing.fixed, *self._drawing.moving(scene)]
        in_space = [part for part in parts if part.layer not in ("reference", "links")]
        from_above = [part for part in parts if part.layer not in ("reference", "actual paths", "thrust")]
        self._moving = draw_parts(self._space, in_space, poses, above=False, width=0.45)
        self._moving += draw_parts(self._above, from_above, poses, above=True, width=0.45)
        x, y = scene.uavs_I[:, :2].mean(axis=0)
        # z points away from the viewer, so y points down.
        self._above.set_xlim(x - self._reach_m * 1.9, x + self._reach_m * 1.9)
        self._above.set_ylim(y + self._reach_m, y - self._reach_m)
        until = slice(0, int(np.searchsorted(self._series.ticks, scene.tick)) + 1)
        t = self._series.times_s[until]
        self._moving += self._cost.plot(t, self._cost_shown[until], color="#000000", linewidth=1.2)
        for angles_deg, colour in zip(self._series.attitude_deg.T, COMPONENTS, strict=True):
            self._moving += self._attitude.plot(t, angles_deg[until], color=colour, linewidth=1.2)
        text = f"{scene.time_s:5.2f} s   {scene.phase}"
        self._moving.append(self.figure.text(0.03, 0.94, text, fontsize=10.0, family="monospace", weight="bold"))


def _write_gif(frames: Iterator[Figure], out: Path) -> None:
    images = []
    for figure in frames:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))  # type: ignore[no-untyped-call]
    # With one palette for all frames, pixels that do not change take no bytes.
    some = Image.fromarray(np.vstack([np.asarray(image) for image in images[:: max(1, len(images) // _PALETTE)]]))
    palette = some.quantize(256)
    palette.putpalette([255 if value > _PAPER else value for value in palette.getpalette() or ()])
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(out, save_all=True, append_images=others, duration=round(1e3 / FPS), loop=0, optimize=True, disposal=1)


def _write_mp4(frames: Iterator[Figure], out: Path) -> None:
    writer = FFMpegWriter(fps=FPS, codec="libx264", extra_args=["-pix_fmt", "yuv420p"])  # type: ignore[arg-type]
    first = next(frames)
    with writer.saving(first, str(out), _DPI):
        writer.grab_frame()
        for _ in frames:
            writer.grab_frame()
