"""Panel of the viewer: playback, numbers, plots and layers, and for live runs the controls of the run."""

from functools import partial
from typing import Any

from transport.flight.live import Commands
from transport.scene.drawing import LAYERS
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html
from transport.viewer.controls import LinkControls, TargetControls, add_processes, from_browser
from transport.viewer.plots import Plots
from transport.viewer.view3d import View3D

_WHOLE, _TEAM = "whole path", "team"
# First length of the time slider of a live run, s; it doubles.
_SLIDER_S = 20.0
# Playback speeds by label.
_SPEEDS = {f"{speed:g} x": speed for speed in (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)}


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
        gui.add_html(html.tab_title(self._setup.scenario.name))
        self._notice = gui.add_html("")
        # That of a live run grows with it.
        shown_s = min(_SLIDER_S, self._duration_s) if is_live else self._duration_s
        self._time = gui.add_slider("time (s)", 0.0, shown_s, self._period_s, 0.0)
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
        while self._time.max < min(self._builder.history.last * self._period_s, self._duration_s):
            self._time.max = min(2.0 * self._time.max, self._duration_s)
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
