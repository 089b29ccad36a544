"""Animation of a run as GIF or MP4: the team in space and from above, cost and attitude so far."""

import shutil
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.progress import track

from transport.analysis.series import Series, series_of
from transport.log.run_folder import open_run
from transport.model.arrays import Array
from transport.model.state import R0
from transport.protocol.wire.errors_and_exit_codes import TransportError
from transport.report.drawing_by_matplotlib import UP, draw_parts, frame, line
from transport.report.figures.style import RC, REFERENCE, scale_cost, shade_phases
from transport.scene.drawn_paths_links_and_thrust import Drawing
from transport.scene.frames_and_poses import poses_in_scene
from transport.scene.scene_at_tick import Scene, SceneBuilder

KINDS = (".gif", ".mp4")
FPS = 10  # frames per second
LENGTH_S = 6.0  # of the animation of a run, whatever its duration
_DPI = 100
_SIZE_IN = (7.2, 4.4)
# Places of the views: left, bottom, width, height in parts of the figure; and of the texts: left, bottom.
_SPACE = (-0.04, 0.0, 0.58, 0.95)
_ABOVE = (0.54, 0.42, 0.44, 0.47)
_COST = (0.62, 0.25, 0.36, 0.11)
_ATTITUDE = (0.62, 0.10, 0.36, 0.11)
_UNITS = (0.03, 0.03)
_TIME = (0.03, 0.94)
_TIME_STYLE: Any = {"fontsize": 10.0, "family": "monospace", "weight": "bold"}
# From where the view in space looks, deg, and its size in parts of its place.
_ELEVATION, _AZIMUTH, _ZOOM = 20.0, -62.0, 0.85
_LEAST_S = 1e-9  # of a run of one tick, which has a length, too
_NOW = "#b2182b"
_DECADES = 4  # of the cost
_WIDTH = 0.45  # of a line, points for a pixel on the screen
_PROPORTION = 1.9  # width of the view from above over its height
_BEYOND_M = 0.5  # seen beyond the middles of payload and UAVs
_NOT_IN_SPACE = ("reference", "links")
_NOT_FROM_ABOVE = ("reference", "actual paths", "thrust")
_PIXELS = ["-pix_fmt", "yuv420p"]  # that every player of MP4 knows


class AnimationError(TransportError, RuntimeError):
    """The animation cannot be made; the text says what is needed."""


def check_animation(out: Path | None) -> None:
    """Raise AnimationError if a file cannot be written.

    It is neither GIF nor MP4, or is an MP4 without ffmpeg. No file is fine.
    """
    if out is None:
        return
    if out.suffix not in KINDS:
        raise AnimationError(f"expected a file that ends in {' or '.join(KINDS)}, got {out}")
    if out.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise AnimationError("an MP4 needs ffmpeg, which is not installed; a .gif does not")


def animate_run(folder: Path, out: Path, *, speed: float | None = None) -> Path:
    """Animate the run in a folder as a .gif or .mp4 file; return the file.

    It takes `LENGTH_S`, or has a speed as a multiple of real time.

    Raises: AnimationError: another kind of file, an MP4 without ffmpeg; LogError: no state to draw.
    """
    check_animation(out)
    run = open_run(folder)
    builder = SceneBuilder.of(run.setup, run.log)
    series = series_of(run.setup, run.log)
    period_s = builder.setup.settings.sampling_period_s
    speed = speed or max(1.0, len(series.ticks) * period_s / LENGTH_S)
    ticks = np.arange(series.ticks[0], series.ticks[-1] + 1, speed / FPS / period_s)
    shown = [builder.history.nearest(round(tick)) for tick in ticks]

    out.parent.mkdir(parents=True, exist_ok=True)
    writer = _writer(out)
    with mpl.rc_context(RC):
        page = AnimationPage(builder, series)
        with writer.saving(page.figure, str(out), _DPI):
            for tick in track(shown, "animation", console=Console(stderr=True), transient=True):
                page.show(builder.at(tick))
                writer.grab_frame()
    return out


def _writer(out: Path) -> Any:
    """Return the writer for a kind of file."""
    if out.suffix == ".gif":
        return PillowWriter(FPS)
    return FFMpegWriter(FPS, "libx264", extra_args=_PIXELS)


class AnimationPage:
    """Figure of one run, of at least one tick, whose moving parts are redrawn for every frame."""

    def __init__(self, builder: SceneBuilder, series: Series) -> None:
        self._drawing = Drawing(builder)
        self._moving: list[Any] = []
        self._reach_m = _reach_m(series)

        self.figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
        self.figure.text(*_UNITS, "x, y, altitude in m")
        self._space: Any = self.figure.add_axes(_SPACE, projection="3d")
        _set_space(self._space, series)
        self.above = self.figure.add_axes(_ABOVE)
        _set_above(self.above)

        cost = self.figure.add_axes(_COST)
        _draw_cost(cost, series)
        attitude = self.figure.add_axes(_ATTITUDE)
        _draw_attitude(attitude, series)
        self._over_time = [cost, attitude]
        end_s = float(series.times_s[-1]) + _LEAST_S
        shade_phases(builder.setup, self._over_time, end_s, named=False)

    def show(self, scene: Scene) -> None:
        """Draw a scene in place of the previous one."""
        for artist in self._moving:
            artist.remove()

        drawing = self._drawing
        poses = poses_in_scene(scene)
        parts = [*drawing.fixed, *drawing.moving(scene), drawing.flown(scene)]
        in_space = [part for part in parts if part.layer not in _NOT_IN_SPACE]
        from_above = [part for part in parts if part.layer not in _NOT_FROM_ABOVE]
        self._moving = draw_parts(self._space, in_space, poses, above=False, width=_WIDTH)
        self._moving += draw_parts(self.above, from_above, poses, above=True, width=_WIDTH)

        on_rods = [uav + 1 not in scene.released for uav in range(len(scene.uavs_I))]
        x, y, _ = _middle_I(scene.payload_I, scene.uavs_I[on_rods])
        reach_x_m = self._reach_m * _PROPORTION
        self.above.set_xlim(x - reach_x_m, x + reach_x_m)
        # z points away from the viewer, so y points down.
        self.above.set_ylim(y + self._reach_m, y - self._reach_m)

        self._moving += [axes.axvline(scene.time_s, color=_NOW) for axes in self._over_time]
        text = f"{scene.time_s:5.2f} s   {scene.phase}"
        self._moving.append(self.figure.text(*_TIME, text, **_TIME_STYLE))


def _middle_I(payload_I: Array, uavs_I: Array) -> Array:
    """Return the middle of the view from above: between payload and mean of the UAVs on their rods, (3,)."""
    if not len(uavs_I):
        return payload_I
    return np.asarray((uavs_I.mean(axis=0) + payload_I) / 2.0)


def _reach_m(series: Series) -> float:
    """Return half the height of the view from above: payload and UAVs on their rods are in it throughout, m."""
    farthest_m = np.zeros(3)
    for x, uavs_I, on_rods in zip(series.x, series.uavs_I, series.on_rods, strict=True):
        payload_I = x[R0]
        middle_I = _middle_I(payload_I, uavs_I[on_rods])
        seen_I = np.vstack([payload_I, uavs_I[on_rods]])
        farthest_m = np.maximum(farthest_m, np.abs(seen_I - middle_I).max(axis=0))
    return float(max(farthest_m[0] / _PROPORTION, farthest_m[1])) + _BEYOND_M


def _set_space(axes: Any, series: Series) -> None:
    """Set the view in space, with the payload's reference."""
    line(axes, series.payload_reference_I, color=REFERENCE, linewidth=0.8, linestyle="--")
    flown_I = np.concatenate([series.uavs_I.reshape(-1, 3), series.x[:, :3]])
    frame(axes, flown_I * UP, zoom=_ZOOM)
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.tick_params(pad=-2.0)
    axes.set(xlabel="", ylabel="", zlabel="")
    axes.yaxis.set_major_locator(MaxNLocator(2))


def _set_above(axes: Axes) -> None:
    """Set the view from above."""
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.spines[["top", "right"]].set_visible(True)
    axes.set_title(
        "from above, with predicted paths\nlinks: grey if fresh, yellow if late, black without plan"
    )


def _draw_cost(axes: Axes, series: Series) -> None:
    """Draw the cost of the whole run."""
    axes.set_ylabel("cost")
    axes.tick_params(labelbottom=False)
    axes.plot(series.times_s, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
    scale_cost(axes, float(series.cost.max()), _DECADES)


def _draw_attitude(axes: Axes, series: Series) -> None:
    """Draw the largest angle of the payload over the whole run, in black: colours are those of UAVs and links."""
    axes.set(xlabel="time (s)", ylabel="payload's\nangle (deg)")
    axes.plot(series.times_s, np.abs(series.attitude_deg).max(axis=1), color="#000000")
    axes.set_ylim(bottom=0.0)
