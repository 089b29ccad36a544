"""The control law of a UAV alone: it keeps to its own part of the reference by its own sensors, without any message.

Position and velocity are controlled in three axes, upwards with the share of the payload on the rod. An integral finds
wind and mass errors, and the UAV gives way to the swing of the rod, which damps it.
Source: docs/equations.md (31a)-(31e).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.parameters import System
from transport.model.rotations import cross, euler_rates, rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class AloneGains:
    """Gains of the position loop and limits; docs/equations.md (31a)-(31c) has the reasons."""

    position: float = 6.0  # 1/s^2
    velocity: float = 5.0  # 1/s; as stiff as the attitude loop allows at 20 Hz
    integral: float = 2.5  # 1/s^3
    # Time in which the integral forgets, s: UAVs on a rigid body could otherwise hold any force
    # against each other, which biases of their sensors would let grow.
    forgets_s: float = 20.0
    # Acceleration per velocity of the rod's lower end relative to the UAV, 1/s, for a rod of 1 m. It
    # grows with the period of the rod, sqrt(l): the lag of the attitude loop limits it.
    swing: float = 0.5
    steepest_rad: float = 0.5  # largest change of the attitude that a deviation asks for
    most_held: float = 0.4  # largest force of the integral, as a share of what the UAV carries


GAINS = AloneGains()

# Attitude loop: slow enough for the moment limits of small quadrotors, faster than the pendulum of a rod.
_FREQUENCY_RAD_S, _DAMPING = 6.0, 0.8
# Around an inner loop on body rates, as a share of its gain and at most, 1/s: damping ratio 0.7.
_INNER_SHARE, _LARGEST_GAIN = 0.5, 10.0
_HEADING = (
    0.08  # stiffness of the heading over that of roll and pitch: it returns within some seconds
)
# Observer of the rod from the specific force: fast enough for the pendulum of a rod, slow enough for the noise.
_OBSERVER_RAD_S, _OBSERVER_DAMPING = 3.0, 0.7
_E3 = np.array([0.0, 0.0, 1.0])  # third axis: down, or that of the thrust in the body frame
# Time that a plan covers, s: three lost plans in a row at 20 Hz, and about the time constant of the
# attitude loop. Moments that are held for longer tip the UAV, as nothing predicts its feedback.
# Without a newer plan the actuators continue on `controller.fail_safe`: "follow" is (31a) along the
# same motion, by the state of the plant; "level" keeps level.
_PLAN_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Motion of one UAV as its own sensors show it, SI."""

    position_I: Array  # (3,)
    velocity_I: Array  # (3,)
    Theta: Array  # roll, pitch, yaw, (3,)
    omega_B: Array  # body rates, (3,)
    rod_I: Array  # lower end of the rod relative to the UAV, (3,)
    swing_I: Array  # its velocity, (3,)


def steps_alone(period_s: float) -> int:
    """Return how many sampling periods a plan of UAVs alone covers."""
    return max(1, round(_PLAN_S / period_s))


def ahead(
    motion: Motion, tick: int, start: int, course: Callable[[int], Motion], period_s: float
) -> Motion:
    """Return a motion at a later tick, if its deviation from the course goes on at its rates. Source: (31e)."""
    if start == tick:
        return motion
    here, there, duration_s = course(tick), course(start), period_s * (start - tick)
    velocity_I = motion.velocity_I - here.velocity_I
    omega_B = motion.omega_B - here.omega_B
    return Motion(
        position_I=there.position_I + motion.position_I - here.position_I + duration_s * velocity_I,
        velocity_I=there.velocity_I + velocity_I,
        Theta=there.Theta + motion.Theta - here.Theta + duration_s * omega_B,
        omega_B=there.omega_B + omega_B,
        rod_I=there.rod_I + motion.rod_I - here.rod_I,
        swing_I=there.swing_I + motion.swing_I - here.swing_I,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Part of the reference that is one UAV's, at an instant: its motion, and the inputs that belong to it."""

    motion: Motion
    force_I: Array  # force of the thrust, (3,), N
    turning: Array  # moments, or commanded body rates, (3,)
    inputs: Array  # thrust, and what turns it, (4,)


def motion_of(system: System, uav: int, x: Array) -> Motion:
    """Return the motion of a UAV, 0-based, in a state of the team, (n,). Source: docs/equations.md (1), (39)."""
    own = x[state.uav_slice(uav)]
    rho = system.uavs[uav].rho
    rod_P = system.uavs[uav].rod_length * own[state.E]
    R0 = rotation(x[state.THETA0])

    swing_P = cross(own[state.ROD_RATE], rod_P)
    turning_P = cross(x[state.OMEGA0], rho) - swing_P
    return Motion(
        position_I=x[state.R0] + R0 @ (rho - rod_P),
        velocity_I=R0 @ (x[state.V0] + turning_P),
        Theta=own[state.THETA],
        omega_B=own[state.OMEGA],
        rod_I=R0 @ rod_P,
        swing_I=R0 @ swing_P,
    )


def course_of(system: System, uav: int, x_ref: Array, u_ref: Array) -> Course:
    """Return the course of a UAV, 0-based, from a reference state, (n,), and its inputs, (m,)."""
    motion = motion_of(system, uav, x_ref)
    thrust_N, *turning = u_ref[state.input_slice(uav)]
    force_I = -thrust_N * rotation(motion.Theta)[:, 2]
    return Course(
        motion=motion,
        force_I=force_I,
        turning=np.array(turning),
        inputs=np.array([np.linalg.norm(force_I), *turning]),
    )


class AloneLaw:
    """Control law of one UAV, 0-based, that carries its share of the payload with a hover thrust, N.

    A further term of the force has its place in `force`, its derivatives in `gain`, `gain_along` and
    `by_sensors`, its numbers in `numbers`, and its twin in `alone_inputs` of model/kernels.c. Tests
    compare each of them with `inputs`.
    """

    def __init__(self, system: System, uav: int, hover_N: float, gains: AloneGains = GAINS) -> None:
        self._system = system
        self._uav = uav
        self._gains = gains
        self._hover_N = hover_N
        mass = system.uavs[uav].mass
        inertia = system.uavs[uav].inertia
        self._swing = gains.swing * float(np.sqrt(system.uavs[uav].rod_length))
        # Sideways the rod gives way. Upwards the UAV lifts its share of the payload as well.
        self._masses = np.array([mass, mass, hover_N / system.gravity])
        weights = np.diag([1.0, 1.0, _HEADING])
        if system.rate_gains is not None:
            self._stiffness = (
                np.diag(np.minimum(_INNER_SHARE * system.rate_gains, _LARGEST_GAIN)) @ weights
            )
            self._damping = np.zeros((3, 3))
        else:
            self._stiffness = _FREQUENCY_RAD_S**2 * inertia @ weights
            self._damping = 2.0 * _DAMPING * _FREQUENCY_RAD_S * inertia

    def numbers(self) -> Array:
        """Return its numbers in the order of the struct `alone_law` of the kernels, (29,)."""
        uav, gains = self._system.uavs[self._uav], self._gains
        position_loop = [gains.position, gains.velocity, self._swing, gains.steepest_rad]
        attitude_loop = [self._stiffness.reshape(-1), self._damping.reshape(-1)]
        rod = [uav.rho, [uav.rod_length]]
        return np.concatenate([*rod, self._masses, position_loop, *attitude_loop])

    def inputs(self, motion: Motion, course: Course, held_I: Array | None = None) -> Array:
        """Return thrust and moments, or body rates, before limits, (4,), N and N m or rad/s: (31a), (31b).

        `held_I` is the force of the integral, (3,), N; None for none.
        """
        force_I = self.force(motion, course, held_I)
        roll, pitch = _attitude(force_I, motion.Theta[2])
        roll_ref, pitch_ref = _attitude(course.force_I, motion.Theta[2])
        steepest = self._gains.steepest_rad
        roll = roll_ref + min(max(roll - roll_ref, -steepest), steepest)
        pitch = pitch_ref + min(max(pitch - pitch_ref, -steepest), steepest)

        turned = math.remainder(motion.Theta[2] - course.motion.Theta[2], 2.0 * math.pi)
        error = np.array([motion.Theta[0] - roll, motion.Theta[1] - pitch, turned])
        turning = course.turning - self._stiffness @ error
        turning = turning - self._damping @ (motion.omega_B - course.motion.omega_B)
        thrust = -(rotation(motion.Theta)[:, 2] @ force_I)
        return np.concatenate([[thrust], turning])

    def force(self, motion: Motion, course: Course, held_I: Array | None = None) -> Array:
        """Return the force that the thrust is to have, (3,), inertial frame, N. Source: docs/equations.md (31a)."""
        gains = self._gains
        wanted = course.motion
        swing_I = motion.swing_I - wanted.swing_I
        acceleration = (
            gains.position * (wanted.position_I - motion.position_I)
            + gains.velocity * (wanted.velocity_I - motion.velocity_I)
            - self._swing * (swing_I - swing_I[2] * _E3)
        )
        force_I: Array = course.force_I + self._masses * acceleration
        return force_I if held_I is None else force_I + held_I

    def held(self, held_I: Array, motion: Motion, course: Course, period_s: float) -> Array:
        """Return the force of the integral one period later, (3,), N. Source: docs/equations.md (31a)."""
        error_I = course.motion.position_I - motion.position_I
        change_I = self._masses * self._gains.integral * error_I - held_I / self._gains.forgets_s
        return self.within(held_I + period_s * change_I)

    def within(self, held_I: Array) -> Array:
        """Return a force of the integral within its limits, (3,), N."""
        most_N = self._gains.most_held * self._hover_N
        return np.minimum(np.maximum(held_I, -most_N), most_N)

    def gain(self, ahead_s: float = 0.0) -> Array:
        """Return the derivative of `inputs` about hover by the state of the team, (4, n): (31c).

        With inputs that act later, s, deviations go on at their rates until then, (31e).
        """
        gains, (position, velocity, swing) = self._gains, self._motions(ahead_s)
        swing[2] = 0.0
        acceleration = -gains.position * position - gains.velocity * velocity - self._swing * swing

        gain = self._by_force() @ (self._masses[:, None] * acceleration)
        own = gain[1:, state.uav_slice(self._uav)]
        own[:, state.THETA] -= self._stiffness
        own[:, state.OMEGA] -= self._damping + ahead_s * self._stiffness
        return gain

    def gain_along(self, x: Array, course: Course) -> Array:
        """Return the derivative of `inputs` by the state of the team, (4, n), on the course.

        x is the state of the team there, (n,). Source: docs/equations.md (31g).
        """
        by_position, by_velocity, by_swing = _motion_slopes(self._system, self._uav, x)
        by_swing[2] = 0.0
        gains = self._gains
        acceleration = (
            -gains.position * by_position - gains.velocity * by_velocity - self._swing * by_swing
        )
        force_I = self._masses[:, None] * acceleration

        own = state.uav_slice(self._uav)
        by_force, by_yaw = _attitude_slopes(course.force_I, course.motion.Theta[2])
        error = np.zeros_like(force_I)
        error[:2] = -by_force @ force_I
        by_attitude = error[:, own][:, state.THETA]  # a view
        by_attitude += np.eye(3)
        by_attitude[:2, 2] -= by_yaw

        # The direction of the thrust is that of the force: only along it does the force count.
        gain = np.zeros((state.INPUTS, len(x)))
        gain[0] = -rotation(course.motion.Theta)[:, 2] @ force_I
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

    def held_gains(self, ahead_s: float = 0.0) -> tuple[Array, Array]:
        """Return derivatives about hover: of `held` per second by the state, (3, n), of `inputs` by it, (4, 3)."""
        integral = self._masses * self._gains.integral
        return -integral[:, None] * self._motions(ahead_s)[0], self._by_force()

    def by_sensors(self) -> Array:
        """Return the derivative of `inputs` about hover by the own sensors, (4, 15), but for the swing."""
        by_motion = np.zeros((3, state.SENSED))
        by_motion[:, state.POSITION], by_motion[:, state.VELOCITY] = np.eye(3), np.eye(3)
        by_motion[:, state.POSITION] *= -self._gains.position
        by_motion[:, state.VELOCITY] *= -self._gains.velocity
        slopes = self._by_force() @ (self._masses[:, None] * by_motion)
        slopes[1:, state.THETA] -= self._stiffness
        slopes[1:, state.OMEGA] -= self._damping
        return slopes

    def _by_force(self) -> Array:
        """Return the derivative of the inputs by the wanted force about hover, (4, 3): thrust is upwards, z down."""
        tilt = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / self._hover_N
        return np.vstack([-_E3, self._stiffness @ tilt])

    def _motions(self, ahead_s: float) -> tuple[Array, Array, Array]:
        """Return the derivatives of position, velocity and swing about hover by the state, (3, n) each."""
        uav, own = self._system.uavs[self._uav], state.uav_slice(self._uav)
        rod = uav.rod_length * _E3
        position, velocity, swing = (np.zeros((3, self._system.n)) for _ in range(3))
        swing[:, own][:, state.ROD_RATE] = np.cross(np.eye(3), rod).T
        position[:, state.R0] = velocity[:, state.V0] = np.eye(3)
        position[:, state.THETA0] = np.cross(np.eye(3), uav.rho - rod).T
        position[:, own][:, state.E] = -uav.rod_length * np.eye(3)
        velocity[:, state.OMEGA0] = np.cross(np.eye(3), uav.rho).T
        velocity -= swing
        return position + ahead_s * velocity, velocity, swing


class OwnSensors:
    """Motion of one UAV, 0-based, from its own sensors alone, tick by tick.

    The specific force times the mass is the force of thrust and rod, which has the rod's direction:
    an observer follows its deviation from the reference, (31d). Late sensors and later inputs:
    deviations go on at their rates, (31e).

    Args:
        ages: Sampling periods from position, velocity, attitude, body rates and specific force to their measurements.
    """

    def __init__(self, system: System, uav: int, ages: Sequence[int], period_s: float) -> None:
        self._uav, self._period_s = system.uavs[uav], period_s
        self._ages = tuple(ages)
        self._offset_I = np.zeros(3)  # of the rod's lower end from the reference, m
        self._rate_I = np.zeros(3)  # its derivative, m/s

    def motion(
        self, sensed: Array, thrust_N: float, tick: int, start: int, course: Callable[[int], Motion]
    ) -> Motion:
        """Return the motion at tick `start` from measurements, (15,), of a tick, with the thrust until it.

        `course` is the reference at a tick.
        """
        of_position, of_velocity, of_attitude, of_rates, of_force = (
            course(max(tick - age, 0)) for age in self._ages
        )
        there = course(start)
        self._observe(sensed, thrust_N, of_force)

        velocity_I = sensed[state.VELOCITY] - of_velocity.velocity_I
        omega_B = sensed[state.OMEGA] - of_rates.omega_B
        moving_s = self._period_s * (start - tick + self._ages[0])
        turning_s = self._period_s * (start - tick + self._ages[2])
        position_I = sensed[state.POSITION] - of_position.position_I + moving_s * velocity_I
        Theta = sensed[state.THETA] - of_attitude.Theta + turning_s * omega_B
        return Motion(
            position_I=there.position_I + position_I,
            velocity_I=there.velocity_I + velocity_I,
            Theta=there.Theta + Theta,
            omega_B=there.omega_B + omega_B,
            rod_I=there.rod_I + self._offset_I,
            swing_I=there.swing_I + self._rate_I,
        )

    def _observe(self, sensed: Array, thrust_N: float, reference: Motion) -> None:
        """Take in the direction of the rod's force. Source: docs/equations.md (31d)."""
        R = rotation(sensed[state.THETA])
        pull_I = R @ (self._uav.mass * sensed[state.SPECIFIC_FORCE] + thrust_N * _E3)
        strength_N = float(np.linalg.norm(pull_I))
        if not strength_N > 0.0:
            return
        error_I = self._uav.rod_length / strength_N * pull_I - reference.rod_I - self._offset_I
        damping = 2.0 * _OBSERVER_DAMPING * _OBSERVER_RAD_S
        self._offset_I = self._offset_I + self._period_s * (self._rate_I + damping * error_I)
        self._rate_I = self._rate_I + self._period_s * _OBSERVER_RAD_S**2 * error_I


def _attitude(force_I: Array, yaw: float) -> tuple[float, float]:
    """Return roll and pitch whose thrust has the direction of a force, (3,), at a yaw. Source: equations.md (31b)."""
    x, y, z = (float(component) for component in force_I)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    strength = math.sqrt(x * x + y * y + z * z)
    if not strength > 0.0:
        return 0.0, 0.0
    forward, right = cosine * x + sine * y, cosine * y - sine * x
    sine_of_roll = min(max(right / strength, -1.0), 1.0)  # beyond 1 by rounding
    return math.asin(sine_of_roll), math.atan2(-forward, -z)


def _attitude_slopes(force_I: Array, yaw: float) -> tuple[Array, Array]:
    """Return the derivatives of roll and pitch of `_attitude` by the force, (2, 3), and by the yaw, (2,)."""
    x, y, z = (float(component) for component in force_I)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    forward, right = cosine * x + sine * y, cosine * y - sine * x
    strength = math.sqrt(x * x + y * y + z * z)
    by_force = np.zeros((2, 3))
    by_yaw = np.zeros(2)

    # The sine of the roll is the share of the force to the right.
    leaning = math.sqrt(strength**2 - right**2)
    right_by_force = np.array([-sine, cosine, 0.0])
    by_force[0] = (right_by_force - right / strength**2 * force_I) / leaning
    by_yaw[0] = -forward / leaning

    # The tangent of the pitch is the backward over the upward part.
    forward_by_force = np.array([cosine, sine, 0.0])
    by_force[1] = (z * forward_by_force - forward * _E3) / (forward**2 + z**2)
    by_yaw[1] = z * right / (forward**2 + z**2)
    return by_force, by_yaw


def _motion_slopes(system: System, uav: int, x: Array) -> tuple[Array, Array, Array]:
    """Return the derivatives of position, velocity and swing of `motion_of` by the state, (3, n) each."""
    rho, length = system.uavs[uav].rho, system.uavs[uav].rod_length
    own = x[state.uav_slice(uav)]
    rod_P = length * own[state.E]
    R0 = rotation(x[state.THETA0])
    # A change of the payload's Euler angles turns it by this, payload frame.
    turned = np.linalg.inv(euler_rates(x[state.THETA0]))

    swing_P = cross(own[state.ROD_RATE], rod_P)
    velocity_P = x[state.V0] + cross(x[state.OMEGA0], rho) - swing_P

    # swing_P = Omega x l e
    swing = np.zeros((3, len(x)))
    of_uav = swing[:, state.uav_slice(uav)]
    of_uav[:, state.ROD_RATE] = -_skew(rod_P)
    of_uav[:, state.E] = length * _skew(own[state.ROD_RATE])

    # velocity_P = v0 + omega0 x rho - swing_P
    velocity = -swing
    velocity[:, state.V0] = np.eye(3)
    velocity[:, state.OMEGA0] = -_skew(rho)

    # position_I = r0 + R0 (rho - l e)
    position = np.zeros((3, len(x)))
    position[:, state.uav_slice(uav)][:, state.E] = -length * np.eye(3)
    slopes = []
    for slope, vector_P in ((position, rho - rod_P), (velocity, velocity_P), (swing, swing_P)):
        # d(R0 a) = R0 (da + turn x a)
        slope[:, state.THETA0] = -_skew(vector_P) @ turned
        slopes.append(R0 @ slope)
    slopes[0][:, state.R0] = np.eye(3)
    return slopes[0], slopes[1], slopes[2]


def _skew(a: Array) -> Array:
    """Return the matrix of a x, (3, 3)."""
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
