"""What a UAV's actuators do on their own once its plan has run out: hold it level at hover thrust.

The plant's actuators follow it, and whoever knows that a UAV's agent is gone predicts it.
"""

import numpy as np

from model import state
from model.arrays import Array
from model.parameters import System

# Natural frequency and damping of the attitude loop; slow enough for the moment limits of small quadrotors, fast
# against the pendulum of a rod of a few metres.
_FREQUENCY_RAD_S = 6.0
_DAMPING = 0.8


class FailSafe:
    """The fail-safe of every UAV.

    Args:
        system: Physical parameters.
        u_hover: Its thrusts are held, (4 N,).
    """

    def __init__(self, system: System, u_hover: Array) -> None:
        self._u_hover = u_hover
        self._gains = []
        level = np.diag([1.0, 1.0, 0.0])  # whatever the heading
        for uav in system.uavs:
            gain = np.zeros((state.INPUTS, state.PER_UAV))
            inertia = np.asarray(uav.inertia)
            gain[1:, state.THETA] = -(_FREQUENCY_RAD_S**2) * inertia @ level
            gain[1:, state.OMEGA] = -2.0 * _DAMPING * _FREQUENCY_RAD_S * inertia
            self._gains.append(gain)

    def gain(self, uav: int) -> Array:
        """Feedback from the UAV's own state to its inputs, (4, 12). Source: docs/equations.md (31), (45)."""
        return self._gains[uav]

    def inputs(self, uav: int, x: Array) -> Array:
        """Inputs of one UAV, not yet limited, (4,), N and N m.

        Args:
            uav: 0-based.
            x: State of the system, (n,).
        Source: docs/equations.md (31).
        """
        held: Array = self._u_hover[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        inputs: Array = held + self._gains[uav] @ x[state.uav_slice(uav)]
        return inputs
