"""Rotors and motors of UAVs: limits, steps, lag and efficiency, from commanded to actual inputs.

Motors round the command's thrust to its steps; distribute thrust and moments to the four rotors, limit
them there, and sum them up again; follow with a first-order lag, or each rotor with a lag for rising and
one for falling thrust; and multiply what arrives by the efficiency of the UAV's motors. A stage that a
scenario does not name is left out.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear import motor_lag as motors
from transport.protocol.scenario.sections.plant_sections import MotorsSection, RotorsSection


class Rotors:
    """Four equal rotors of a UAV.

    `mixing` has thrust and moments per rotor thrust, (4, 4), the moments in m. Its columns are front
    right, rear left (both turn counterclockwise seen from above), front left, rear right
    (clockwise); arms are at 45 deg to the axes, x forward, z down.
    """

    def __init__(self, section: RotorsSection) -> None:
        self._least_N, self._most_N = section.thrust_N
        s = section.arm_m / np.sqrt(2.0)
        k = section.drag_to_thrust_m
        # f = sum f_j, tau = sum (-y_j f_j, x_j f_j, +-k f_j) of thrusts f_j at (x_j, y_j): (56).
        self.mixing: Array = np.array(
            [
                [1.0, 1.0, 1.0, 1.0],
                [-s, s, s, -s],
                [s, -s, s, -s],
                [k, k, -k, -k],
            ]
        )
        self._back = np.linalg.inv(self.mixing)

    def thrusts(self, inputs: Array) -> Array:
        """Return the thrusts of the rotors that make inputs, (N, 4) each."""
        return np.asarray(inputs @ self._back.T)

    def limited(self, inputs: Array) -> Array:
        """Return the inputs that limited rotors make of commands, (N, 4).

        Source: docs/equations.md (56).
        """
        thrusts = self.thrusts(inputs)
        change = np.clip(thrusts, self._least_N, self._most_N) - thrusts
        # The difference alone is mixed back, so that commands within the limits pass without
        # rounding.
        limited: Array = inputs + change @ self.mixing.T
        return limited


class Motors:
    """Motors of all UAVs, with their state: hover at first, (4 N,).

    `factors` are what the motors of each UAV give over their commands, (N,). `fails` tells that an
    efficiency will change during the run. Motors without lag, steps, limits and failures are `ideal`:
    actual inputs are the commands, and are not recorded a second time. Those of a UAV whose motors are
    off are zero, also where an inner loop has given some.
    """

    def __init__(
        self,
        section: MotorsSection,
        u_hover: Array,
        *,
        fails: bool = False,
        factors: Array | None = None,
    ) -> None:
        of_uavs = np.ones(len(u_hover) // state.INPUTS) if factors is None else factors
        fails = fails or bool((of_uavs != 1.0).any())
        self.ideal = not (fails or section.lag_s or section.thrust_step_N or section.rotors)
        self._section = section
        self._rotors = None if section.rotors is None else Rotors(section.rotors)
        self._a: Array = u_hover.copy()  # what the lag has reached
        self._factors = of_uavs
        self._efficiency = np.repeat(of_uavs, state.INPUTS)

    def degrade(self, uav: int, efficiency: float) -> None:
        """Set the share of its usual inputs that a UAV's motors, 0-based, give from now on.

        0 with the motors off.
        """
        self._efficiency[state.input_slice(uav)] = self._factors[uav] * efficiency

    def inputs(self, u: Array, period_s: float, steps: int) -> Iterator[tuple[Array, float]]:
        """Yield the actual inputs over a period, (4 N,), and how long each is held, s.

        The state of the motors advances with them. Without lag there is one input for the period,
        with lag there are two for each integration step. Source: docs/equations.md (53), (54).

        Args:
            u: Command, held over the period, (4 N,).
            period_s: Its length.
            steps: Integration steps in it.
        """
        if self.ideal:
            yield self._efficiency * u, period_s
            return
        command = self._limited(u)
        if self._section.lag_s == 0.0:
            yield self._efficiency * command, period_s
            return
        for _ in range(steps):
            halves, self._a = self._held_inputs(command, period_s / steps)
            for half in halves:
                yield self._efficiency * half, period_s / steps / 2.0

    def _held_inputs(self, command: Array, step_s: float) -> tuple[tuple[Array, Array], Array]:
        """Return two inputs for half a step each, and those at its end, (4 N,).

        Source: docs/equations.md (54), (56a).
        """
        rotors = self._rotors
        section = self._section
        with_one_lag = motors.two_held_inputs(self._a, command, section.lag_s, step_s)
        if rotors is None or section.falling_lag_s is None:
            return with_one_lag

        (first_up, second_up), end_up = with_one_lag
        (first_down, second_down), end_down = motors.two_held_inputs(
            self._a, command, section.falling_lag_s, step_s
        )
        falls = rotors.thrusts((command - self._a).reshape(-1, state.INPUTS)) < 0.0
        first = _with_falling(rotors, falls, first_up, first_down)
        second = _with_falling(rotors, falls, second_up, second_down)
        return (first, second), _with_falling(rotors, falls, end_up, end_down)

    def _limited(self, u: Array) -> Array:
        """Return commands in steps of the thrust and within the limits of the rotors, (4 N,)."""
        inputs = u.reshape(-1, state.INPUTS).copy()
        step_N = self._section.thrust_step_N
        if step_N:
            inputs[:, 0] = np.round(inputs[:, 0] / step_N) * step_N
        if self._rotors is not None:
            inputs = self._rotors.limited(inputs)
        return inputs.reshape(-1)


def _with_falling(rotors: Rotors, falls: npt.NDArray[np.bool_], up: Array, down: Array) -> Array:
    """Return inputs, (4 N,): thrusts of the rotors that fall, (N, 4), as in `down`, else as in `up`.

    up + M s, with M the mixing and s = M^-1 (down - up) of a rotor that falls, else 0.
    Source: docs/equations.md (56a).
    """
    change = rotors.thrusts((down - up).reshape(falls.shape))
    of_falling = np.where(falls, change, 0.0)
    return np.asarray(up + (of_falling @ rotors.mixing.T).reshape(-1))
