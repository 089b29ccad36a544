"""Motors of the plant, between the commands of the plans and the wrench on the UAVs, for any physics engine.

In this order: the command's thrust is rounded to its steps; thrust and moments are distributed to the four rotors,
limited there, and summed up again; the result follows with a first-order lag, or each rotor with a lag for rising and
one for falling thrust; what arrives is multiplied by the efficiency of the UAV's motors. Each stage that a scenario
does not name is left out.
"""

from collections.abc import Iterator

import numpy as np

from model import motors, state
from model.arrays import Array
from protocol.scenario.plant_sections import MotorsSection, RotorsSection

# Signs of a rotor's arm along y, along x, and of its drag moment: front right, rear left (both turning
# counterclockwise seen from above), front left, rear right (clockwise); arms at 45 deg to the axes, x forward, z down.
_ARMS_Y = (1.0, -1.0, -1.0, 1.0)
_ARMS_X = (1.0, -1.0, 1.0, -1.0)
_DRAG = (1.0, 1.0, -1.0, -1.0)


class Rotors:
    """Four equal rotors of a UAV; `mixing` has (thrust, moments) per rotor thrust, (4, 4), the moments in m."""

    def __init__(self, section: RotorsSection) -> None:
        arm = section.arm_m / np.sqrt(2.0)
        self._least, self._most = section.thrust_N
        # A thrust f against z at (x, y) has the moments -y f about x and x f about y.
        self.mixing = np.vstack(
            [np.ones(4), -arm * np.array(_ARMS_Y), arm * np.array(_ARMS_X), section.drag_to_thrust_m * np.array(_DRAG)]
        )
        self._back = np.linalg.inv(self.mixing)

    def thrusts(self, inputs: Array) -> Array:
        """Return the thrusts of the rotors that make inputs, (N, 4) each."""
        return np.asarray(inputs @ self._back.T)

    def limited(self, inputs: Array) -> Array:
        """Return the inputs that limited rotors make of commands, (N, 4). Source: docs/equations.md (56)."""
        thrusts = self.thrusts(inputs)
        # The difference alone is mixed back, so that commands within the limits pass without rounding.
        limited: Array = inputs + (np.clip(thrusts, self._least, self._most) - thrusts) @ self.mixing.T
        return limited


class Motors:
    """Motors of all UAVs, with their state: hover at first, (4 N,). `fails` tells that an efficiency will change.

    Without any stage they are `ideal`: actual inputs are the commands.
    """

    def __init__(self, section: MotorsSection, u_hover: Array, fails: bool = False) -> None:
        self.ideal = not (fails or section.lag_s or section.thrust_step_N or section.rotors)
        self._section = section
        self._rotors = None if section.rotors is None else Rotors(section.rotors)
        self._a: Array = u_hover.copy()  # what the lag has reached
        self._efficiency = np.ones(len(u_hover))

    def degrade(self, uav: int, efficiency: float) -> None:
        """Set the share of the inputs that a UAV's motors, 0-based, give from now on; 0 with the motors off."""
        self._efficiency[state.input_slice(uav)] = efficiency

    def inputs(self, u: Array, period_s: float, steps: int) -> Iterator[tuple[Array, float]]:
        """Yield the actual inputs over a period, (4 N,), and how long each is held, s; the state advances with them.

        Given are the command, held, (4 N,), and the number of integration steps. Without lag this is one input for the
        period; with lag two for each integration step. Source: docs/equations.md (53), (54).
        """
        if self.ideal:
            yield u, period_s
            return
        command = self._limited(u)
        if self._section.lag_s == 0.0:
            yield self._efficiency * command, period_s
            return
        for _ in range(steps):
            halves, self._a = self._lagged(command, period_s / steps)
            for half in halves:
                yield self._efficiency * half, period_s / steps / 2.0

    def _lagged(self, command: Array, step_s: float) -> tuple[tuple[Array, Array], Array]:
        """Return two inputs for half a step each, and those at its end, (4 N,). Source: docs/equations.md (54), (56a).

        Under a held command the thrust of a rotor rises or falls all the time.
        """
        rising, rotors = motors.held(self._a, command, self._section.lag_s, step_s), self._rotors
        if rotors is None or self._section.falling_lag_s is None:
            return rising
        falling = motors.held(self._a, command, self._section.falling_lag_s, step_s)
        falls = rotors.thrusts((command - self._a).reshape(-1, state.INPUTS)) < 0.0

        def chosen(up: Array, down: Array) -> Array:
            """Return inputs, (4 N,), with the thrusts of falling rotors from the second ones."""
            change = rotors.thrusts((down - up).reshape(falls.shape))
            return np.asarray(up + (np.where(falls, change, 0.0) @ rotors.mixing.T).reshape(-1))

        first, second = (chosen(*both) for both in zip(rising[0], falling[0], strict=True))
        return (first, second), chosen(rising[1], falling[1])

    def _limited(self, u: Array) -> Array:
        """Return commands in steps of the thrust and within the limits of the rotors, (4 N,)."""
        inputs, step_N = u.reshape(-1, state.INPUTS).copy(), self._section.thrust_step_N
        if step_N:
            inputs[:, 0] = np.round(inputs[:, 0] / step_N) * step_N
        return (inputs if self._rotors is None else self._rotors.limited(inputs)).reshape(-1)
