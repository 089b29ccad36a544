"""The motion of one UAV, as its own sensors can show it, and the setpoint that a UAV alone follows."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.model.physics.parameters import System
from transport.model.physics.rotations import cross, euler_rates, rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class UavMotion:
    """Motion of one UAV, SI."""

    position_I: Array  # (3,)
    velocity_I: Array  # (3,)
    Theta: Array  # roll, pitch, yaw, (3,)
    omega_B: Array  # body rates, (3,)
    rod_I: Array  # lower end of the rod relative to the UAV, (3,)
    swing_I: Array  # its velocity, (3,)


@dataclass(frozen=True, kw_only=True)
class Setpoint:
    """What one UAV follows at an instant: its part of the motion of the team, and the inputs that belong to it.

    All agents of a process share it, and what is computed of it.
    """

    motion: UavMotion
    force_I: Array  # force of the thrust, (3,), N
    turning: Array  # moments, N m, or commanded body rates, rad/s, (3,)
    inputs: Array  # thrust and `turning`, (4,)

    @cached_property
    def address(self) -> int:
        """Address of the numbers that a kernel reads, which live as long as this."""
        return native.address(self._numbers)

    @cached_property
    def _numbers(self) -> Array:
        """The numbers in the order of the struct `alone_setpoint` of model/kernels/kernels.c, (24,)."""
        motion = self.motion
        attitude = [motion.Theta, motion.omega_B]
        rod = [motion.rod_I, motion.swing_I]
        return np.concatenate(
            [motion.position_I, motion.velocity_I, *attitude, *rod, self.force_I, self.turning]
        )


def motion_of(system: System, uav: int, x: Array) -> UavMotion:
    """Return the motion of a UAV, 0-based, in a state of the team, (n,). Source: docs/equations.md (1), (39)."""
    own = x[state.uav_slice(uav)]
    rho = system.uavs[uav].rho
    rod_P = system.uavs[uav].rod_length * own[state.E]
    R0 = rotation(x[state.THETA0])

    swing_P = cross(own[state.ROD_RATE], rod_P)
    turning_P = cross(x[state.OMEGA0], rho) - swing_P
    return UavMotion(
        position_I=x[state.R0] + R0 @ (rho - rod_P),
        velocity_I=R0 @ (x[state.V0] + turning_P),
        Theta=own[state.THETA],
        omega_B=own[state.OMEGA],
        rod_I=R0 @ rod_P,
        swing_I=R0 @ swing_P,
    )


def setpoint_of(system: System, uav: int, x: Array, u: Array) -> Setpoint:
    """Return the part of a UAV, 0-based, of a state of the team, (n,), and of its inputs, (m,)."""
    motion = motion_of(system, uav, x)
    thrust_N, *turning = u[state.input_slice(uav)]
    force_I = -thrust_N * rotation(motion.Theta)[:, 2]
    return Setpoint(
        motion=motion,
        force_I=force_I,
        turning=np.array(turning),
        inputs=np.array([np.linalg.norm(force_I), *turning]),
    )


def ahead(
    motion: UavMotion, tick: int, start: int, reference: Callable[[int], UavMotion], period_s: float
) -> UavMotion:
    """Return the motion at tick `start` of a UAV that has a motion at an earlier tick.

    Its deviations of position and attitude from the reference, which is given by tick, go on at their
    rates; the others stay. Source: docs/equations.md (31e).
    """
    if start == tick:
        return motion
    here = reference(tick)
    there = reference(start)
    duration_s = period_s * (start - tick)

    velocity_I = motion.velocity_I - here.velocity_I
    omega_B = motion.omega_B - here.omega_B
    return UavMotion(
        position_I=there.position_I + motion.position_I - here.position_I + duration_s * velocity_I,
        velocity_I=there.velocity_I + velocity_I,
        Theta=there.Theta + motion.Theta - here.Theta + duration_s * omega_B,
        omega_B=there.omega_B + omega_B,
        rod_I=there.rod_I + motion.rod_I - here.rod_I,
        swing_I=there.swing_I + motion.swing_I - here.swing_I,
    )


def turn_by_inputs(system: System, uav: int, duration_s: float) -> tuple[Array, Array]:
    """Return what turns a UAV, 0-based, beside its constant body rates, in attitude and body rates after a time.

    By a deviation of moments, or of commanded body rates, (6, 3), and by that of the body rates, (6, 3).
    Small angles; gyroscopic moments are left out. Source: docs/equations.md (13), (57), integrated.
    """
    if system.rate_gains is None:
        #   J omega' = tau
        acceleration = np.linalg.inv(system.uavs[uav].inertia)
        turn = np.vstack([0.5 * duration_s**2 * acceleration, duration_s * acceleration])
        return turn, np.zeros((6, 3))
    #   omega' = K (omega_c - omega)
    decayed = 1.0 - np.exp(-system.rate_gains * duration_s)
    turn = np.vstack([np.diag(duration_s - decayed / system.rate_gains), np.diag(decayed)])
    return turn, -turn


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionSlopes:
    """Derivatives of the motion of one UAV by the state of the team, (3, n) each."""

    position_I: Array
    velocity_I: Array
    rod_I: Array
    swing_I: Array


def motion_slopes(system: System, uav: int, x: Array) -> MotionSlopes:
    """Return the derivatives of `motion_of` at a state of the team, (n,).

    Source: docs/equations.md (1), (39), differentiated.
    """
    rho = system.uavs[uav].rho
    length = system.uavs[uav].rod_length
    own = x[state.uav_slice(uav)]
    rod_P = length * own[state.E]

    # swing_P = Omega x l e
    swing_P = cross(own[state.ROD_RATE], rod_P)
    swing = np.zeros((3, len(x)))
    by_own = swing[:, state.uav_slice(uav)]  # a view
    by_own[:, state.ROD_RATE] = -_skew(rod_P)
    by_own[:, state.E] = length * _skew(own[state.ROD_RATE])

    # velocity_P = v0 + omega0 x rho - swing_P
    velocity_P = x[state.V0] + cross(x[state.OMEGA0], rho) - swing_P
    velocity = -swing
    velocity[:, state.V0] = np.eye(3)
    velocity[:, state.OMEGA0] = -_skew(rho)

    # position_I = r0 + R0 (rho - l e), of which r0 is added in the inertial frame.
    position = np.zeros((3, len(x)))
    position[:, state.uav_slice(uav)][:, state.E] = -length * np.eye(3)

    rod = np.zeros((3, len(x)))
    rod[:, state.uav_slice(uav)][:, state.E] = length * np.eye(3)

    # All of them turn with the payload: dphi is the turn by a change of its Euler angles, payload frame.
    #   d(R0 a) = R0 (da + dphi x a)
    turn_P = np.linalg.inv(euler_rates(x[state.THETA0]))
    position[:, state.THETA0] = -_skew(rho - rod_P) @ turn_P
    velocity[:, state.THETA0] = -_skew(velocity_P) @ turn_P
    swing[:, state.THETA0] = -_skew(swing_P) @ turn_P
    rod[:, state.THETA0] = -_skew(rod_P) @ turn_P

    R0 = rotation(x[state.THETA0])
    position_I = R0 @ position
    position_I[:, state.R0] = np.eye(3)
    return MotionSlopes(
        position_I=position_I, velocity_I=R0 @ velocity, rod_I=R0 @ rod, swing_I=R0 @ swing
    )


def hover_motion_slopes(system: System, uav: int) -> MotionSlopes:
    """Return the derivatives of `motion_of` about hover. Source: docs/equations.md (31c)."""
    rho = system.uavs[uav].rho
    length = system.uavs[uav].rod_length
    rod = length * np.array([0.0, 0.0, 1.0])
    own = state.uav_slice(uav)

    swing = np.zeros((3, system.n))
    swing[:, own][:, state.ROD_RATE] = np.cross(np.eye(3), rod).T

    velocity = np.zeros((3, system.n))
    velocity[:, state.V0] = np.eye(3)
    velocity[:, state.OMEGA0] = np.cross(np.eye(3), rho).T
    velocity -= swing

    position = np.zeros((3, system.n))
    position[:, state.R0] = np.eye(3)
    position[:, state.THETA0] = np.cross(np.eye(3), rho - rod).T
    position[:, own][:, state.E] = -length * np.eye(3)

    end = np.zeros((3, system.n))
    end[:, state.THETA0] = np.cross(np.eye(3), rod).T
    end[:, own][:, state.E] = length * np.eye(3)
    return MotionSlopes(position_I=position, velocity_I=velocity, rod_I=end, swing_I=swing)


def _skew(a: Array) -> Array:
    """Return the matrix of a x, (3, 3)."""
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
