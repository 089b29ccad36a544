"""The motion of one UAV by its own sensors alone: position, velocity, attitude, body rates and specific force.

Source: docs/equations.md (31d), (31e).
"""

from collections.abc import Callable, Sequence

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.model.physics.rotations import euler_rates, rotation
from transport.mpc.alone.uav_motion import UavMotion

# Observer of the rod from the specific force: fast enough for the pendulum of a rod, slow enough for
# the noise.
_FREQUENCY_RAD_S = 3.0
_DAMPING_RATIO = 0.7
# Growth of the offset, 1/s, and of its rate, 1/s^2, by the deviation of the measured rod from the offset.
OFFSET_GAIN = 2.0 * _DAMPING_RATIO * _FREQUENCY_RAD_S
RATE_GAIN = _FREQUENCY_RAD_S**2
# Tension from which on a rod shows its direction, as a share of that at hover. With less the noise of
# the accelerometer and the error of the thrust have a large part in the direction.
_TAUT = 0.25
_THRUST_AXIS_B = np.array([0.0, 0.0, 1.0])  # third axis of the body: the thrust is against it


class OwnSensors:
    """Observer of the motion of one UAV, 0-based: `observe` at each tick with measurements, then ask for `motion`.

    Measurements of a UAV whose sensors fail are first `completed`. The reference of both methods is the
    motion that the UAV follows, by tick.

    Args:
        hover_tension_N: Tension of its rod at hover.
        ages: Sampling periods from position, velocity, attitude, body rates and specific force to
            their measurements.
    """

    def __init__(
        self, system: System, uav: int, hover_tension_N: float, ages: Sequence[int], period_s: float
    ) -> None:
        self._mass = system.uavs[uav].mass
        self._across, self._along = system.uavs[uav].drag
        self._rod_length = system.uavs[uav].rod_length
        self._taut_N = max(_TAUT * hover_tension_N, 0.0)  # a rod that pushes shows no direction
        self._gravity_I = np.array([0.0, 0.0, system.gravity])
        self._period_s = period_s
        self._ages = tuple(ages)
        # Newest tick with measurements, and these, (15,), dead reckoning included.
        self._newest: tuple[int, Array] | None = None
        # Deviation of the rod's lower end from the reference, sigma, m, and its rate, nu, m/s.
        self._offset_I = np.zeros(3)
        self._rate_I = np.zeros(3)

    def completed(self, sensed: Array, missing: int, tick: int) -> Array:
        """Return measurements of a tick, (15,), with dead reckoning in place of the missing ones.

        Before any complete measurement the missing ones stay as they are. Missing sensors are bits
        (`model.state.SENSORS`). Source: docs/equations.md (31i).
        """
        complete = sensed
        if missing and self._newest is not None:
            since, before = self._newest
            reckoned = self._reckoned(before, (tick - since) * self._period_s)
            places = [state.is_measured(i // 3, missing) for i in range(state.SENSED)]
            complete = np.where(places, sensed, reckoned)
        self._newest = tick, complete
        return complete

    def _reckoned(self, sensed: Array, duration_s: float) -> Array:
        """Return the measurements some time later, (15,), by the rates that others of them have."""
        Theta = sensed[state.THETA]
        acceleration_I = rotation(Theta) @ sensed[state.SPECIFIC_FORCE] + self._gravity_I

        #   r+ = r + T v,  v+ = v + T (R f + g),  Theta+ = Theta + T E omega
        reckoned = sensed.copy()
        reckoned[state.POSITION] += duration_s * sensed[state.VELOCITY]
        reckoned[state.VELOCITY] += duration_s * acceleration_I
        reckoned[state.THETA] += duration_s * euler_rates(Theta) @ sensed[state.OMEGA]
        return reckoned

    def observe(
        self, sensed: Array, thrust_N: float, tick: int, reference: Callable[[int], UavMotion]
    ) -> None:
        """Correct the estimate of the rod by measurements of a tick, (15,), with the thrust until it.

        A rod that is slack, or pushes, shows no direction: the estimate stays.
        Source: docs/equations.md (31d).
        """
        rod_ref_I = self._delayed(reference, tick)[4].rod_I

        # m a - f - drag, the force of the rod on the UAV
        R = rotation(sensed[state.THETA])
        pull_I = R @ (self._mass * sensed[state.SPECIFIC_FORCE] + thrust_N * _THRUST_AXIS_B)
        if self._across or self._along:
            # d v + (d^z - d) (b . v) b
            v_I = sensed[state.VELOCITY]
            b_I = R @ _THRUST_AXIS_B
            pull_I += self._across * v_I + (self._along - self._across) * (b_I @ v_I) * b_I
        tension_N = float(pull_I @ rod_ref_I) / self._rod_length
        if not tension_N > self._taut_N:
            return

        # sigma' = nu + 2 zeta omega (s - s_ref - sigma),  nu' = omega^2 (s - s_ref - sigma)
        strength_N = float(np.linalg.norm(pull_I))
        error_I = self._rod_length / strength_N * pull_I - rod_ref_I - self._offset_I
        self._offset_I = self._offset_I + self._period_s * (self._rate_I + OFFSET_GAIN * error_I)
        self._rate_I = self._rate_I + self._period_s * RATE_GAIN * error_I

    def motion(
        self, sensed: Array, tick: int, start: int, reference: Callable[[int], UavMotion]
    ) -> UavMotion:
        """Return the motion at tick `start` from measurements of a tick, (15,), and the estimate of the rod.

        Each measurement is compared with the reference of its time; deviations of position and attitude
        go on at their rates. Source: docs/equations.md (31e).
        """
        position_ref, velocity_ref, attitude_ref, rates_ref, _ = self._delayed(reference, tick)
        there = reference(start)

        velocity_I = sensed[state.VELOCITY] - velocity_ref.velocity_I
        omega_B = sensed[state.OMEGA] - rates_ref.omega_B
        moving_s = self._period_s * (start - tick + self._ages[0])
        turning_s = self._period_s * (start - tick + self._ages[2])
        position_I = sensed[state.POSITION] - position_ref.position_I + moving_s * velocity_I
        Theta = sensed[state.THETA] - attitude_ref.Theta + turning_s * omega_B
        return UavMotion(
            position_I=there.position_I + position_I,
            velocity_I=there.velocity_I + velocity_I,
            Theta=there.Theta + Theta,
            omega_B=there.omega_B + omega_B,
            rod_I=there.rod_I + self._offset_I,
            swing_I=there.swing_I + self._rate_I,
        )

    def _delayed(self, reference: Callable[[int], UavMotion], tick: int) -> tuple[UavMotion, ...]:
        """Return the reference at the time that each measurement of a tick is of."""
        return tuple(reference(max(tick - age, 0)) for age in self._ages)
