"""Panel of the viewer: playback, numbers, layers, and for live runs links and processes."""

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from protocol.wire.messages import agent_name
from transport.flight.live import Commands
from transport.scene.drawing import LAYERS
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html
from transport.viewer.plots import Plots
from transport.viewer.server import report_malformed
from transport.viewer.target import TargetControls

if TYPE_CHECKING:
    import viser

_ALL = "all links"
_WHOLE, _TEAM = "whole path", "team"
# First length of the time slider of a live run, s; it doubles.
_SLIDER_S = 20.0
# A slider must rest for this long before its value is sent, s.
_REST_S = 0.3
# Largest number of links in the drop-down; others are changed on the command line.
_MOST_LINKS = 90
# Playback speeds by label.
SPEEDS: Mapping[str, float] = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}


class Playback:
    """The tick to show; advanced by the drawing thread, changed by widgets on other threads."""

    def __init__(self, period_s: float, *, follows: bool) -> None:
        self._period_s = period_s
        self._lock = threading.Lock()
        self._tick, self._last = 0.0, 0
        self._speed = 1.0
        self.follows, self.playing = follows, False

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """Return the tick to show now, of those that can be shown, given the wall time since the previous call, s."""
        with self._lock:
            self._last = last
            if self.follows:
                self._tick = float(last)
            elif self.playing:
                self._tick += elapsed_s * self._speed / self._period_s
                self.playing = self._tick < last
            self._tick = min(max(self._tick, float(first)), float(last))
            return int(self._tick)

    def seek(self, tick: int) -> None:
        """Pause at a tick."""
        with self._lock:
            self._tick, self.playing, self.follows = float(tick), False, False

    def toggle(self) -> None:
        """Pause if playing or following; otherwise play, from the beginning if at the end."""
        with self._lock:
            self.playing = not (self.playing or self.follows)
            self.follows = False
            if self.playing and self._tick >= self._last:
                self._tick = 0.0

    def follow(self, wanted: bool) -> None:
        """Follow the live run, or pause."""
        with self._lock:
            self.follows, self.playing = wanted, False

    def set_speed(self, speed: float) -> None:
        """Set the playback speed, in multiples of real time."""
        with self._lock:
            self._speed = speed


class Panel:
    """Widgets of one viewer.

    Args:
        server, builder: Web server, and scenes of the run.
        playback: Playback state that the widgets change.
        show_layer: Called with a layer's name and whether to show it.
        look: Called with whether to look at the team, or else at the whole maneuver.
        follow: Called with whether the camera moves with the team.
        commands: Requests to the live run; None for a recorded run.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        builder: SceneBuilder,
        playback: Playback,
        show_layer: Callable[[str, bool], None],
        look: Callable[[bool], None],
        follow: Callable[[bool], None],
        commands: Commands | None,
    ) -> None:
        self._builder, self._playback, self._commands = builder, playback, commands
        self._setup, gui = builder.setup, server.gui
        self._period_s = self._setup.settings.sampling_period_s
        self._duration_s = self._setup.ticks * self._period_s
        self._timer: threading.Timer | None = None
        self._moved: set[str] = set()  # keys of links whose widgets a user has moved, not yet sent
        self._links_shown = False
        self._is_over = commands is None
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"transport: {self._setup.scenario.name}")
        gui.add_html(html.tab_title(self._setup.scenario.name))
        self._notice = gui.add_html("")
        # That of a live run grows with it.
        shown_s = self._duration_s if commands is None else min(_SLIDER_S, self._duration_s)
        self._time = gui.add_slider("time (s)", 0.0, shown_s, self._period_s, 0.0)
        self._play = gui.add_button("Play")
        speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 x")
        self._follow = gui.add_checkbox("follow the run", playback.follows, visible=commands is not None)
        camera = gui.add_button_group("camera", (_WHOLE, _TEAM))
        follows = gui.add_checkbox("camera follows the team", commands is not None)
        with gui.add_folder("Run"):
            self._flight = gui.add_html("")
        self._target = None
        if commands is not None:
            self._target = TargetControls(server, builder, commands.target, _checked)
            self._add_links(gui)
        with gui.add_folder("Plots"):
            self._plots = Plots(gui, builder, is_live=commands is not None)
        with gui.add_folder("Agents"):
            self._agents = gui.add_html("")
        if commands is not None:
            self._add_processes(gui, commands)
        with gui.add_folder("Events"):
            self._events = gui.add_html("")
        with gui.add_folder("Show", expand_by_default=commands is None):
            for name, shown in LAYERS.items():
                box = gui.add_checkbox(name, shown)
                box.on_update(_with_value(partial(show_layer, name)))
            gui.add_html(html.legend())

        def turn(value: str) -> None:
            look(value == _TEAM)
            _set(follows, value == _TEAM)

        camera.on_click(_with_value(turn))
        follows.on_update(_with_value(follow))
        self._time.on_update(_from_browser(lambda: playback.seek(round(self._time.value / self._period_s))))
        self._play.on_click(lambda _: playback.toggle())
        speed.on_update(_from_browser(lambda: playback.set_speed(SPEEDS[speed.value])))
        self._follow.on_update(_from_browser(lambda: playback.follow(self._follow.value)))

    def set_notice(self, text: str, *, warning: bool = False) -> None:
        """Set the sentence on top of the panel."""
        self._notice.content = html.notice(text, warning=warning)

    def show_playback(self) -> None:
        """Show whether the viewer plays or follows."""
        if self._follow.value != self._playback.follows:
            _set(self._follow, self._playback.follows)
        label = "Pause" if self._playback.playing else "Play"
        if self._play.label != label:
            self._play.label = label

    def show(self, scene: Scene) -> None:
        """Show time, numbers and events of a scene."""
        while self._time.max < min(self._builder.history.last * self._period_s, self._duration_s):
            self._time.max = min(2.0 * self._time.max, self._duration_s)
        _set(self._time, scene.time_s)
        self._plots.show(scene.tick)
        if self._target is not None:
            self._target.show(scene)
        if self._commands is not None and not self._links_shown:
            self._links_shown = True
            self._show_chosen_link()  # as the run has them, until a user moves one
        behind_s = 0.0 if self._is_over else self._builder.history.last * self._period_s - scene.time_s
        watched = not self._is_over and self._playback.follows
        self._flight.content = html.flight(scene, self._duration_s, behind_s, watched=watched)
        self._agents.content = html.agents(scene, self._setup.owned, self._period_s)
        self._events.content = html.events(self._builder.history.events, scene.tick, self._period_s)

    def close_controls(self) -> None:
        """Hide the controls of a live run, which has ended."""
        self._is_over = True
        if self._target is not None:
            self._target.close()
        if self._commands is not None:
            self._links.visible = self._processes.visible = self._follow.visible = False

    def _add_links(self, gui: "viser.GuiApi") -> None:
        agents = self._setup.agents
        self._pairs = [(a, b) for a in agents for b in agents if a != b]
        names = [f"{a} to {b}" for a, b in self._pairs[:_MOST_LINKS]]
        self._links = gui.add_folder("Links", visible=bool(names))
        with self._links:
            self._link = gui.add_dropdown("link", (_ALL, *names))
            self._delay = gui.add_slider("delay (s)", 0.0, 1.0, 0.01, 0.0, hint="as transport link set --delay")
            self._loss = gui.add_slider("loss (%)", 0, 100, 1, 0, hint="30 % is transport link set --loss 0.3")
            self._partition = gui.add_checkbox("partition", False, hint="100 % loss, as --loss 1")
            clear = gui.add_button("Clear all links", hint="as transport link clear")
        self._link.on_update(_from_browser(self._show_chosen_link))
        for widget, key in ((self._delay, "delay_s"), (self._loss, "loss"), (self._partition, "loss")):
            widget.on_update(_from_browser(partial(self._change_link_after_rest, key)))
        clear.on_click(lambda _: self._clear_links())

    def _add_processes(self, gui: "viser.GuiApi", commands: Commands) -> None:
        self._processes = gui.add_folder("Processes")
        with self._processes:
            for agent in self._setup.agents:
                buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
                buttons.on_click(_with_value(partial(commands.fault, target=agent_name(agent))))

    def _chosen_link(self) -> tuple[int, int] | None:
        """Return sender and receiver of the chosen link; None for all links."""
        if self._link.value == _ALL:
            return None
        sender, _, receiver = self._link.value.partition(" to ")
        return int(sender), int(receiver)

    def _show_chosen_link(self) -> None:
        """Show the values of the chosen link, or the largest of all links."""
        chosen, last = self._chosen_link(), max(0, self._builder.history.last)
        pairs = self._pairs if chosen is None else [chosen]
        found = [self._builder.link_history.settings(*ends, last) for ends in pairs]
        if found:
            delay_s, loss = map(max, zip(*found, strict=True))
            self._show_link(delay_s, round(100.0 * loss), partition=loss >= 1.0)

    def _clear_links(self) -> None:
        self._show_link(0.0, 0, partition=False)
        if self._commands is not None:
            self._commands.clear()

    def _show_link(self, delay_s: float, loss_percent: int, *, partition: bool) -> None:
        _set(self._delay, min(round(delay_s, 2), 1.0))
        _set(self._loss, loss_percent)
        _set(self._partition, partition)

    def _change_link_after_rest(self, key: str) -> None:
        """Send the value of a slider once it rests: a drag reports every step."""
        self._moved.add(key)
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(_REST_S, self._change_link)
        self._timer.daemon = True
        self._timer.start()

    def _change_link(self) -> None:
        if self._commands is not None:
            loss = 1.0 if self._partition.value else self._loss.value / 100.0
            values = {"delay_s": round(self._delay.value, 3), "loss": loss}
            moved, self._moved = self._moved, set()
            self._commands.link(self._chosen_link(), {key: values[key] for key in sorted(moved)})


def _from_browser(act: Callable[[], None]) -> Callable[[Any], None]:
    """Return a callback for changes made in a browser; viser also reports those of this process."""
    return _checked(lambda event: None if event.client_id is None else act())


def _with_value(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget."""
    return _checked(lambda event: act(event.target.value))


def _checked(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that reports a value no widget has in one line: a program may send any."""

    def checked(event: Any) -> None:
        try:
            act(event)
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            report_malformed(error)

    return checked


def _set(widget: Any, value: float | bool) -> None:
    """Set the value of a widget, whose type does not allow it."""
    widget.value = value
