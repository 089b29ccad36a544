"""The control law of a UAV alone: it keeps to its own part of the reference by its own sensors, without any message.

Position and velocity are controlled in three axes, upwards with the share of the payload on the rod. An integral finds
wind and mass errors, and the UAV gives way to the swing of the rod, which damps it.
Source: docs/equations.md (31a)-(31c), (31g).
"""

import math
from dataclasses import replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.model.physics.rotations import rotation
from transport.mpc.alone.attitude_loop import OuterGain, attitude_loop
from transport.mpc.alone.thrust_direction import roll_and_pitch, roll_and_pitch_slopes
from transport.mpc.alone.uav_motion import (
    MotionSlopes,
    Setpoint,
    UavMotion,
    hover_motion_slopes,
    motion_slopes,
    turn_by_inputs,
)
from transport.mpc.settings_period_horizon_weights import AloneGains

GAINS = AloneGains()

# Gain from an attitude error to commanded body rates over that of the inner loop: damping ratio 0.7. The
# faster attitude loop leaves room for the position loop around it.
_OUTER = 0.5
# Stiffness of the heading over that of roll and pitch: it returns within some seconds. The moment
# about the vertical is small: an error of half a turn asks for no more than there is.
_HEADING = 0.08
_DOWN_I = np.array([0.0, 0.0, 1.0])  # the thrust of a level UAV is against it
# Roll, pitch and yaw by a force of a thrust of 1 N, inertial frame, about hover, and that force by the angles.
_TILT_BY_PULL = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_PULL_BY_TILT = _TILT_BY_PULL.T
# Time that a plan covers, s: at 20 Hz it outlasts three lost plans in a row. Moments that are held for
# longer than 0.21 s, 1 over damping ratio and frequency of the attitude loop, tip the UAV, as nothing
# predicts its feedback.
# Without a newer plan the actuators continue on `controller.fail_safe`: "follow" is (31a) along the
# same motion, by the state of the plant; "level" keeps level.
_PLAN_S = 0.2


def steps_alone(period_s: float) -> int:
    """Return how many sampling periods a plan of UAVs alone covers, to the nearest one and at least one."""
    return max(1, round(_PLAN_S / period_s))


class AloneLaw:
    """Control law of one UAV, 0-based, that carries its share of the payload with a hover thrust, N.

    A further term of the force belongs in `force`, its derivatives in `gain`, `gain_along` and
    `by_sensors`, its numbers in `numbers`, and its twin in `alone_inputs` of model/kernels/kernels.c. Tests
    compare each of them with `inputs`.
    """

    def __init__(self, system: System, uav: int, hover_N: float, gains: AloneGains = GAINS) -> None:
        self._system = system
        self._uav = uav
        self._gains = gains
        self._hover_N = hover_N
        self._swing = gains.swing * float(np.sqrt(system.uavs[uav].rod_length))

        # Diagonal of M_i. Sideways the rod gives way. Upwards the UAV lifts its share of the payload as well.
        mass = system.uavs[uav].mass
        self._masses = np.array([mass, mass, hover_N / system.gravity])

        # G_Theta and G_omega of (31c).
        outer = OuterGain(share=_OUTER, largest=gains.rates)
        frequency_rad_s = gains.attitude_rads
        loop = attitude_loop(system, uav, outer, frequency_rad_s=frequency_rad_s, heading=_HEADING)
        self._stiffness = loop.stiffness
        self._damping = loop.damping

    def numbers(self) -> Array:
        """Return the numbers of the law in the order of the struct `alone_law` of model/kernels/kernels.c, (29,)."""
        uav = self._system.uavs[self._uav]
        gains = self._gains
        rod = [uav.rho, [uav.rod_length]]
        position_loop = [gains.position, gains.velocity, self._swing, gains.steepest_rad]
        turning_loop = [self._stiffness.reshape(-1), self._damping.reshape(-1)]
        return np.concatenate([*rod, self._masses, position_loop, *turning_loop])

    def inputs(
        self, motion: UavMotion, setpoint: Setpoint, integral_I: Array | None = None
    ) -> Array:
        """Return thrust and moments, or body rates, before limits, (4,), N and N m or rad/s: (31b).

        `integral_I` is the force of the integral, (3,), N; None for none.
        """
        force_I = self.force(motion, setpoint, integral_I)

        # Theta_d has the direction of the force, near that of the setpoint's force.
        yaw = motion.Theta[2]
        roll, pitch = roll_and_pitch(force_I, yaw)
        roll_ref, pitch_ref = roll_and_pitch(setpoint.force_I, yaw)
        steepest = self._gains.steepest_rad
        roll = roll_ref + min(max(roll - roll_ref, -steepest), steepest)
        pitch = pitch_ref + min(max(pitch - pitch_ref, -steepest), steepest)

        # The shorter way round to the heading of the setpoint.
        yaw_error = math.remainder(yaw - setpoint.motion.Theta[2], 2.0 * math.pi)
        error = np.array([motion.Theta[0] - roll, motion.Theta[1] - pitch, yaw_error])

        #   tau = tau_ref - G_Theta (Theta - Theta_d) - G_omega (omega - omega_ref)   (31b)
        turning = setpoint.turning - self._stiffness @ error
        turning = turning - self._damping @ (motion.omega_B - setpoint.motion.omega_B)

        #   f = -(R k)' F   (31b)
        thrust_N = -(rotation(motion.Theta)[:, 2] @ force_I)
        return np.concatenate([[thrust_N], turning])

    def force(
        self, motion: UavMotion, setpoint: Setpoint, integral_I: Array | None = None
    ) -> Array:
        """Return the desired force of the thrust, (3,), inertial frame, N. Source: docs/equations.md (31a)."""
        gains = self._gains
        desired = setpoint.motion
        swing_I = motion.swing_I - desired.swing_I
        level_swing_I = swing_I - swing_I[2] * _DOWN_I
        acceleration = (
            gains.position * (desired.position_I - motion.position_I)
            + gains.velocity * (desired.velocity_I - motion.velocity_I)
            - self._swing * level_swing_I
        )
        force_I: Array = setpoint.force_I + self._masses * acceleration
        return force_I if integral_I is None else force_I + integral_I

    def integral_after(
        self, integral_I: Array, motion: UavMotion, setpoint: Setpoint, period_s: float
    ) -> Array:
        """Return the force of the integral one period later, (3,), N. Source: docs/equations.md (31a)."""
        error_I = setpoint.motion.position_I - motion.position_I
        rate_I = self._masses * self._gains.integral * error_I - integral_I / self._gains.forgets_s
        return self.within(integral_I + period_s * rate_I)

    def within(self, integral_I: Array) -> Array:
        """Return a force of the integral within its limits, (3,), N."""
        most_N = self._gains.largest_integral * self._hover_N
        return np.minimum(np.maximum(integral_I, -most_N), most_N)

    def gain(self) -> Array:
        """Return the derivative of `inputs` about hover by the state of the team, (4, n): (31c)."""
        slopes = hover_motion_slopes(self._system, self._uav)
        gain = self._by_force() @ self._force_slopes(slopes)

        by_own = gain[1:, state.uav_slice(self._uav)]  # a view
        by_own[:, state.THETA] -= self._stiffness
        by_own[:, state.OMEGA] -= self._damping
        return gain

    def gain_along(self, x: Array, setpoint: Setpoint) -> Array:
        """Return the derivative of `inputs` by the state of the team, (4, n), at the setpoint.

        x is the state of the team there, (n,). Source: docs/equations.md (31g).
        """
        force = self._force_slopes(motion_slopes(self._system, self._uav, x))
        own = state.uav_slice(self._uav)

        # Theta - Theta_d by the state
        by_force, by_yaw = roll_and_pitch_slopes(setpoint.force_I, setpoint.motion.Theta[2])
        error = np.zeros_like(force)
        error[:2] = -by_force @ force
        by_attitude = error[:, own][:, state.THETA]  # a view
        by_attitude += np.eye(3)
        by_attitude[:2, 2] -= by_yaw

        # The thrust -(R k)'F has the direction of F there: to first order a turn of R does not change it.
        gain = np.zeros((state.INPUTS, len(x)))
        gain[0] = -rotation(setpoint.motion.Theta)[:, 2] @ force
        gain[1:] = -self._stiffness @ error
        gain[1:, own][:, state.OMEGA] -= self._damping
        return gain

    @property
    def follows_s(self) -> float:
        """Time in which the integral follows a steady force, s: position over integral gain."""
        return self._gains.position / self._gains.integral

    @property
    def forgets_s(self) -> float:
        """Time in which the integral forgets, s."""
        return self._gains.forgets_s

    def by_position(self) -> Array:
        """Return the change of the integral's force by the deviation of position, (3, 3), N/(m s): (31a)."""
        return -np.diag(self._masses * self._gains.integral)

    def by_integral(self) -> Array:
        """Return the derivative of `inputs` about hover by the force of the integral, (4, 3): G_F of (31c)."""
        return self._by_force()

    def by_swing(self) -> Array:
        """Return the derivative of `inputs` about hover by the velocity of the rod's lower end, (4, 3): (31c)."""
        level = np.diag(self._masses * [1.0, 1.0, 0.0])
        slopes: Array = -self._swing * (self._by_force() @ level)
        return slopes

    def driven(
        self, motion: UavMotion, here: Setpoint, there: UavMotion, inputs: Array, duration_s: float
    ) -> UavMotion:
        """Return a motion `ahead` by a time, s, with what the inputs in force until then do: (31h).

        They turn the UAV, and their thrust moves it, in the direction of half that time. The force of the rod
        stays that of the reference.

        Args:
            motion: Motion at the end of that time, with constant rates.
            here: Setpoint at its begin.
            there: Reference at its end.
            inputs: Inputs in force, (4,), N and N m or rad/s.
            duration_s: That time.
        """
        omega_B = motion.omega_B - there.omega_B
        by_driven, by_rates = turn_by_inputs(self._system, self._uav, duration_s)
        turn = by_driven @ (inputs[1:] - here.turning) + by_rates @ omega_B

        half_way = here.motion.Theta + motion.Theta - there.Theta - 0.5 * duration_s * omega_B
        force_I = -inputs[0] * rotation(half_way)[:, 2]
        faster_I = duration_s / self._system.uavs[self._uav].mass * (force_I - here.force_I)
        return replace(
            motion,
            velocity_I=motion.velocity_I + faster_I,
            Theta=motion.Theta + turn[:3],
            omega_B=motion.omega_B + turn[3:],
        )

    def by_inputs_before(self, period_s: float) -> tuple[Array, Array, Array]:
        """Return how `inputs` answer, as they act a period later, to those in force until then: (31h).

        By these inputs, (4, 4), and by the own attitude in that period, (4, 3), and body rates, (4, 3), of
        which a constant rate is taken already.
        """
        by_turning, by_rates = turn_by_inputs(self._system, self._uav, period_s)
        answer = np.hstack([-self._stiffness, -self._damping])
        before = np.zeros((state.INPUTS, state.INPUTS))
        before[1:, 1:] = answer @ by_turning
        rates = np.zeros((state.INPUTS, 3))
        rates[1:] = answer @ by_rates

        # The thrust in force, and the tilt of the hover thrust, change the velocity.
        faster = period_s / self._system.uavs[self._uav].mass
        by_velocity = self.by_sensors()[:, state.VELOCITY]
        before[:, 0] = by_velocity @ (-faster * _DOWN_I)
        attitude = faster * self._hover_N * by_velocity @ _PULL_BY_TILT
        return before, attitude, rates

    def by_sensors(self) -> Array:
        """Return the derivative of `inputs` about hover by the own sensors, (4, 15), but for the swing: (31c).

        The specific force, which shows the swing through an observer, has zeros.
        """
        acceleration = np.zeros((3, state.SENSED))
        acceleration[:, state.POSITION] = -self._gains.position * np.eye(3)
        acceleration[:, state.VELOCITY] = -self._gains.velocity * np.eye(3)

        slopes = self._by_force() @ (self._masses[:, None] * acceleration)
        slopes[1:, state.THETA] -= self._stiffness
        slopes[1:, state.OMEGA] -= self._damping
        return slopes

    def _force_slopes(self, motion: MotionSlopes) -> Array:
        """Return the derivative of `force` by the state of the team, (3, n): dF of (31g)."""
        level_swing = motion.swing_I.copy()
        level_swing[2] = 0.0
        acceleration = (
            -self._gains.position * motion.position_I
            - self._gains.velocity * motion.velocity_I
            - self._swing * level_swing
        )
        slopes: Array = self._masses[:, None] * acceleration
        return slopes

    def _by_force(self) -> Array:
        """Return the derivative of `inputs` by the desired force about hover, (4, 3): G_F of (31c).

        The thrust grows with a force upwards, z down. A force forwards pitches the UAV down, one to the
        right rolls it, by the angle at which the hover thrust has it.
        """
        attitude = _TILT_BY_PULL / self._hover_N
        return np.vstack([-_DOWN_I, self._stiffness @ attitude])
