"""The fail-safe of a UAV whose plan has run out: level attitude at hover thrust.

The plant's actuators follow it, and controllers predict a UAV without an agent by it.
"""

import numpy as np

from model import state
from model.arrays import Array
from model.parameters import System

# Attitude loop: slow enough for the moment limits of small quadrotors, faster than the pendulum of a rod.
_FREQUENCY_RAD_S = 6.0
_DAMPING = 0.8
# Attitude gain around an inner loop on body rates, 1/s: critical damping, but not faster than usual autopilots.
_CRITICAL, _LARGEST_GAIN = 0.25, 6.0


class FailSafe:
    """The fail-safes of all UAVs.

    Args:
        system: Physical parameters.
        u_hover: Hover input with the thrusts to hold, (4 N,).
    """

    def __init__(self, system: System, u_hover: Array) -> None:
        self._u_hover = u_hover
        self._gains = []
        level = np.diag([1.0, 1.0, 0.0])  # the heading is free
        for uav in system.uavs:
            gain = np.zeros((state.INPUTS, state.PER_UAV))
            if system.rate_gains is not None:
                gain[1:, state.THETA] = -np.diag(np.minimum(_CRITICAL * system.rate_gains, _LARGEST_GAIN)) @ level
            else:
                inertia = np.asarray(uav.inertia)
                gain[1:, state.THETA] = -(_FREQUENCY_RAD_S**2) * inertia @ level
                gain[1:, state.OMEGA] = -2.0 * _DAMPING * _FREQUENCY_RAD_S * inertia
            self._gains.append(gain)

    def gain(self, uav: int) -> Array:
        """Return the feedback from a UAV's own state to its inputs, (4, 12). Source: equations.md (31), (45), (60)."""
        return self._gains[uav]

    def inputs(self, uav: int, x: Array) -> Array:
        """Return the inputs of one UAV, 0-based, at a state of the system, (n,), before limits, (4,), SI.

        Source: docs/equations.md (31), (60).
        """
        hover: Array = self._u_hover[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        return hover + self._gains[uav] @ x[state.uav_slice(uav)]
