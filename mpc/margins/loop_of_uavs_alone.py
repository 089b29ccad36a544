"""Linear analysis of UAVs that all follow the reference alone, about hover, each by its own sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System
from transport.mpc.alone.alone_law import GAINS, AloneLaw
from transport.mpc.alone.motion_by_own_sensors import OFFSET_GAIN, RATE_GAIN
from transport.mpc.alone.uav_motion import MotionSlopes, hover_motion_slopes
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import DelayedStep, Mismatch, delayed_step
from transport.mpc.margins.sampled_loop import SampledLoop
from transport.mpc.settings_period_horizon_weights import AloneGains

_QUANTITIES = len(
    state.SENSORS
)  # that a UAV measures: position, velocity, attitude, body rates, force
_LEVEL = np.eye(3)[:2]  # the observer of the rod deviates from hover in x and y only


class AloneLoop(SampledLoop):
    """The sampled loop of UAVs alone, with their integrals. Source: docs/equations.md (31a)-(31e), (60).

    With `next_tick` inputs act a sampling period after the measurement, and deviations go on until then.

    Args:
        gains: Gains of their law.
        ages: Sampling periods from position, velocity, attitude, body rates and specific force to their
            measurements by the vehicles' sensors, from which an observer has the swing; None: the state
            is known.
        known_lag_s: Time constant of the motors that the team knows.
    """

    def __init__(
        self,
        system: System,
        period_s: float,
        *,
        next_tick: bool,
        gains: AloneGains = GAINS,
        ages: Sequence[int] | None = None,
        known_lag_s: float = 0.0,
    ) -> None:
        self.known_lag_s = known_lag_s
        self.period_s = period_s
        self._system = system
        self._ahead = int(next_tick)  # sampling periods from the measurement until inputs act
        self._ages = (0,) * _QUANTITIES if ages is None else tuple(ages)
        self._moving_s = period_s * (self._ahead + self._ages[0])
        self._observes = ages is not None and gains.swing > 0.0
        at_rest = hover(system)
        self._T = tangent(at_rest.x)
        self._kept = 1.0 - period_s / gains.forgets_s
        thrusts_N = at_rest.u[:: state.INPUTS]
        laws = [AloneLaw(system, uav, float(thrusts_N[uav]), gains) for uav in range(system.N)]

        # By deviations as old as each of the five quantities, by the integrals, by the observers' velocity
        # of the rods, and by the inputs in force until the new ones act.
        self._by_motion = np.zeros((_QUANTITIES, system.m, self._T.shape[1]))
        self._by_integral = np.zeros((system.m, 3 * system.N))
        self._by_observed = np.zeros((system.m, 2 * system.N))
        self._by_before = np.zeros((system.m, system.m))
        # Change of the integrals' forces by deviations of position, and the rods' ends that are measured.
        self._integrals = np.zeros((2, 3 * system.N, self._T.shape[1]))
        self._rods = np.zeros((2 * system.N, self._T.shape[1]))
        for uav, law in enumerate(laws):
            self._add(uav, law)

    def _add(self, uav: int, law: AloneLaw) -> None:
        """Add the feedback of a UAV, 0-based: du = sum_i (gain by quantity i) (slope of i) T xi, (31a)-(31c)."""
        own_inputs = state.input_slice(uav)
        slopes = hover_motion_slopes(self._system, uav)
        T_own = self._T[state.uav_slice(uav)]
        # What its sensors measure, by deviations xi: position, velocity, attitude, body rates.
        sensed = [
            slopes.position_I @ self._T,
            slopes.velocity_I @ self._T,
            T_own[state.THETA],
            T_own[state.OMEGA],
        ]

        # Deviations of position and attitude go on at their rates to the time at which inputs act: a gain
        # by position counts for velocity as well, times that time, and one by attitude for body rates.
        turning_s = self.period_s * (self._ahead + self._ages[2])
        by_sensors = law.by_sensors()
        by_position = by_sensors[:, state.POSITION]
        by_attitude = by_sensors[:, state.THETA]
        by_velocity = by_sensors[:, state.VELOCITY] + self._moving_s * by_position
        by_rates = by_sensors[:, state.OMEGA] + turning_s * by_attitude
        if self._ahead:
            # The inputs in force turn the UAV until the new ones act.
            before, tilted, turned = law.by_inputs_before(self.period_s)
            self._by_before[own_inputs, own_inputs] = before
            half_way_s = turning_s - 0.5 * self.period_s
            by_attitude = by_attitude + tilted
            by_rates = by_rates + turned + half_way_s * tilted
        for i, slope in enumerate([by_position, by_velocity, by_attitude, by_rates]):
            self._by_motion[i, own_inputs] = slope @ sensed[i]

        self._add_integral(uav, law, slopes)
        if self._observes:
            own_rod = slice(2 * uav, 2 * uav + 2)
            self._by_observed[own_inputs, own_rod] = law.by_swing() @ _LEVEL.T
            self._rods[own_rod] = _LEVEL @ slopes.rod_I @ self._T
        else:
            self._by_motion[3, own_inputs] += law.by_swing() @ slopes.swing_I @ self._T

    def _add_integral(self, uav: int, law: AloneLaw, slopes: MotionSlopes) -> None:
        """Add the integral of a UAV."""
        own = slice(3 * uav, 3 * uav + 3)
        by_position = law.by_position()
        self._by_integral[state.input_slice(uav), own] = law.by_integral()
        self._integrals[0, own] = by_position @ slopes.position_I @ self._T
        self._integrals[1, own] = self._moving_s * by_position @ slopes.velocity_I @ self._T

    def matrix(self, plant: Mismatch) -> Array:
        """Return the step of motion, integrals, observers, past deviations and inputs that have not arrived.

        Raises: ParameterError: the bodies have no hover.
        """
        plant_step = delayed_step(self._system, self._T, plant, self.period_s)
        before = self._blocks(plant_step)
        deviations = [before.motion[: self._T.shape[1]], *before.past]  # by age, in periods

        offset = before.offset
        rate = before.rate
        if self._observes:
            #   sigma' = nu + G_sigma (s - sigma),  nu' = G_nu (s - sigma)    (31d)
            error = self._rods @ deviations[self._ages[4]] - offset
            offset = offset + self.period_s * (rate + OFFSET_GAIN * error)
            rate = rate + self.period_s * RATE_GAIN * error

        # The command of each UAV by what its sensors tell, by its integral and by inputs in force.
        issued = self._by_integral @ before.integrals + self._by_before @ before.commands[0]
        for by_motion, age in zip(self._by_motion, self._ages, strict=True):
            issued = issued + by_motion @ deviations[age]
        if self._observes:
            issued = issued + self._by_observed @ rate

        commands = [issued, *before.commands]  # newest first
        moved = plant_step.moved(before.motion, commands[self._ahead :])
        integrals = self._kept * before.integrals
        for by_motion, age in zip(self._integrals, self._ages[:2], strict=True):
            integrals = integrals + self.period_s * (by_motion @ deviations[age])
        return np.vstack([moved, integrals, offset, rate, *deviations[:-1], *commands[:-1]])

    def _blocks(self, plant_step: DelayedStep) -> "_Blocks":
        """Return the parts of the whole state, as rows of the identity."""
        observed = len(self._rods) if self._observes else 0
        past = [self._T.shape[1]] * max(self._ages)
        commands = [self._system.m] * (self._ahead + plant_step.late + 1)
        sizes = [plant_step.size, 3 * self._system.N, observed, observed, *past, *commands]
        parts = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
        first_command = len(sizes) - len(commands)
        return _Blocks(
            motion=parts[0],
            integrals=parts[1],
            offset=parts[2],
            rate=parts[3],
            past=parts[4:first_command],
            commands=parts[first_command:],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Blocks:
    """Parts of the state of the loop, as rows of the identity of the whole."""

    motion: Array  # of the plant, with the actual inputs of its motors
    integrals: Array  # forces of the integrals
    offset: Array  # of the observers of the rods
    rate: Array
    past: Sequence[Array]  # deviations one, two, .. periods ago
    commands: Sequence[Array]  # newest first
