"""The fail-safe of a UAV whose plan has run out.

Hover thrust, and level attitude or the way along the reference.
"""

from collections.abc import Collection
from copy import copy

import numpy as np

from transport.model import flat, state
from transport.model.arrays import Array, rows
from transport.model.flat import Track
from transport.model.hover import failed_hover, with_released
from transport.model.parameters import ParameterError, System
from transport.model.rotations import rotation

# Attitude loop: slow enough for the moment limits of small quadrotors, faster than the pendulum of
# a rod.
_FREQUENCY_RAD_S, _DAMPING = 6.0, 0.8
_CRITICAL, _LARGEST_GAIN = (
    0.25,
    6.0,
)  # around an inner loop on body rates, 1/s: critical damping, as usual autopilots
_FOLLOWING_RAD_S, _FOLLOWING_DAMPING = (
    1.5,
    1.0,
)  # of the horizontal position: as fast as the pendulum of a rod
_STEEPEST = 0.2  # largest roll or pitch that it asks for, rad


class FailSafe:
    """The fail-safes of all UAVs: hover thrusts of u_hover, (4 N,), or the inputs of a flat track.

    They follow X_ref, (K, n), the last one held, by measured position and velocity; without it they
    keep level.
    """

    def __init__(
        self, system: System, u_hover: Array, X_ref: Array | None = None, track: Track | None = None
    ) -> None:
        self.u_hover, self._X_ref, self.track = u_hover, X_ref, track
        self._system, self._uavs = system, system.uavs
        self._gains, level = [], np.diag([1.0, 1.0, 0.0])  # the heading is free
        for uav in system.uavs:
            gain = np.zeros((state.INPUTS, state.PER_UAV))
            if system.rate_gains is not None:
                gain[1:, state.THETA] = (
                    -np.diag(np.minimum(_CRITICAL * system.rate_gains, _LARGEST_GAIN)) @ level
                )
            else:
                gain[1:, state.THETA] = -(_FREQUENCY_RAD_S**2) * uav.inertia @ level
                gain[1:, state.OMEGA] = -2.0 * _DAMPING * _FREQUENCY_RAD_S * uav.inertia
            self._gains.append(gain)

    def following(self, X_ref: Array, track: Track | None) -> "FailSafe":
        """Return the fail-safe with another reference, unless it keeps level."""
        found = copy(self)
        found._X_ref, found.track = None if self._X_ref is None else X_ref, track
        return found

    def of_team(self, off: Collection[int], released: Collection[int]) -> "FailSafe":
        """Return the fail-safe whose thrusts hold the payload without UAVs off or released, if it has a hover: (51)."""
        found = copy(self)
        if not off:
            return found
        try:
            hover = failed_hover(self._system, off, released)
        except ParameterError:
            return found
        # Inputs of UAVs without motors have no effect; a thrust of zero would have no attitude to
        # tilt it.
        running = np.repeat([uav not in off for uav in range(len(self._uavs))], state.INPUTS)
        found.u_hover = np.where(running, hover.u, self.u_hover)
        if self.track is not None and released:
            system = with_released(self._system, released)
            found.track = flat.track(system, hover, self.track.paths, self.track.first, released)
            if self._X_ref is not None:
                found._X_ref = np.concatenate([self._X_ref[: self.track.first], found.track.X])
        return found

    def gain(self, uav: int) -> Array:
        """Return the linearised feedback from the state to a UAV's inputs, (4, n).

        (31), (31a), (45), (58).
        """
        gain = np.zeros((state.INPUTS, state.PAYLOAD + state.PER_UAV * len(self._uavs)))
        own = state.uav_slice(uav)
        gain[:, own] = self._gains[uav]
        if self._X_ref is not None:
            rho, rod = self._uavs[uav].rho, np.array([0.0, 0.0, self._uavs[uav].rod_length])
            position, velocity = np.zeros((3, gain.shape[1])), np.zeros((3, gain.shape[1]))
            position[:, state.R0] = velocity[:, state.V0] = np.eye(3)
            position[:, state.THETA0] = np.cross(np.eye(3), rho - rod).T
            velocity[:, state.OMEGA0] = np.cross(np.eye(3), rho).T
            position[:, own][:, state.E] = -rod[2] * np.eye(3)
            velocity[:, own][:, state.ROD_RATE] = -np.cross(np.eye(3), rod).T
            gain += self._gains[uav][:, state.THETA] @ -self._wanted(uav, position, velocity)
        return gain

    def inputs(self, uav: int, x: Array, tick: int) -> Array:
        """Return the inputs of one UAV, 0-based, at a state at t_k, (n,), before limits, (4,).

        (31), (31a), (58).
        """
        own = x[state.uav_slice(uav)].copy()
        if self._X_ref is not None:
            position, velocity = self._motion(uav, x)
            expected = self._motion(uav, self._X_ref[min(tick, len(self._X_ref) - 1)])
            turned = rotation(np.array([0.0, 0.0, own[state.THETA][2]])).T  # into the UAV's heading
            wanted = self._wanted(
                uav, turned @ (position - expected[0]), turned @ (velocity - expected[1])
            )
            own[state.THETA] -= np.clip(wanted, -_STEEPEST, _STEEPEST)
        at_rest: Array = self.u_hover[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        if self._X_ref is not None and self.track is not None:
            at = rows(tick - self.track.first, 1, len(self.track.U))
            at_rest = self.track.U[at][0, state.input_slice(uav)]
            own = own - self.track.X[at][0, state.uav_slice(uav)]
        return at_rest + self._gains[uav] @ own

    def _motion(self, uav: int, x: Array) -> tuple[Array, Array]:
        """Return position and velocity of a UAV, inertial frame, m and m/s.

        Source: docs/equations.md (1), (39).
        """
        R0, block, rho = rotation(x[state.THETA0]), x[state.uav_slice(uav)], self._uavs[uav].rho
        rod = self._uavs[uav].rod_length * block[state.E]
        turning = np.cross(x[state.OMEGA0], rho) - np.cross(block[state.ROD_RATE], rod)
        return x[state.R0] + R0 @ (rho - rod), R0 @ (x[state.V0] + turning)

    def _wanted(self, uav: int, position: Array, velocity: Array) -> Array:
        """Return roll, pitch and a zero from deviations of position and velocity, axes of the heading, (3, ...)."""
        stiffness, damping = _FOLLOWING_RAD_S**2, 2.0 * _FOLLOWING_DAMPING * _FOLLOWING_RAD_S
        lift = self.u_hover[state.input_slice(uav)][0]
        pull = self._uavs[uav].mass / lift * (stiffness * position + damping * velocity)
        return np.stack([-pull[1], pull[0], np.zeros_like(pull[0])])
