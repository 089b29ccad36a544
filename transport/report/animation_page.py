"""Frame of an animation: the team in space and from above, cost and attitude so far."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from model.arrays import Array
from transport.analysis.series import Series
from transport.report.figures_3d import frame, line
from transport.report.style import COMPONENTS, PAYLOAD, REFERENCE, scale_cost, shade_phases
from transport.scene.colours import uav_style
from transport.scene.geometry import agent_positions, link_segments, rotor_centres, uav_span
from transport.scene.scene import Scene, SceneBuilder

DPI = 100
_SIZE_IN = (7.2, 4.4)
_UP = np.array([1.0, 1.0, -1.0])
_FADED = "#d0d0d0"
_DECADES = 4


class AnimationPage:
    """Figure of one run, of at least one tick, whose moving parts are redrawn for every frame."""

    def __init__(self, builder: SceneBuilder, series: Series) -> None:
        self._setup, self._series = builder.setup, series
        self._N = self._setup.system.N
        self.figure = Figure(figsize=_SIZE_IN, dpi=DPI)
        self._space: Any = self.figure.add_axes((-0.04, 0.0, 0.58, 0.95), projection="3d")
        self._above = self.figure.add_axes((0.54, 0.42, 0.44, 0.47))
        self._cost, self._attitude = (self.figure.add_axes((0.62, y, 0.36, 0.11)) for y in (0.25, 0.10))
        self._moving: list[Any] = []
        self._hover_N, self._span_m = builder.hover_N, uav_span(builder.start_I)
        self._reach_m = float(np.ptp(builder.start_I[:, :2], axis=0).max(initial=0.0)) / 2.0 + 0.4
        self._draw_fixed_parts()

    def show(self, scene: Scene) -> None:
        """Draw a scene in place of the previous one."""
        for artist in self._moving:
            artist.remove()
        self._moving = []
        row = int(np.searchsorted(self._series.ticks, scene.tick))
        self._draw_space(scene, row)
        self._draw_above(scene)
        self._draw_curves(row)
        text = f"{scene.time_s:5.2f} s   {scene.phase}"
        self._keep(self.figure.text(0.03, 0.94, text, fontsize=10.0, family="monospace", weight="bold"))

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
        self._time_axes(self._cost, "cost")
        self._time_axes(self._attitude, "attitude\n(deg)")
        self._cost.tick_params(labelbottom=False)
        scale_cost(self._cost, float(series.cost.max()), _DECADES)
        largest = 1.05 * max(0.05, float(series.attitude_max_deg.max()))
        self._attitude.set_ylim(-largest, largest)
        for k, (name, colour) in enumerate(zip(("roll", "pitch", "yaw"), COMPONENTS, strict=True)):
            at = 0.01 + 0.11 * k, 0.97
            self._attitude.text(*at, name, color=colour, fontsize=7.0, va="top", transform=self._attitude.transAxes)
        self._attitude.set_xlabel("time (s)", fontsize=7.5, labelpad=1.0)
        shade_phases(setup, [self._cost, self._attitude], float(series.times_s[-1]) + 1e-9, named=False)
        self._cost.plot(series.times_s, np.where(series.cost > 0.0, series.cost, np.nan), color=_FADED, linewidth=0.8)
        self._attitude.plot(series.times_s, series.attitude_deg, color=_FADED, linewidth=0.8)

    def _time_axes(self, axes: Axes, label: str) -> None:
        axes.tick_params(labelsize=7.0)
        axes.set_ylabel(label, fontsize=7.5)

    def _draw_space(self, scene: Scene, row: int) -> None:
        space, series = self._space, self._series
        self._keep(*line(space, series.x[: row + 1, :3], color=PAYLOAD, linewidth=0.9))
        for i in range(self._N):
            self._keep(*line(space, series.uavs_I[: row + 1, i], linewidth=0.9, **uav_style(i)))
            rod = np.array([scene.uavs_I[i], scene.attachments_I[i]])
            self._keep(*line(space, rod, color="#555555", linewidth=1.0))
            self._vehicle(i, scene)
        for prediction in scene.predictions:
            own = self._setup.owned[prediction.agent - 1]
            colour = uav_style(own[0])["color"]
            self._keep(*line(space, prediction.payload_I, color=colour, linewidth=1.8, solid_capstyle="round"))
            for k, uav in enumerate(own):
                self._keep(*line(space, prediction.uavs_I[:, k], color=uav_style(uav)["color"], linewidth=2.2))
        outline = _outline_I(scene)
        self._keep(*line(space, np.vstack([outline, outline[:1]]), color=PAYLOAD, linewidth=3.0))

    def _vehicle(self, i: int, scene: Scene) -> None:
        """Draw two beams and the thrust."""
        tips = scene.uavs_I[i] + self._span_m * rotor_centres() @ scene.R_uavs[i].T
        colour = uav_style(i)["color"]
        for pair in (tips[[0, 2]], tips[[1, 3]]):
            self._keep(*line(self._space, pair, color=colour, linewidth=2.4))
        arrow = np.array([scene.uavs_I[i], scene.uavs_I[i] + 0.5 * scene.thrusts_I[i] / self._hover_N])
        self._keep(*line(self._space, arrow, color=colour, linewidth=0.8))

    def _draw_above(self, scene: Scene) -> None:
        """Draw the team seen from above, centred on it."""
        axes, centre = self._above, scene.uavs_I[:, :2].mean(axis=0)
        # z points away from the viewer, so y points down.
        axes.set_xlim(centre[0] - self._reach_m * 1.9, centre[0] + self._reach_m * 1.9)
        axes.set_ylim(centre[1] + self._reach_m, centre[1] - self._reach_m)
        pieces, colours = link_segments(
            scene.links, agent_positions(scene, self._setup.owned), self._setup.settings.sampling_period_s
        )
        self._keep(axes.add_collection(LineCollection(list(pieces[..., :2]), colors=colours / 255.0, linewidths=2.6)))
        self._keep(*axes.fill(*_outline_I(scene)[:, :2].T, color="#000000", alpha=0.12, linewidth=0.0))
        for prediction in scene.predictions:
            own = self._setup.owned[prediction.agent - 1]
            self._keep(*axes.plot(*prediction.payload_I[:, :2].T, color=uav_style(own[0])["color"], linewidth=1.4))
            for k, uav in enumerate(own):
                path = prediction.uavs_I[:, k, :2]
                self._keep(*axes.plot(*path.T, color=uav_style(uav)["color"], linewidth=2.0))
        for i, place in enumerate(scene.uavs_I[:, :2]):
            colour = uav_style(i)["color"]
            for rotor in self._span_m * rotor_centres()[:, :2] + place:
                disc = Circle(tuple(rotor), 0.17 * self._span_m, facecolor=colour, alpha=0.45, linewidth=0.0)
                self._keep(axes.add_patch(disc))
            outwards = place - centre
            at = place + 0.34 * outwards / max(float(np.linalg.norm(outwards)), 1e-6)
            style = {"fontsize": 8.0, "color": colour, "ha": "center", "va": "center", "weight": "bold"}
            self._keep(axes.text(float(at[0]), float(at[1]), f"UAV{i + 1}", **style))

    def _draw_curves(self, row: int) -> None:
        series, until = self._series, slice(0, row + 1)
        cost = np.where(series.cost > 0.0, series.cost, np.nan)
        self._keep(*self._cost.plot(series.times_s[until], cost[until], color="#000000", linewidth=1.2))
        for column, colour in enumerate(COMPONENTS):
            values = series.attitude_deg[until, column]
            self._keep(*self._attitude.plot(series.times_s[until], values, color=colour, linewidth=1.2))

    def _keep(self, *artists: Any) -> None:
        self._moving.extend(artists)


def _outline_I(scene: Scene) -> Array:
    """Return the attachments in their order around the payload, (N, 3), inertial frame, m."""
    offsets = scene.attachments_I - scene.payload_I
    outline: Array = scene.attachments_I[np.argsort(np.arctan2(offsets[:, 1], offsets[:, 0]))]
    return outline
