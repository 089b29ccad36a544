"""The fail-safe of a UAV whose plan is too old.

Hover thrust and level attitude, or the control law of a UAV alone.
"""

from collections.abc import Collection

import numpy as np

from transport.model import state
from transport.model.arrays import Array, rows
from transport.model.digests_and_shared_results import digest
from transport.model.path import flat_reference as flat
from transport.model.path.flat_reference import Track
from transport.model.physics.hover import hover_after_failures, with_released
from transport.model.physics.parameters import ParameterError, System
from transport.mpc.alone.alone_law import GAINS, AloneLaw
from transport.mpc.alone.attitude_loop import LEVELLING, LEVELLING_RAD_S, attitude_loop
from transport.mpc.alone.uav_motion import Setpoint, motion_of, setpoint_of
from transport.mpc.alone.undisturbed_motion import UndisturbedMotion
from transport.mpc.settings_period_horizon_weights import AloneGains

# Time for which a UAV plays its last plan before it flies alone, s: plans that are
# lost on their way to the actuators, or late, are bridged.
PLAYED_S = 0.4


class FailSafe:
    """The fail-safes of all UAVs: hover thrusts u_hover, (4 N,), or the inputs of a flat track.

    They follow the states X_ref, (K, n), the last one held, each UAV alone by its own motion;
    without them they keep level. With a flat track, or the undisturbed motion of the whole team along
    X_ref, they follow that: its payload does not swing. UAVs alone have the gains.
    """

    def __init__(
        self,
        system: System,
        u_hover: Array,
        X_ref: Array | None = None,
        track: Track | None = None,
        motion: UndisturbedMotion | None = None,
        gains: AloneGains = GAINS,
    ) -> None:
        self.gains = gains
        self.u_hover = u_hover
        self.track = track
        self.motion = motion
        self._X_ref = X_ref
        self._system = system
        self._gains = [_attitude_gain(system, uav) for uav in range(system.N)]
        thrusts_N = u_hover[:: state.INPUTS]
        self._laws = [
            AloneLaw(system, uav, float(thrusts_N[uav]), gains) for uav in range(system.N)
        ]

    @property
    def follows(self) -> bool:
        """True if UAVs follow the reference, and do not only keep level."""
        return self._X_ref is not None

    @property
    def key(self) -> bytes:
        """Digest of the numbers that `of_team` follows from."""
        by_track = None if self.track is None else self.track.key
        return digest(self._system, self.u_hover, self._X_ref, by_track, repr(self.gains))

    def of_team(self, off: Collection[int], released: Collection[int]) -> "FailSafe":
        """Return the fail-safe whose thrusts hold the payload without UAVs off or released.

        The same one if that team has no hover. Source: docs/equations.md (51).
        """
        if not off:
            return self
        try:
            hover = hover_after_failures(self._system, off, released)
        except ParameterError:
            return self

        # Inputs of UAVs without motors have no effect; a thrust of zero would have no attitude to
        # tilt it.
        running = np.repeat([uav not in off for uav in range(self._system.N)], state.INPUTS)
        u_hover = np.where(running, hover.u, self.u_hover)

        track = self.track
        if track is not None and released:
            system = with_released(self._system, released)
            track = flat.track(system, hover, track.paths, track.first, released)
        return FailSafe(self._system, u_hover, self._X_ref, track, gains=self.gains)

    def warm_up(self) -> None:
        """Compute what UAVs follow, as far as it has an end."""
        if self.motion is not None:
            self.motion.warm_up()

    def played(self, steps: int, period_s: float) -> int:
        """Return how many of the steps of its last plan a UAV plays before this fail-safe takes over.

        One that follows is soon better than inputs that nothing corrects: in gusts they drift off by
        decimetres in a second. One that keeps level does not know where it is: it comes at the end.
        """
        return min(steps, max(1, round(PLAYED_S / period_s))) if self.follows else steps

    def law(self, uav: int) -> AloneLaw:
        """Return the control law of a UAV, 0-based, alone."""
        return self._laws[uav]

    def setpoint(self, uav: int, tick: int, further_drag: Array | None = None) -> Setpoint:
        """Return the setpoint of a UAV, 0-based, at a tick.

        Along a flat track it moves with drag beyond the known one of payload and UAVs, (2,), kg/s, as
        in (73). Raises: ValueError: it keeps level.
        """
        if self._X_ref is None:
            raise ValueError("expected a fail-safe that follows, got one that keeps level")
        if self.track is not None:
            row = rows(tick - self.track.first, 1, len(self.track.U))
            x = self.track.X[row][0]
            u = self.track.U[row][0]
            if further_drag is not None:
                X_forces, U_forces = self.track.by_forces(row)
                x = x + X_forces[0, :, -2:] @ further_drag
                u = u + U_forces[0, :, -2:] @ further_drag
            return setpoint_of(self._system, uav, x, u)
        if self.motion is not None:
            return self.motion.setpoint(uav, tick)
        x_ref = self._X_ref[min(tick, len(self._X_ref) - 1)]
        return setpoint_of(self._system, uav, x_ref, self.u_hover)

    def gain(self, uav: int) -> Array:
        """Return the linearised feedback from the state to a UAV's inputs, (4, n).

        Source: docs/equations.md (31), (31c), (45), (58).
        """
        if self.follows:
            return self._laws[uav].gain()
        gain = np.zeros((state.INPUTS, self._system.n))
        gain[:, state.uav_slice(uav)] = self._gains[uav]
        return gain

    def gain_along(self, uav: int, x: Array, tick: int) -> Array:
        """Return the linearised feedback where the team, in a state (n,), is on the setpoint, (4, n): (31g)."""
        if not self.follows:
            return self.gain(uav)
        return self._laws[uav].gain_along(x, self.setpoint(uav, tick))

    def inputs(self, uav: int, x: Array, tick: int, integral_I: Array | None = None) -> Array:
        """Return the inputs of one UAV, 0-based, at a state at t_k, (n,), before limits, (4,).

        `integral_I` is the force of its integral, (3,), N; None where that is not known.
        Source: docs/equations.md (31), (31a), (58).
        """
        if self.follows:
            motion = motion_of(self._system, uav, x)
            return self._laws[uav].inputs(motion, self.setpoint(uav, tick), integral_I)
        only_thrust = np.array([1.0, 0.0, 0.0, 0.0])
        at_rest: Array = self.u_hover[state.input_slice(uav)] * only_thrust
        return at_rest + self._gains[uav] @ x[state.uav_slice(uav)]

    def integral_after(
        self, uav: int, x: Array, tick: int, integral_I: Array, period_s: float
    ) -> Array:
        """Return the force of the integral one period later, (3,), N; the same if it keeps level."""
        if not self.follows:
            return integral_I
        motion = motion_of(self._system, uav, x)
        return self._laws[uav].integral_after(
            integral_I, motion, self.setpoint(uav, tick), period_s
        )


def _attitude_gain(system: System, uav: int) -> Array:
    """Return the feedback on a UAV's own state that levels it, (4, 12): (31), (58)."""
    # The heading is free.
    loop = attitude_loop(system, uav, LEVELLING, frequency_rad_s=LEVELLING_RAD_S, heading=0.0)
    gain = np.zeros((state.INPUTS, state.PER_UAV))
    gain[1:, state.THETA] = -loop.stiffness
    gain[1:, state.OMEGA] = -loop.damping
    return gain
