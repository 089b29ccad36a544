"""The panel of the viewer: time and play, numbers, what to show, and in live runs links and processes."""

import threading
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from protocol.wire.messages import agent_name
from transport.scene.scene import Scene, Scenes
from transport.viewer import html as words
from transport.viewer.clock import SPEEDS, Clock
from transport.viewer.commands import Commands
from transport.viewer.pace import pace
from transport.viewer.view3d import LAYERS

if TYPE_CHECKING:
    import viser

_ALL = "all links"
_WHOLE, _TEAM = "whole path", "team"
# Sliders say every step of a drag; what is asked for is what they rest at.
_REST_S = 0.3
# More links than this are chosen by their ends in the command line.
_MOST_LINKS = 90


class Panel:
    """Widgets of one viewer.

    Args:
        server: Where.
        scenes: Of the run.
        clock: Which instant is shown.
        show_layer: Called with a layer's name and whether it is to be shown.
        look: Called with whether to look at the team, or else at the whole maneuver.
        acts: What can be done to the run; None for a recorded one.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        scenes: Scenes,
        clock: Clock,
        show_layer: Callable[[str, bool], None],
        look: Callable[[bool], None],
        acts: Commands | None,
    ) -> None:
        self._scenes, self._clock, self._commands = scenes, clock, acts
        self._setup, gui = scenes.setup, server.gui
        self._period_s = self._setup.settings.sampling_period_s
        self._duration_s = self._setup.ticks * self._period_s
        self._timer: threading.Timer | None = None
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"transport: {self._setup.scenario.name}")
        self._notice = gui.add_html("")
        self._pace = gui.add_html("")
        self._time = gui.add_slider("time (s)", 0.0, self._duration_s, self._period_s, 0.0)
        self._play = gui.add_button("Pause" if clock.playing else "Play")
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 x")
        self._follow = gui.add_checkbox("follow the run", clock.follows, visible=acts is not None)
        camera = gui.add_button_group("camera", (_WHOLE, _TEAM))
        camera.on_click(lambda event: look(event.target.value == _TEAM))
        with gui.add_folder("Flight"):
            self._flight = gui.add_html("")
        with gui.add_folder("Agents"):
            self._agents = gui.add_html("")
        if acts is not None:
            self._controls(gui, acts)
        with gui.add_folder("Events"):
            self._news = gui.add_html("")
        with gui.add_folder("Show", expand_by_default=acts is None):
            for name, shown in LAYERS.items():
                box = gui.add_checkbox(name, shown)
                box.on_update(partial(_switch, show_layer, name))
            gui.add_html(words.legend())
        self._time.on_update(_by_people(lambda: clock.seek(round(self._time.value / self._period_s))))
        self._play.on_click(lambda _: clock.toggle())
        self._speed.on_update(_by_people(lambda: clock.set_speed(SPEEDS[self._speed.value])))
        self._follow.on_update(_by_people(lambda: clock.follow(self._follow.value)))

    def say(self, text: str, *, warning: bool = False) -> None:
        """Put a sentence above everything else."""
        self._notice.content = words.notice(text, warning=warning)

    def set_pace(self, gap_s: float) -> None:
        """Let browsers draw no more often than that, s; 0 for as often as they like."""
        content = pace(gap_s)
        if content != self._pace.content:
            self._pace.content = content

    def show(self, scene: Scene, *, numbers: bool) -> None:
        """Show a scene's time and, if asked for, its numbers."""
        _set(self._time, scene.time_s)
        if self._follow.value != self._clock.follows:
            _set(self._follow, self._clock.follows)
        label = "Pause" if self._clock.playing else "Play"
        if self._play.label != label:
            self._play.label = label
        if numbers:
            self._flight.content = words.flight(scene, self._duration_s)
            self._agents.content = words.agents(scene, self._setup.owned, self._period_s)
            self._news.content = words.news(self._scenes.record.news, scene.tick, self._period_s)

    def close_controls(self) -> None:
        """The run is over: nothing can be done to it any more."""
        if self._commands is not None:
            self._links.visible = self._processes.visible = self._follow.visible = False

    def _controls(self, gui: "viser.GuiApi", acts: Commands) -> None:
        agents = [str(agent) for agent in self._setup.agents]
        pairs = [f"{a} to {b}" for a in agents for b in agents if a != b]
        self._links = gui.add_folder("Links", visible=bool(pairs))
        with self._links:
            self._link = gui.add_dropdown("link", (_ALL, *pairs[:_MOST_LINKS]))
            self._delay = gui.add_slider("delay (ms)", 0, 1000, 10, 0, hint="as transport link set --delay")
            self._loss = gui.add_slider("loss (%)", 0, 100, 1, 0, hint="as transport link set --loss")
            self._cut = gui.add_checkbox("partition", False, hint="nothing gets through, as --loss 1")
            clear = gui.add_button("Clear all links", hint="as transport link clear")
        self._processes = gui.add_folder("Processes")
        with self._processes:
            for agent in agents:
                buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
                buttons.on_click(partial(_press, acts, agent_name(int(agent))))
        self._link.on_update(_by_people(self._chosen))
        for widget in (self._delay, self._loss, self._cut):
            widget.on_update(_by_people(self._rested))
        clear.on_click(lambda _: self._clear(acts))

    def _ends(self) -> tuple[int, int] | None:
        """Sender and receiver of the link that is chosen; None for all."""
        if self._link.value == _ALL:
            return None
        sender, _, receiver = self._link.value.partition(" to ")
        return int(sender), int(receiver)

    def _chosen(self) -> None:
        """Another link is chosen: the sliders show what it does."""
        ends = self._ends()
        if ends is None:
            return
        delay_s, loss = self._scenes.link_history.settings(*ends, max(0, self._scenes.record.last))
        self._show_link(round(1e3 * delay_s), round(100.0 * loss), cut=loss >= 1.0)

    def _clear(self, acts: Commands) -> None:
        self._show_link(0, 0, cut=False)
        acts.clear()

    def _show_link(self, delay_ms: int, loss_percent: int, *, cut: bool) -> None:
        for widget, value in ((self._delay, min(delay_ms, 1000)), (self._loss, loss_percent), (self._cut, cut)):
            _set(widget, value)

    def _rested(self) -> None:
        """A slider has moved: ask for what it says once it rests."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(_REST_S, self._ask)
        self._timer.daemon = True
        self._timer.start()

    def _ask(self) -> None:
        if self._commands is not None:
            loss = 1.0 if self._cut.value else self._loss.value / 100.0
            self._commands.link(self._ends(), {"delay_s": self._delay.value / 1e3, "loss": loss})


def _by_people(act: Callable[[], None]) -> Callable[[Any], None]:
    """A callback for what somebody does in a browser; not for what this side sets, which viser reports, too."""
    return lambda event: None if event.client_id is None else act()


def _switch(show_layer: Callable[[str, bool], None], name: str, event: Any) -> None:
    show_layer(name, bool(event.target.value))


def _press(acts: Commands, target: str, event: Any) -> None:
    acts.fault(str(event.target.value), target)


def _set(widget: Any, value: float | bool) -> None:
    """Let a widget show a value; its type says that cannot be done."""
    widget.value = value
