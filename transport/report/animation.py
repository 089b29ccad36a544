"""Animation of a run as GIF or MP4: the team in space and from above, cost and attitude so far."""

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
from matplotlib.ticker import MaxNLocator
from PIL import Image
from rich.console import Console
from rich.progress import track

from model.arrays import Array
from protocol.wire.errors import TransportError
from transport.analysis.series import Series, series_of
from transport.log.run_folder import open_run
from transport.report.figures_3d import draw_parts, frame, line
from transport.report.style import COMPONENTS, RC, REFERENCE, scale_cost, shade_phases
from transport.scene.drawing import UAV_COLOURS, Drawing, age_colour
from transport.scene.scene import Scene, SceneBuilder

KINDS = (".gif", ".mp4")
# Frames per second; length of the animation of a run, whatever its duration, s.
FPS, LENGTH_S = 10.0, 6.0
# Palette of a GIF: the colours used, each in several shades towards white for the edges of lines.
_INKS = ("#000000", "#555555", REFERENCE, *UAV_COLOURS, *COMPONENTS[1:])
_SHADES = (1.0, 0.8, 0.6, 0.4, 0.2)
_DPI = 100
_SIZE_IN = (7.2, 4.4)
_UP = np.array([1.0, 1.0, -1.0])
_FADED = "#d0d0d0"
_DECADES = 4
_GREYS = (1.0, 0.95, 0.9, 0.85, 0.7)


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
        self._setup, self._series = builder.setup, series
        self.figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
        self._space: Any = self.figure.add_axes((-0.04, 0.0, 0.58, 0.95), projection="3d")
        self._above = self.figure.add_axes((0.54, 0.42, 0.44, 0.47))
        self._cost, self._attitude = (self.figure.add_axes((0.62, y, 0.36, 0.11)) for y in (0.25, 0.10))
        self._moving: list[Any] = []
        self._drawing = Drawing(builder)
        self._reach_m = float(np.ptp(builder.start_I[:, :2], axis=0).max(initial=0.0)) / 2.0 + 0.4
        self._draw_fixed_parts()

    def show(self, scene: Scene) -> None:
        """Draw a scene in place of the previous one."""
        for artist in self._moving:
            artist.remove()
        self._moving = []
        row = int(np.searchsorted(self._series.ticks, scene.tick))
        poses, parts = self._drawing.poses(scene), [*self._drawing.fixed, *self._drawing.moving(scene)]
        for axes in (self._space, self._above):
            above = axes is self._above
            hidden = ("reference", *(("actual paths", "thrust") if above else ("links",)))
            shown = [part for part in parts if part.layer not in hidden]
            self._moving += draw_parts(axes, shown, poses, above=above, width=0.45)
        centre = scene.uavs_I[:, :2].mean(axis=0)
        # z points away from the viewer, so y points down.
        self._above.set_xlim(centre[0] - self._reach_m * 1.9, centre[0] + self._reach_m * 1.9)
        self._above.set_ylim(centre[1] + self._reach_m, centre[1] - self._reach_m)
        series, until = self._series, slice(0, row + 1)
        t = series.times_s[until]
        self._moving += self._cost.plot(t, _shown_cost(series)[until], color="#000000", linewidth=1.2)
        for column, colour in enumerate(COMPONENTS):
            self._moving += self._attitude.plot(t, series.attitude_deg[until, column], color=colour, linewidth=1.2)
        text = f"{scene.time_s:5.2f} s   {scene.phase}"
        self._moving.append(self.figure.text(0.03, 0.94, text, fontsize=10.0, family="monospace", weight="bold"))

    def _draw_fixed_parts(self) -> None:
        setup, series, space = self._setup, self._series, self._space
        line(space, series.payload_reference_I, color=REFERENCE, linewidth=0.8, linestyle="--")
        frame(space, np.concatenate([series.uavs_I.reshape(-1, 3), series.x[:, :3]]) * _UP, zoom=0.85)
        space.view_init(elev=20.0, azim=-62.0)
        space.tick_params(labelsize=7.0, pad=-2.0)
        for name in ("xlabel", "ylabel", "zlabel"):
            getattr(space, f"set_{name}")("")
        space.yaxis.set_major_locator(MaxNLocator(2))
        self.figure.text(0.03, 0.03, "x, y, altitude in m", fontsize=7.0)
        above = self._above
        above.set_aspect("equal")
        above.set_title(
            "from above, with predicted paths\nlinks grey: fresh, orange: delayed, black: no plan", fontsize=7.5
        )
        above.set_xticks([])
        above.set_yticks([])
        for name in ("top", "right"):
            above.spines[name].set_visible(True)
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
        shade_phases(setup, [self._cost, self._attitude], float(series.times_s[-1]) + 1e-9, named=False)
        self._cost.plot(series.times_s, _shown_cost(series), color=_FADED, linewidth=0.8)
        self._attitude.plot(series.times_s, series.attitude_deg, color=_FADED, linewidth=0.8)


def _shown_cost(series: Series) -> Array:
    """Return the cost without zeros, which a logarithmic axis does not have."""
    return np.where(series.cost > 0.0, series.cost, np.nan)


def _write_gif(frames: Iterator[Figure], out: Path) -> None:
    # With one palette for all frames, pixels that do not change take no bytes.
    palette = Image.new("P", (1, 1))
    ages = [np.divide(age_colour(age_s, 0.0), 255.0) for age_s in (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)]
    inks = [*(to_rgb(ink) for ink in _INKS), *ages]
    faded = [1.0 - share * (1.0 - np.asarray(ink)) for ink in inks for share in _SHADES]
    colours = np.round(255.0 * np.vstack([*(np.full(3, grey) for grey in _GREYS), *faded]))
    palette.putpalette(colours.astype(int).reshape(-1).tolist())
    images = []
    for figure in frames:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
        images.append(Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE))
    images[0].save(
        out, save_all=True, append_images=images[1:], duration=round(1e3 / FPS), loop=0, optimize=True, disposal=1
    )


def _write_mp4(frames: Iterator[Figure], out: Path) -> None:
    writer = FFMpegWriter(fps=FPS, codec="libx264", extra_args=["-pix_fmt", "yuv420p"])  # type: ignore[arg-type]
    first = next(frames)
    with writer.saving(first, str(out), _DPI):
        writer.grab_frame()
        for _ in frames:
            writer.grab_frame()
