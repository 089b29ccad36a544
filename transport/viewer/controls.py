"""Controls of a live run in the viewer: its target, its links and its processes."""

import threading
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
# A drag of a slider reports every step, and steps that follow each other closely are one target; a page sends what is
# typed later than a click, by less, s.
_REST_S = 0.3
_ALL = "all links"
# Largest number of links in the drop-down; others are changed on the command line.
_MOST_LINKS = 90


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget, if a browser has changed it and not this process."""
    return lambda event: None if event.client_id is None else act(event.target.value)


class _AfterRest:
    """Calls a function once it has not been asked to for a while."""

    def __init__(self, act: Callable[[], None]) -> None:
        self._act, self._timer = act, threading.Timer(0.0, act)

    def __call__(self, _: object = None) -> None:
        self._timer.cancel()
        self._timer = threading.Timer(_REST_S, self._act)
        self._timer.daemon = True
        self._timer.start()


class TargetControls:
    """Widgets in a folder that send the payload somewhere: a handle to drag, numbers, steps and keys."""

    def __init__(self, server: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._builder, self._go, self._targets = builder, commands.target, 0
        self._asked: list[list[float]] = []  # and not yet seen in the run
        self._dragged_from, self._problem = np.zeros(3), ""
        self._place_I: Array = builder.setup.maneuver.path(np.zeros(1))[0][0]
        self._send_after_rest = _AfterRest(self._send)
        gui = server.gui
        self.folder = gui.add_folder("Target")
        with self.folder:
            self._state = gui.add_html("")
            # Three number fields would lose the sign of -0.5 while it is typed: they show -0 as 0.
            self._typed = gui.add_text("x, y, z (m)", _in_text(self._place_I), hint="inertial frame: z points down")
            there = gui.add_button("Go there", hint="as transport target X Y Z; or drag the arrows in the scene")
            self._step = gui.add_number("step (m)", _STEP_M, min=0.05, max=10.0, step=0.05)
            steps = gui.add_button_group("step", tuple(STEPS), hint="Shift and arrows, Page Up, Page Down")
        self._handle = server.scene.add_transform_controls(
            "/target", scale=0.6, disable_rotations=True, disable_sliders=True, position=tuple(self._place_I)
        )
        there.on_click(self._send_after_rest)
        steps.on_click(from_browser(self._move))
        self._typed.on_update(from_browser(self._type))
        self._handle.on_update(self._dragged)
        self._keys = []
        for label, (_, key) in STEPS.items():
            command = gui.add_command(f"target: one step {label}", hotkey=key, modifier="shift")
            command.on_trigger(partial(self._move, label))
            self._keys.append(command)

    def show(self, scene: Scene) -> None:
        """Show the target of a scene; a new target of others moves the controls, own ones leave what was set since."""
        targets = self._builder.setup.maneuver.targets
        for target in targets[self._targets :]:
            if (place := target.end_I.tolist()) in self._asked:
                del self._asked[: self._asked.index(place) + 1]
            else:
                self._set(target.end_I)
        self._targets = len(targets)
        known = [target for target in targets if target.since_s <= scene.time_s]
        state = html.target(known[-1].end_I, known[-1].ends_s, scene) if known else ""
        self._state.content = html.notice(self._problem, warning=True) + state

    def close(self) -> None:
        """Remove handle and keys when the run has ended."""
        self._handle.visible = False
        for command in self._keys:
            command.remove()
        self._keys.clear()

    def _move(self, label: str, _: object = None) -> None:
        """Move the target by a step, and send it once the steps rest."""
        self._set(self._place_I + self._step.value * np.array(STEPS[label][0]))
        self._send_after_rest()

    def _set(self, place: Array) -> None:
        self._handle.position = self._place_I = place
        self._typed.value, self._problem = _in_text(place), ""

    def _type(self, text: str) -> None:
        try:
            x, y, z = map(float, text.replace(",", " ").split())
            place = np.array([x, y, z])
        except ValueError:
            place = np.array([np.nan])
        self._problem = "" if np.isfinite(place).all() else f"expected three numbers, got {text[:40]!r}"
        if not self._problem:
            self._handle.position = self._place_I = place

    def _dragged(self, event: Any) -> None:
        """Show where the handle is; send the target once it is let go, unless it was only clicked."""
        place = np.array(self._handle.position)
        if event.phase == "start":
            self._dragged_from = place
        self._place_I = np.round(place, 2) + 0.0  # without -0
        self._typed.value, self._problem = _in_text(self._place_I), ""
        if event.phase == "end" and not np.array_equal(self._dragged_from, place):
            self._send()

    def _send(self) -> None:
        if not self._problem:
            self._asked.append(self._place_I.tolist())
            self._go(self._place_I)


class LinkControls:
    """Widgets in a folder that delay, impair and cut links between agents, one in one direction or all."""

    def __init__(self, gui: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._builder, self._commands = builder, commands
        agents = builder.setup.agents
        self._pairs = [(a, b) for a in agents for b in agents if a != b]
        self._ends = {_ALL: None} | {f"{a} to {b}": (a, b) for a, b in self._pairs[:_MOST_LINKS]}
        self._shown = False
        self._moved: set[str] = set()  # keys of links whose widgets a user has moved, not yet sent
        self.folder = gui.add_folder("Links", visible=bool(self._pairs))
        with self.folder:
            self._link = gui.add_dropdown("link", tuple(self._ends))
            self._delay = gui.add_slider("delay (s)", 0.0, 1.0, 0.01, 0.0, hint="as transport link set --delay")
            self._loss = gui.add_slider("loss (%)", 0, 100, 1, 0, hint="30 % is transport link set --loss 0.3")
            self._partition = gui.add_checkbox("partition", False, hint="100 % loss, as --loss 1")
            clear = gui.add_button("Clear all links", hint="as transport link clear")
        self._link.on_update(from_browser(self._choose))
        send = _AfterRest(self._send)
        for widget, key in ((self._delay, "delay_s"), (self._loss, "loss"), (self._partition, "loss")):
            widget.on_update(from_browser(partial(self._move, key, send)))
        clear.on_click(lambda _: self._clear())

    def begin(self) -> None:
        """Show the links as the run has them, until a user moves one."""
        if not self._shown:
            self._shown = True
            self._choose(_ALL)

    def _choose(self, link: str) -> None:
        """Show the values of a link, or the largest of all links."""
        ends, last = self._ends[link], max(0, self._builder.history.last)
        found = [self._builder.link_history.settings(*pair, last) for pair in ([ends] if ends else self._pairs)]
        if found:
            delays_s, losses = zip(*found, strict=True)
            self._show(max(delays_s), max(losses))

    def _show(self, delay_s: float, loss: float) -> None:
        self._delay.value = min(round(delay_s, 2), 1.0)
        self._loss.value, self._partition.value = round(100.0 * loss), loss >= 1.0

    def _move(self, key: str, send: Callable[[], None], _: object) -> None:
        self._moved.add(key)
        send()

    def _send(self) -> None:
        loss = 1.0 if self._partition.value else self._loss.value / 100.0
        values = {"delay_s": round(self._delay.value, 3), "loss": loss}
        moved, self._moved = self._moved, set()
        self._commands.link(self._ends[self._link.value], {key: values[key] for key in sorted(moved)})

    def _clear(self) -> None:
        self._show(0.0, 0.0)
        self._commands.clear()


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
