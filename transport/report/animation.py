"""Animation of a run as GIF or MP4: the team in space and from above, cost and attitude so far."""

import shutil
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.progress import track

from transport.analysis.series import Series, series_of
from transport.log.run_log import open_run
from transport.protocol.wire.errors import TransportError
from transport.report.figures_3d import UP, draw_parts, frame, line
from transport.report.style import COMPONENTS, RC, REFERENCE, scale_cost, shade_phases
from transport.scene.drawing import Drawing
from transport.scene.scene import Scene, SceneBuilder

KINDS = (".gif", ".mp4")
# Frames per second; length of the animation of a run, whatever its duration, s.
FPS, LENGTH_S = 10, 6.0
_DPI = 100
_SIZE_IN = (7.2, 4.4)
_NOW = "#b2182b"
_DECADES = 4
_PIXELS = ["-pix_fmt", "yuv420p"]  # that every player of MP4 knows


class AnimationError(TransportError, RuntimeError):
    """The animation cannot be made; the text says what is needed."""


def check_animation(out: Path | None) -> None:
    """Raise AnimationError if the file to write, if any, is neither GIF nor MP4, or is an MP4 without ffmpeg."""
    if out is not None and out.suffix not in KINDS:
        raise AnimationError(f"expected a file that ends in {' or '.join(KINDS)}, got {out}")
    if out is not None and out.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise AnimationError("an MP4 needs ffmpeg, which is not installed; a .gif does not")


def animate_run(folder: Path, out: Path, *, speed: float | None = None) -> Path:
    """Animate the run in a folder as a .gif or .mp4 file, in `LENGTH_S` or at a multiple of real time; return the file.

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

    writer: Any = (
        PillowWriter(FPS)
        if out.suffix == ".gif"
        else FFMpegWriter(FPS, "libx264", extra_args=_PIXELS)
    )
    with mpl.rc_context(RC):
        page = AnimationPage(builder, series)
        with writer.saving(page.figure, str(out), _DPI):
            for tick in track(shown, "animation", console=Console(stderr=True), transient=True):
                page.show(builder.at(tick))
                writer.grab_frame()
    return out


class AnimationPage:
    """Figure of one run, of at least one tick, whose moving parts are redrawn for every frame."""

    def __init__(self, builder: SceneBuilder, series: Series) -> None:
        self._drawing, self._moving = Drawing(builder), list[Any]()
        self._reach_m = float(np.ptp(builder.start_I[:, :2], axis=0).max(initial=0.0)) / 2.0 + 0.4
        self.figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
        space: Any = self.figure.add_axes((-0.04, 0.0, 0.58, 0.95), projection="3d")
        self._space, self._above = space, self.figure.add_axes((0.54, 0.42, 0.44, 0.47))
        line(space, series.payload_reference_I, color=REFERENCE, linewidth=0.8, linestyle="--")
        frame(
            space, np.concatenate([series.uavs_I.reshape(-1, 3), series.x[:, :3]]) * UP, zoom=0.85
        )
        space.view_init(elev=20.0, azim=-62.0)
        space.tick_params(pad=-2.0)
        space.set(xlabel="", ylabel="", zlabel="")
        space.yaxis.set_major_locator(MaxNLocator(2))
        self.figure.text(0.03, 0.03, "x, y, altitude in m")
        self._above.set(aspect="equal", xticks=[], yticks=[])
        self._above.spines[["top", "right"]].set_visible(True)
        self._above.set_title(
            "from above, with predicted paths\nlinks grey: fresh, orange: delayed, black: no plan"
        )
        self._over_time = [self.figure.add_axes((0.62, y, 0.36, 0.11)) for y in (0.25, 0.10)]
        cost, attitude = self._over_time
        cost.set_ylabel("cost")
        cost.tick_params(labelbottom=False)
        cost.plot(series.times_s, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
        scale_cost(cost, float(series.cost.max()), _DECADES)
        attitude.set(xlabel="time (s)", ylabel="attitude\n(deg)")
        for k, name in enumerate(("roll", "pitch", "yaw")):
            attitude.plot(series.times_s, series.attitude_deg[:, k], color=COMPONENTS[k])
            attitude.text(
                0.11 * k, 1.0, name, color=COMPONENTS[k], va="bottom", transform=attitude.transAxes
            )
        shade_phases(builder.setup, self._over_time, float(series.times_s[-1]) + 1e-9, named=False)

    def show(self, scene: Scene) -> None:
        """Draw a scene in place of the previous one."""
        for artist in self._moving:
            artist.remove()
        poses, drawing = self._drawing.poses(scene), self._drawing
        parts = [*drawing.fixed, *drawing.moving(scene), drawing.flown(scene)]
        in_space = [part for part in parts if part.layer not in ("reference", "links")]
        from_above = [
            part for part in parts if part.layer not in ("reference", "actual paths", "thrust")
        ]
        self._moving = draw_parts(self._space, in_space, poses, above=False, width=0.45)
        self._moving += draw_parts(self._above, from_above, poses, above=True, width=0.45)
        x, y = scene.uavs_I[:, :2].mean(axis=0)
        # z points away from the viewer, so y points down.
        self._above.set_xlim(x - self._reach_m * 1.9, x + self._reach_m * 1.9)
        self._above.set_ylim(y + self._reach_m, y - self._reach_m)
        self._moving += [axes.axvline(scene.time_s, color=_NOW) for axes in self._over_time]
        text = f"{scene.time_s:5.2f} s   {scene.phase}"
        self._moving.append(
            self.figure.text(0.03, 0.94, text, fontsize=10.0, family="monospace", weight="bold")
        )
