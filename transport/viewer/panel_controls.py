"""Panel of the viewer: playback, numbers, plots, layers, and the controls of an active run."""

from functools import partial
from typing import Any

from transport.flight.active_runs import Commands
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import agent_name
from transport.scene.drawn_paths_links_and_thrust import LAYERS
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.viewer import panel_values
from transport.viewer.link_controls import LinkControls
from transport.viewer.playback import Playback
from transport.viewer.plots import Plots
from transport.viewer.server import from_browser
from transport.viewer.target_controls import TargetControls
from transport.viewer.timeline import Timeline
from transport.viewer.view3d import View3D


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
        gui = server.gui
        setup = builder.setup
        self._playback = playback
        self._setup = setup
        self._period_s = setup.settings.sampling_period_s
        self._duration_s = setup.ticks * self._period_s
        self._links: LinkControls | None = None
        self._target: TargetControls | None = None
        self._of_run: list[Any] = []  # widgets that make sense only while the run is active

        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"transport: {setup.scenario.name}")
        self._notice = gui.add_html("")
        self._timeline = Timeline(gui, builder.history, playback)
        self._add_playback(gui, view3d, is_live=commands is not None)
        with gui.add_folder("Run"):
            self._flight = gui.add_html("")
        if commands is not None:
            self._target = TargetControls(server, builder, commands)
            self._links = LinkControls(gui, builder.history, commands)
            self._of_run.append(self._links.folder)
            self._of_run.append(_add_processes(gui, setup, commands))
        with gui.add_folder("Plots"):
            self._plots = Plots(gui, builder, whole=commands is None)
        with gui.add_folder("Agents"):
            self._agents = gui.add_html("")
        with gui.add_folder("Events"):
            self._timeline.add_list()
        with gui.add_folder("Show", expand_by_default=commands is None):
            _add_layers(gui, view3d)

    def set_notice(self, text: str, *, warning: bool = False) -> None:
        """Set the sentence on top of the panel."""
        self._notice.content = panel_values.notice(text, warning=warning)

    def show_playback(self) -> None:
        """Show whether the viewer plays or follows."""
        self._follow.value = self._playback.follows
        self._play.label = "Pause" if self._playback.playing else "Play"

    def show(self, scene: Scene, behind_s: float | None) -> None:
        """Show time, numbers and events of a scene.

        `behind_s` is how long ago it was, s; None where that does not matter.
        """
        self._timeline.show(scene.tick)
        self._plots.show(scene.tick)
        if self._target is not None:
            self._target.show(scene)
        if self._links is not None:
            self._links.show()
        self._flight.content = panel_values.flight(scene, self._duration_s, behind_s)
        self._agents.content = panel_values.agents(scene, self._setup.owned, self._period_s)

    def close_controls(self) -> None:
        """Hide the controls of a live run, which has ended, and show its whole time."""
        for widget in self._of_run:
            widget.visible = False
        if self._target is not None:
            self._target.close()
        self._plots.show_whole()

    def _add_playback(self, gui: Any, view3d: View3D, *, is_live: bool) -> None:
        """Add the widgets below the time: playback and camera."""
        playback = self._playback
        self._play = gui.add_button("Play")
        self._play.on_click(lambda _: playback.toggle())
        speed = gui.add_slider("speed", 0.1, 4.0, 0.1, playback.speed)
        speed.on_update(from_browser(partial(setattr, playback, "speed")))
        self._follow = gui.add_checkbox("follow the run", playback.follows, visible=is_live)
        self._follow.on_update(from_browser(playback.follow))
        self._of_run.append(self._follow)
        camera = gui.add_button_group("camera", ("whole path", "team"))
        camera.on_click(from_browser(lambda value: view3d.look_at(team=value == "team")))


def _add_layers(gui: Any, view3d: View3D) -> None:
    """Add switches for the layers of the drawing, and the legend."""
    for name in LAYERS:
        switch = gui.add_checkbox(name, True)
        switch.on_update(from_browser(partial(view3d.show_layer, name)))
    gui.add_html(panel_values.legend())


def _add_processes(gui: Any, setup: Setup, commands: Commands) -> Any:
    """Return a folder with buttons that kill and restart each agent."""
    folder = gui.add_folder("Processes")
    with folder:
        for agent in setup.agents:
            buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
            buttons.on_click(from_browser(partial(commands.fault, target=agent_name(agent))))
    return folder
