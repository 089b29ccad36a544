"""Controls of a live run in the viewer: its target, its links and its processes."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from model.arrays import Array
from protocol.wire.messages import agent_name
from transport.flight.live import Commands
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html

# Steps in the inertial frame by the labels of their buttons, and the keys for them, with Shift: alone, arrows move
# sliders.
STEPS = {
    "-x": ((-1.0, 0.0, 0.0), "arrowleft"),
    "+x": ((1.0, 0.0, 0.0), "arrowright"),
    "-y": ((0.0, -1.0, 0.0), "arrowup"),
    "+y": ((0.0, 1.0, 0.0), "arrowdown"),
    "up": ((0.0, 0.0, -1.0), "pageup"),
    "down": ((0.0, 0.0, 1.0), "pagedown"),
}
_STEP_M = 0.5
_TYPED_S = 0.3  # a page sends what is typed later than a click, by less
_ALL = "all links"


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget, if a browser has changed it and not this process."""
    return lambda event: None if event.client_id is None else act(event.target.value)


class TargetControls:
    """Widgets in a folder that send the payload somewhere: a handle to drag, numbers, steps and keys."""

    def __init__(self, server: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._builder, self._go, gui = builder, commands.target, server.gui
        self._place_I: Array = builder.setup.maneuver.path(np.zeros(1))[0][0]
        self._dragged_from = self._place_I
        self.folder = gui.add_folder("Target")
        with self.folder:
            self._state = gui.add_html("")
            # Three number fields would lose the sign of -0.5 while it is typed: they show -0 as 0.
            self._typed = gui.add_text("x, y, z (m)", _in_text(self._place_I), hint="inertial frame: z points down")
            there = gui.add_button("Go there", hint="as transport target X Y Z; or drag the arrows in the scene")
            steps = gui.add_button_group(f"{_STEP_M:g} m", tuple(STEPS), hint="Shift and arrows, Page Up, Page Down")
        self._handle = server.scene.add_transform_controls(
            "/target", scale=0.6, disable_rotations=True, disable_sliders=True, position=tuple(self._place_I)
        )
        there.on_click(self._typed_place)
        steps.on_click(from_browser(self._step))
        self._handle.on_update(self._dragged)
        self._keys = []
        for label, (_, key) in STEPS.items():
            command = gui.add_command(f"target: one step {label}", hotkey=key, modifier="shift")
            command.on_trigger(partial(self._step, label))
            self._keys.append(command)

    def show(self, scene: Scene) -> None:
        """Show the target of a scene."""
        known = [target for target in self._builder.setup.maneuver.targets if target.since_s <= scene.time_s]
        self._state.content = html.target(known[-1].end_I, known[-1].ends_s, scene) if known else ""

    def close(self) -> None:
        """Remove handle and keys when the run has ended."""
        self._handle.visible = False
        for command in self._keys:
            command.remove()

    def _set(self, place_I: Array) -> None:
        self._handle.position = self._place_I = place_I
        self._typed.value = _in_text(place_I)

    def _step(self, label: str, _: object = None) -> None:
        self._set(self._place_I + _STEP_M * np.array(STEPS[label][0]))
        self._go(self._place_I)

    def _typed_place(self, event: Any) -> None:
        time.sleep(_TYPED_S)
        try:
            x, y, z = map(float, self._typed.value.replace(",", " ").split())
        except ValueError:
            event.client.add_notification("Target", f"expected three numbers, got {self._typed.value[:40]!r}")
            return
        self._set(np.array([x, y, z]))
        self._go(self._place_I)

    def _dragged(self, event: Any) -> None:
        """Show where the handle is; send the target once it is let go, unless it was only clicked."""
        place_I = np.array(self._handle.position)
        if event.phase == "start":
            self._dragged_from = place_I
        self._place_I = np.round(place_I, 2) + 0.0  # without -0
        self._typed.value = _in_text(self._place_I)
        if event.phase == "end" and not np.array_equal(self._dragged_from, place_I):
            self._go(self._place_I)


class LinkControls:
    """Widgets in a folder that delay, impair and cut links between agents, one in one direction or all."""

    def __init__(self, gui: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._links, agents = builder.link_history, builder.setup.agents
        self._history, self._pairs = builder.history, [(a, b) for a in agents for b in agents if a != b]
        self._ends = {_ALL: None} | {f"{a} to {b}": (a, b) for a, b in self._pairs}
        self.folder = gui.add_folder("Links", visible=bool(self._pairs))
        with self.folder:
            self._link = gui.add_dropdown("link", tuple(self._ends))
            self._delay = gui.add_slider("delay (s)", 0.0, 1.0, 0.01, 0.0, hint="as transport link set --delay")
            self._loss = gui.add_slider("loss (%)", 0, 100, 1, 0, hint="30 % is transport link set --loss 0.3")
            change = gui.add_button("Set", hint="delay and loss of the chosen link, or of all")
            clear = gui.add_button("Clear all links", hint="as transport link clear")
        self._choose(_ALL)
        self._link.on_update(from_browser(self._choose))
        change.on_click(lambda _: commands.link(self._ends[self._link.value], self._values()))
        clear.on_click(lambda _: commands.clear())

    def _choose(self, link: str) -> None:
        """Show the values of a link, or the largest of all links."""
        ends, last = self._ends[link], max(0, self._history.last)
        found = [self._links.settings(*pair, last) for pair in ([ends] if ends else self._pairs)]
        if found:
            delay_s, loss = np.max(found, axis=0).tolist()
            self._delay.value, self._loss.value = min(round(delay_s, 2), 1.0), round(100.0 * loss)

    def _values(self) -> dict[str, float]:
        return {"delay_s": round(self._delay.value, 3), "loss": self._loss.value / 100.0}


def add_processes(gui: Any, builder: SceneBuilder, commands: Commands) -> Any:
    """Return a folder with buttons that kill and restart each agent."""
    folder = gui.add_folder("Processes")
    with folder:
        for agent in builder.setup.agents:
            buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
            buttons.on_click(from_browser(partial(commands.fault, target=agent_name(agent))))
    return folder


def _in_text(place: Array) -> str:
    return ", ".join(f"{value:g}" for value in place)
