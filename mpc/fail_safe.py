"""The fail-safe of a UAV whose plan has run out: hover thrust and level attitude, or the control law of a UAV alone."""

from collections.abc import Collection
from copy import copy

import numpy as np

from model import flat, state
from model.arrays import Array
from model.flat import Track
from model.hover import failed_hover, with_released
from model.parameters import ParameterError, System
from mpc.alone import AloneLaw, Course, course_at, motion_of

# Attitude loop of a UAV that keeps level: slow enough for the moment limits of small quadrotors, faster than the
# pendulum of a rod.
_FREQUENCY_RAD_S, _DAMPING = 6.0, 0.8
_MOST_COURSES = 1024  # kept: the horizon and the past of a step, for all UAVs
_CRITICAL, _LARGEST_GAIN = 0.25, 6.0  # around an inner loop on body rates, 1/s: critical damping, as usual autopilots


class FailSafe:
    """The fail-safes of all UAVs: hover thrusts of u_hover, (4 N,), or the inputs of a flat track.

    They follow X_ref, (K, n), the last one held, alone, each by its own motion; without it they keep level.
    """

    def __init__(self, system: System, u_hover: Array, X_ref: Array | None = None, track: Track | None = None) -> None:
        self.u_hover, self._X_ref, self.track = u_hover, X_ref, track
        self._system = system
        self._laws = self._alone()
        self._courses: dict[tuple[int, int], Course] = {}  # the newest ones, by UAV and tick
        self._level = [_level(system, uav) for uav in range(system.N)]

    @property
    def follows(self) -> bool:
        """Whether the UAVs follow the reference."""
        return self._X_ref is not None

    def following(self, X_ref: Array, track: Track | None) -> "FailSafe":
        """Return the fail-safe with another reference, unless it keeps level."""
        found = copy(self)
        found._courses = {}
        found._X_ref, found.track = None if self._X_ref is None else X_ref, track
        return found

    def of_team(self, off: Collection[int], released: Collection[int]) -> "FailSafe":
        """Return the fail-safe whose thrusts hold the payload without UAVs off or released, if it has a hover: (51)."""
        found = copy(self)
        found._courses = {}
        if not off:
            return found
        try:
            hover = failed_hover(self._system, off, released)
        except ParameterError:
            return found
        # Inputs of UAVs without motors have no effect; a thrust of zero would have no attitude to tilt it.
        running = np.repeat([uav not in off for uav in range(self._system.N)], state.INPUTS)
        found.u_hover = np.where(running, hover.u, self.u_hover)
        found._laws = found._alone()
        if self.track is not None and released:
            system = with_released(self._system, released)
            found.track = flat.track(system, hover, self.track.paths, self.track.first, released)
            if self._X_ref is not None:
                found._X_ref = np.concatenate([self._X_ref[: self.track.first], found.track.X])
        return found

    def law(self, uav: int) -> AloneLaw:
        """Return the control law of a UAV, 0-based, alone."""
        return self._laws[uav]

    def course(self, uav: int, tick: int) -> Course:
        """Return the part of the reference of a UAV, 0-based, at a tick. Raises: ValueError: it keeps level."""
        if self._X_ref is None:
            raise ValueError("expected a fail-safe that follows the reference, got one that keeps level")
        key = uav, tick
        if key not in self._courses:
            while len(self._courses) > _MOST_COURSES:
                del self._courses[next(iter(self._courses))]
            self._courses[key] = course_at(self._system, uav, self._X_ref, self.u_hover, self.track, tick)
        return self._courses[key]

    def gain(self, uav: int) -> Array:
        """Return the linearised feedback from the state to a UAV's inputs, (4, n): (31), (31c), (45), (58)."""
        if self.follows:
            return self._laws[uav].gain()
        gain = np.zeros((state.INPUTS, self._system.n))
        gain[:, state.uav_slice(uav)] = self._level[uav]
        return gain

    def inputs(self, uav: int, x: Array, tick: int, held_I: Array | None = None) -> Array:
        """Return the inputs of one UAV, 0-based, at a state at t_k, (n,), before limits, (4,): (31), (31a), (58).

        `held_I` is the force of its integral, (3,), N; None where it is not known, or without reference.
        """
        if self.follows:
            return self._laws[uav].inputs(motion_of(self._system, uav, x), self.course(uav, tick), held_I)
        at_rest: Array = self.u_hover[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        return at_rest + self._level[uav] @ x[state.uav_slice(uav)]

    def held(self, uav: int, x: Array, tick: int, held_I: Array, period_s: float) -> Array:
        """Return the force of the integral of a UAV, 0-based, one period later, (3,), N; zero if it keeps level."""
        if not self.follows:
            return held_I
        return self._laws[uav].held(held_I, motion_of(self._system, uav, x), self.course(uav, tick), period_s)

    def _alone(self) -> list[AloneLaw]:
        thrusts_N = self.u_hover[:: state.INPUTS]
        return [AloneLaw(self._system, uav, float(thrusts_N[uav])) for uav in range(self._system.N)]


def _level(system: System, uav: int) -> Array:
    """Return the feedback that keeps a UAV level, from its block of the state to its inputs, (4, 12): (31)."""
    gain, level = np.zeros((state.INPUTS, state.PER_UAV)), np.diag([1.0, 1.0, 0.0])  # the heading is free
    inertia = system.uavs[uav].inertia
    if system.rate_gains is not None:
        gain[1:, state.THETA] = -np.diag(np.minimum(_CRITICAL * system.rate_gains, _LARGEST_GAIN)) @ level
    else:
        gain[1:, state.THETA] = -(_FREQUENCY_RAD_S**2) * inertia @ level
        gain[1:, state.OMEGA] = -2.0 * _DAMPING * _FREQUENCY_RAD_S * inertia
    return gain
