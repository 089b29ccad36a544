"""Widgets that send the payload of an active run to a target: a handle, keys and numbers."""

import time
from functools import partial
from typing import Any

import numpy as np

from transport.flight.active_runs import Commands
from transport.model.arrays import Array
from transport.protocol.wire.names import agent_name
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.viewer import panel_values
from transport.viewer.server import NOTIFICATION_S

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
# A page sends what is typed later than a click, by less than this, s.
_TYPED_S = 0.3
_ALL = "all agents"


class TargetControls:
    """Widgets in a folder that send the payload to a target."""

    def __init__(self, server: Any, builder: SceneBuilder, commands: Commands) -> None:
        self._builder = builder
        self._send_target = commands.target
        gui = server.gui
        start_I: Array = builder.setup.maneuver.path(np.zeros(1))[0][0]
        self._agents = {agent_name(agent): agent for agent in builder.setup.agents}

        self.folder = gui.add_folder("Target")
        with self.folder:
            self._state = gui.add_html("")
            # Three number fields would lose the sign of -0.5 while it is typed: they show -0 as 0.
            self._typed = gui.add_text(
                "x, y, down (m)",
                _in_text(start_I),
                hint="inertial frame, z points down: an altitude of 10 m is -10",
            )
            self._told = gui.add_dropdown(
                "told",
                (_ALL, *self._agents),
                hint="the others learn it from the plans of the agent that is told",
                visible=len(self._agents) > 1 and not builder.setup.scenario.has_vehicles,
            )
            there = gui.add_button(
                "Go there", hint="as transport target X Y Z; or drag the arrows in the scene"
            )
            down = gui.add_button("Land here", hint="as transport land: down where it is, and rest")
        self.handle = server.scene.add_transform_controls(
            "/world/target",
            scale=0.6,
            disable_rotations=True,
            disable_sliders=True,
            position=tuple(start_I),
        )
        there.on_click(self._typed_target)
        down.on_click(lambda _: commands.land())
        self.handle.on_update(self._dragged)
        self._dragged_from_I = start_I

        self._keys = []
        for key, step in _STEPS.items():
            command = gui.add_command(
                f"target: {_STEP_M:g} m, shift {key}", hotkey=key, modifier="shift"
            )
            command.on_trigger(partial(self._step, _STEP_M * np.array(step)))
            self._keys.append(command)

    def show(self, scene: Scene) -> None:
        """Show the target that the payload of a scene goes to."""
        targets = [
            target
            for target in self._builder.setup.maneuver.targets
            if target.since_s <= scene.time_s
        ]
        self._state.content = (
            panel_values.target(targets[-1].end_I, targets[-1].ends_s, scene) if targets else ""
        )

    def close(self) -> None:
        """Hide handle and folder and remove the keys when the run has ended."""
        self.folder.visible = False
        self.handle.visible = False
        for command in self._keys:
            command.remove()

    def _send(self, target_I: Array) -> None:
        self.handle.position = target_I
        self._typed.value = _in_text(target_I)
        self._send_to_told(target_I)

    def _send_to_told(self, target_I: Array) -> None:
        agent = self._agents.get(self._told.value)
        self._send_target(target_I, () if agent is None else (agent,))

    def _step(self, step_I: Array, _: object) -> None:
        self._send(_to_centimetres(np.array(self.handle.position) + step_I))

    def _typed_target(self, event: Any) -> None:
        time.sleep(_TYPED_S)
        try:
            x, y, z = map(float, self._typed.value.replace(",", " ").split())
        except ValueError:
            event.client.add_notification(
                "Target",
                f"expected three numbers x, y, down, got {self._typed.value[:40]!r}",
                auto_close_seconds=NOTIFICATION_S,
            )
            return
        self._send(np.array([x, y, z]))

    def _dragged(self, event: Any) -> None:
        """Show the position of the handle; send it as target once the handle is let go.

        A handle that was only clicked sends nothing.
        """
        target_I = _to_centimetres(np.array(self.handle.position))
        self._typed.value = _in_text(target_I)
        if event.phase == "start":
            self._dragged_from_I = target_I
        elif event.phase == "end" and not np.array_equal(self._dragged_from_I, target_I):
            self._send_to_told(target_I)


def _to_centimetres(position_I: Array) -> Array:
    """Return a position, (3,), m, rounded, without negative zeros."""
    return np.asarray(np.round(position_I, 2) + 0.0)


def _in_text(position_I: Array) -> str:
    return ", ".join(f"{value:g}" for value in position_I)
