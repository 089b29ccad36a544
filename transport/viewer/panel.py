"""Panel of the viewer: playback, numbers, plots and layers, and for live runs the controls of the run."""

import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np

from transport.flight.live import Commands
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import agent_name
from transport.scene.colours import uav_style
from transport.scene.drawing import LAYERS
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html
from transport.viewer.view3d import View3D

_SPAN_S, _POINTS, _HEIGHT_PX = 30.0, 200, 120  # of a plot: time axis, points of a curve, height
_LEAST_COST = 1e-8  # smaller ones are rounding errors
# Steps of the target in the inertial frame by the keys for them, with Shift: alone, arrows move
# sliders.
_STEPS = {
    "arrowleft": (-1.0, 0.0, 0.0),
    "arrowright": (1.0, 0.0, 0.0),
    "arrowup": (0.0, -1.0, 0.0),
    "arrowdown": (0.0, 1.0, 0.0),
    "pageup": (0.0, 0.0, -1.0),
    "pagedown": (0.0, 0.0, 1.0),
}
_STEP_M = 0.5
_TYPED_S = 0.3  # a page sends what is typed later than a click, by less


class Playback:
    """The tick to show: of the run that it follows, or of a playback.

    Widgets change it on other threads.
    """

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
    """Four plots of the seconds before the shown tick, by the time before it.

    A browser moves no axis with its data.
    """

    def __init__(self, gui: Any, builder: SceneBuilder) -> None:
        setup = builder.setup
        self._builder, self._period_s = builder, setup.settings.sampling_period_s
        self._row = lru_cache(10 * _POINTS)(self._values)
        agents = [uav_style(owned[0])["color"] for owned in setup.owned]
        uavs = [uav_style(i)["color"] for i in range(setup.system.N)]
        # Title, colours, and the least range of the axis: that of a single value would be any.
        self._plots = [
            _plot(gui, "payload error (m)", ["#000000"], (0.0, 0.01)),
            _plot(gui, "stage cost (power of ten)", ["#000000"], (-6.0, -3.0)),
            _plot(gui, "oldest plan in use, by agent (s)", agents, (0.0, 2.0 * self._period_s)),
            _plot(
                gui, "thrust, by UAV (N)", uavs, (0.98 * builder.hover_N, 1.02 * builder.hover_N)
            ),
        ]

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
    range_y = {
        end: {"pad": 0.1, "soft": soft, "mode": 1}
        for end, soft in zip(("min", "max"), least, strict=True)
    }
    scales = {
        "x": {"time": False, "auto": False, "range": [-_SPAN_S, 0.0]},
        "y": {"range": range_y},
    }
    axes = tuple({"size": size, "font": "10px sans-serif"} for size in (26, 46))
    data = (np.array([-_SPAN_S, 0.0]), *(np.full(2, np.nan) for _ in colours))
    lines = (
        {"label": "time before the shown tick (s)"},
        *({"stroke": colour, "width": 1.5} for colour in colours),
    )
    look = {"legend": {"show": False}, "cursor": {"show": False}, "height": _HEIGHT_PX}
    return gui.add_uplot(data, lines, title=title, scales=scales, axes=axes, **look)


class Panel:
    """Widgets of one viewer, which change playback and view.

    With commands to the run if it is live.
    """

    def __init__(
        self,
        server: Any,
        builder: SceneBuilder,
        playback: Playback,
        view3d: View3D,
        commands: Commands | None,
    ) -> None:
        self._builder, self._playback, self._setup, gui = (
            builder,
            playback,
            builder.setup,
            server.gui,
        )
        self._period_s, is_live = self._setup.settings.sampling_period_s, commands is not None
        self._duration_s = self._setup.ticks * self._period_s
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"transport: {self._setup.scenario.name}")
        self._notice = gui.add_html("")
        self._time = gui.add_slider("time (s)", 0.0, self._duration_s, self._period_s, 0.0)
        self._play = gui.add_button("Play")
        speed = gui.add_slider("speed", 0.1, 4.0, 0.1, playback.speed)
        self._follow = gui.add_checkbox("follow the run", playback.follows, visible=is_live)
        camera = gui.add_button_group("camera", ("whole path", "team"))
        with gui.add_folder("Run"):
            self._flight = gui.add_html("")
        self._target, self._live = None, [self._follow]
        if commands is not None:
            self._target = TargetControls(server, builder, commands)
            self._live.append(add_links(gui, self._setup, commands))
        with gui.add_folder("Plots"):
            self._plots = Plots(gui, builder)
        with gui.add_folder("Agents"):
            self._agents = gui.add_html("")
        if commands is not None:
            self._live.append(add_processes(gui, self._setup, commands))
        with gui.add_folder("Events"):
            self._events = gui.add_html("")
        with gui.add_folder("Show", expand_by_default=not is_live):
            for name in LAYERS:
                gui.add_checkbox(name, True).on_update(
                    from_browser(partial(view3d.show_layer, name))
                )
            gui.add_html(html.legend())

        camera.on_click(from_browser(lambda value: view3d.look_at(team=value == "team")))
        self._time.on_update(
            from_browser(lambda time_s: playback.seek(round(time_s / self._period_s)))
        )
        self._play.on_click(lambda _: playback.toggle())
        speed.on_update(from_browser(partial(setattr, playback, "speed")))
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


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget, if a browser has changed it and not this process."""
    return lambda event: None if event.client_id is None else act(event.target.value)


class TargetControls:
    """Widgets in a folder that send the payload somewhere: a handle to drag, keys and numbers."""

    def __init__(self, server: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._builder, self._go, gui = builder, commands.target, server.gui
        start_I: Array = builder.setup.maneuver.path(np.zeros(1))[0][0]
        self.folder = gui.add_folder("Target")
        with self.folder:
            self._state = gui.add_html("")
            # Three number fields would lose the sign of -0.5 while it is typed: they show -0 as 0.
            self._typed = gui.add_text(
                "x, y, z (m)", _in_text(start_I), hint="inertial frame: z points down"
            )
            there = gui.add_button(
                "Go there", hint="as transport target X Y Z; or drag the arrows in the scene"
            )
        self.handle = server.scene.add_transform_controls(
            "/target",
            scale=0.6,
            disable_rotations=True,
            disable_sliders=True,
            position=tuple(start_I),
        )
        there.on_click(self._typed_place)
        self.handle.on_update(self._dragged)
        self._dragged_from = start_I
        self._keys = []
        for key, step in _STEPS.items():
            command = gui.add_command(
                f"target: {_STEP_M:g} m, shift {key}", hotkey=key, modifier="shift"
            )
            command.on_trigger(partial(self._step, _STEP_M * np.array(step)))
            self._keys.append(command)

    def show(self, scene: Scene) -> None:
        """Show the target of a scene."""
        known = [
            target
            for target in self._builder.setup.maneuver.targets
            if target.since_s <= scene.time_s
        ]
        self._state.content = html.target(known[-1].end_I, known[-1].ends_s, scene) if known else ""

    def close(self) -> None:
        """Hide handle and folder and remove the keys when the run has ended."""
        self.folder.visible = self.handle.visible = False
        for command in self._keys:
            command.remove()

    def _send(self, place_I: Array) -> None:
        self.handle.position = place_I
        self._typed.value = _in_text(place_I)
        self._go(place_I)

    def _step(self, step_I: Array, _: object) -> None:
        self._send(np.round(np.array(self.handle.position) + step_I, 2) + 0.0)  # without -0

    def _typed_place(self, event: Any) -> None:
        time.sleep(_TYPED_S)
        try:
            x, y, z = map(float, self._typed.value.replace(",", " ").split())
        except ValueError:
            event.client.add_notification(
                "Target", f"expected three numbers, got {self._typed.value[:40]!r}"
            )
            return
        self._send(np.array([x, y, z]))

    def _dragged(self, event: Any) -> None:
        """Show where the handle is; send the target once it is let go, unless it was only clicked."""
        place_I = np.round(np.array(self.handle.position), 2) + 0.0  # without -0
        self._typed.value = _in_text(place_I)
        if event.phase == "start":
            self._dragged_from = place_I
        elif event.phase == "end" and not np.array_equal(self._dragged_from, place_I):
            self._go(place_I)


def add_links(gui: Any, setup: Setup, commands: Commands) -> Any:
    """Return a folder with widgets that delay, impair and cut links between agents, one in one direction or all."""
    ends = {f"{a} to {b}": (a, b) for a in setup.agents for b in setup.agents if a != b}
    folder, links = gui.add_folder("Links", visible=bool(ends)), setup.scenario.links
    with folder:
        link = gui.add_dropdown("link", ("all links", *ends))
        delay = gui.add_slider("delay (s)", 0.0, 1.0, 0.01, min(links.delay_s, 1.0))
        loss = gui.add_slider("loss (%)", 0, 100, 1, round(100.0 * links.loss))
        change, clear = gui.add_button("Set"), gui.add_button("Clear all links")

    def set_links(_: Any) -> None:
        commands.link(
            ends.get(link.value), {"delay_s": round(delay.value, 3), "loss": loss.value / 100.0}
        )

    change.on_click(set_links)
    clear.on_click(lambda _: commands.clear())
    return folder


def add_processes(gui: Any, setup: Setup, commands: Commands) -> Any:
    """Return a folder with buttons that kill and restart each agent."""
    folder = gui.add_folder("Processes")
    with folder:
        for agent in setup.agents:
            buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
            buttons.on_click(from_browser(partial(commands.fault, target=agent_name(agent))))
    return folder


def _in_text(place: Array) -> str:
    return ", ".join(f"{value:g}" for value in place)
