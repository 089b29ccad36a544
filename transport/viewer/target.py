"""Controls of the viewer that send the payload of a live run somewhere: a handle to drag, numbers, steps and keys."""

import threading
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from model.arrays import Array
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html

if TYPE_CHECKING:
    import viser

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
# Steps that follow each other this closely are one target; a page sends what is typed later than a click, by less, s.
_REST_S = 0.3


class TargetControls:
    """Widgets of a target; `go` is called with its position, (3,), inertial frame, m."""

    def __init__(
        self,
        server: "viser.ViserServer",
        builder: SceneBuilder,
        go: Callable[[Array], None],
        checked: Callable[[Callable[[Any], None]], Callable[[Any], None]],
    ) -> None:
        self._builder, self._go, self._targets = builder, go, 0
        self._timer: threading.Timer | None = None
        self._asked: list[list[float]] = []  # and not yet seen in the run
        self._dragged_from, self._problem = np.zeros(3), ""
        self._place_I = builder.setup.maneuver.path(np.zeros(1))[0][0]
        gui = server.gui
        self._folder = gui.add_folder("Target")
        with self._folder:
            self._state = gui.add_html("")
            # Three number fields would lose the sign of -0.5 while it is typed: they show -0 as 0.
            self._typed: Any = gui.add_text(
                "x, y, z (m)", _in_text(self._place_I), hint="inertial frame: z points down"
            )
            there = gui.add_button("Go there", hint="as transport target X Y Z; or drag the arrows in the scene")
            self._step = gui.add_number("step (m)", _STEP_M, min=0.05, max=10.0, step=0.05)
            steps = gui.add_button_group("step", tuple(STEPS), hint="Shift and arrows, Page Up, Page Down")
        self._handle = server.scene.add_transform_controls(
            "/target", scale=0.6, disable_rotations=True, disable_sliders=True, position=tuple(self._place_I)
        )
        there.on_click(checked(lambda _: self._send_after_rest()))
        steps.on_click(checked(lambda event: self._move(STEPS[event.target.value][0])))
        self._typed.on_update(checked(lambda event: self._show_typed(event.client_id)))
        self._handle.on_update(checked(self._dragged))
        self._keys = []
        for label, (direction, key) in STEPS.items():
            command = gui.add_command(f"target: one step {label}", hotkey=key, modifier="shift")  # type: ignore[arg-type]
            command.on_trigger(checked(partial(self._stepped, direction)))
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
        """Hide the controls of a run that has ended."""
        self._folder.visible = self._handle.visible = False
        for command in self._keys:
            command.remove()
        self._keys.clear()

    def _stepped(self, direction: tuple[float, float, float], _: Any) -> None:
        self._move(direction)

    def _move(self, direction: tuple[float, float, float]) -> None:
        """Move the target by a step, and send it once the steps rest."""
        self._set(self._place_I + self._step.value * np.array(direction))
        self._send_after_rest()

    def _send_after_rest(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(_REST_S, self._send)
        self._timer.daemon = True
        self._timer.start()

    def _set(self, place: Array) -> None:
        self._handle.position = self._place_I = place
        self._typed.value, self._problem = _in_text(place), ""

    def _show_typed(self, client: int | None) -> None:
        if client is None:  # viser also reports the changes of this process
            return
        place = _place_in(self._typed.value)
        self._problem = "" if place is not None else f"expected three numbers, got {self._typed.value[:40]!r}"
        if place is not None:
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


def _in_text(place: Array) -> str:
    return ", ".join(f"{value:g}" for value in place)


def _place_in(text: str) -> Array | None:
    """Return the position in a text, (3,), m; None if it is none."""
    try:
        place = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        return None
    return place if place.shape == (3,) and np.isfinite(place).all() else None
