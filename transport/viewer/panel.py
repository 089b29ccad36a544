"""Panel of the viewer: playback, numbers, plots and layers, and for live runs the controls of the run."""

from functools import lru_cache, partial
from typing import Any

import numpy as np

from model.arrays import Array
from model.state import INPUTS
from transport.flight.live import Commands
from transport.scene.drawing import LAYERS, uav_style
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html
from transport.viewer.controls import LinkControls, TargetControls, add_processes, from_browser
from transport.viewer.view3d import View3D

_WHOLE, _TEAM = "whole path", "team"
# Playback speeds by label.
_SPEEDS = {f"{speed:g} x": speed for speed in (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)}
# Time axis, s; points of a curve.
_SPAN_S, _POINTS = 30.0, 200
_HEIGHT_PX = 120
# Smaller costs are rounding errors.
_LEAST_COST = 1e-8


class Playback:
    """The tick to show: of the run that it follows, or of a playback; widgets change it on other threads."""

    def __init__(self, period_s: float, *, follows: bool) -> None:
        self._period_s, self._tick, self._last = period_s, 0.0, 0
        self.speed, self.follows, self.playing = 1.0, follows, False

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """Return the tick to show now, of those that can be shown, given the wall time since the previous call, s."""
        self._last, tick = last, self._tick
        if self.follows:
            tick = float(last)
        elif self.playing:
            tick += elapsed_s * self.speed / self._period_s
            self.playing = tick < last
        self._tick = min(max(tick, float(first)), float(last))
        return int(self._tick)

    def seek(self, tick: int) -> None:
        """Pause at a tick."""
        self._tick, self.playing, self.follows = float(tick), False, False

    def toggle(self) -> None:
        """Pause if playing or following; otherwise play, from the beginning if at the end."""
        self.playing = not (self.playing or self.follows)
        self.follows = False
        if self.playing and self._tick >= self._last:
            self._tick = 0.0

    def follow(self, wanted: bool) -> None:
        """Follow the live run, or pause."""
        self.follows, self.playing = wanted, False


class Plots:
    """Four plots in the panel of the viewer; lines have the colours of the UAVs.

    They show the seconds before the shown tick, by the time before it, as the browser does not move a time axis with
    its data.
    """

    def __init__(self, gui: Any, builder: SceneBuilder) -> None:
        setup = builder.setup
        self._builder, self._period_s = builder, setup.settings.sampling_period_s
        self._row = lru_cache(10 * _POINTS)(self._values)
        agents = [uav_style(owned[0])["color"] for owned in setup.owned]
        uavs = [uav_style(i)["color"] for i in range(setup.system.N)]
        # Title, colours, and the least range of the axis: that of a single value would be any.
        kinds: tuple[tuple[str, list[str], tuple[float, float]], ...] = (
            ("payload error (m)", ["#000000"], (0.0, 0.01)),
            ("stage cost (power of ten)", ["#000000"], (-6.0, -3.0)),
            ("oldest plan in use, by agent (s)", agents, (0.0, 2.0 * self._period_s)),
            ("thrust, by UAV (N)", uavs, (0.98 * builder.hover_N, 1.02 * builder.hover_N)),
        )
        self._plots = [_plot(gui, *kind) for kind in kinds]

    def show(self, tick: int) -> None:
        """Show the curves until a recorded tick."""
        recorded = self._builder.history.plant_states
        first = max(self._builder.history.first, tick - round(_SPAN_S / self._period_s))
        # Multiples of the spacing, so that the same ticks are drawn again, and the last.
        every = max(1, (tick - first) // _POINTS)
        ticks = [k for k in range(first - first % every, tick, every) if k in recorded] + [tick]
        times_s = (np.array(ticks) - tick) * self._period_s
        for plot, part in zip(self._plots, zip(*map(self._row, ticks), strict=True), strict=True):
            plot.data = times_s, *map(np.ascontiguousarray, np.array(part).T)

    def _values(self, tick: int) -> list[Array]:
        """Return the values of each plot at a tick: m, power of ten, s, N."""
        setup, history = self._builder.setup, self._builder.history
        error_m, cost = self._builder.error_and_cost(tick)
        reports = [history.reports.get((agent, tick)) for agent in setup.agents]
        ages = [0 if report is None else max([0, *report.plan_ages]) for report in reports]
        decade, thrusts_N = np.log10(max(cost, _LEAST_COST)), history.plant_states[tick].u[::INPUTS]
        return [np.array([error_m]), np.array([decade]), np.array(ages) * self._period_s, thrusts_N]


def _plot(gui: Any, title: str, colours: list[str], least: tuple[float, float]) -> Any:
    # A range in uPlot's words: wider where the curves are.
    range_y = {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in zip(("min", "max"), least, strict=True)}
    return gui.add_uplot(
        (np.array([-_SPAN_S, 0.0]), *(np.full(2, np.nan) for _ in colours)),
        ({"label": "time before the shown tick (s)"}, *({"stroke": colour, "width": 1.5} for colour in colours)),
        title=title,
        scales={"x": {"time": False, "auto": False, "range": [-_SPAN_S, 0.0]}, "y": {"range": range_y}},
        axes=tuple({"size": size, "font": "10px sans-serif"} for size in (26, 46)),
        legend={"show": False},
        cursor={"show": False},
        height=_HEIGHT_PX,
    )


class Panel:
    """Widgets of one viewer, which change playback and view; with commands to the run if it is live."""

    def __init__(
        self, server: Any, builder: SceneBuilder, playback: Playback, view3d: View3D, commands: Commands | None
    ) -> None:
        self._builder, self._playback, self._setup, gui = builder, playback, builder.setup, server.gui
        self._period_s, is_live = self._setup.settings.sampling_period_s, commands is not None
        self._duration_s = self._setup.ticks * self._period_s
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"transport: {self._setup.scenario.name}")
        self._notice = gui.add_html("")
        self._time = gui.add_slider("time (s)", 0.0, self._duration_s, self._period_s, 0.0)
        self._play = gui.add_button("Play")
        speed = gui.add_dropdown("speed", tuple(_SPEEDS), initial_value="1 x")
        self._follow = gui.add_checkbox("follow the run", playback.follows, visible=is_live)
        camera = gui.add_button_group("camera", (_WHOLE, _TEAM))
        follows = gui.add_checkbox("camera follows the team", is_live)
        with gui.add_folder("Run"):
            self._flight = gui.add_html("")
        self._target, self._live = None, [self._follow]
        if commands is not None:
            self._target = TargetControls(server, builder, commands)
            self._live += [self._target.folder, LinkControls(gui, builder, commands).folder]
        with gui.add_folder("Plots"):
            self._plots = Plots(gui, builder)
        with gui.add_folder("Agents"):
            self._agents = gui.add_html("")
        if commands is not None:
            self._live.append(add_processes(gui, builder, commands))
        with gui.add_folder("Events"):
            self._events = gui.add_html("")
        with gui.add_folder("Show", expand_by_default=not is_live):
            for name in LAYERS:
                gui.add_checkbox(name, True).on_update(from_browser(partial(view3d.show_layer, name)))
            gui.add_html(html.legend())

        def turn(value: str) -> None:
            view3d.look_at(team=value == _TEAM)
            follows.value = value == _TEAM

        def set_speed(value: str) -> None:
            playback.speed = _SPEEDS[value]

        camera.on_click(from_browser(turn))
        follows.on_update(lambda _: view3d.follow(follows.value))
        self._time.on_update(from_browser(lambda time_s: playback.seek(round(time_s / self._period_s))))
        self._play.on_click(lambda _: playback.toggle())
        speed.on_update(from_browser(set_speed))
        self._follow.on_update(from_browser(playback.follow))

    def set_notice(self, text: str, *, warning: bool = False) -> None:
        """Set the sentence on top of the panel."""
        self._notice.content = html.notice(text, warning=warning)

    def show_playback(self) -> None:
        """Show whether the viewer plays or follows."""
        self._follow.value = self._playback.follows
        self._play.label = "Pause" if self._playback.playing else "Play"

    def show(self, scene: Scene) -> None:
        """Show time, numbers and events of a scene."""
        self._time.value = scene.time_s
        self._plots.show(scene.tick)
        if self._target is not None:
            self._target.show(scene)
        self._flight.content = html.flight(scene, self._duration_s)
        self._agents.content = html.agents(scene, self._setup.owned, self._period_s)
        self._events.content = html.events(self._builder.history.events, scene.tick, self._period_s)

    def close_controls(self) -> None:
        """Hide the controls of a live run, which has ended."""
        for widget in self._live:
            widget.visible = False
        if self._target is not None:
            self._target.close()
