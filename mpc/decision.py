"""The decision of one controller: the inputs of its UAVs over the horizon, with their limits."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.parameters import System
from model.state import input_indices
from mpc.settings import ControllerSettings


class Decision:
    """Positions, limits and scale of the owned inputs; owned UAVs are 0-based, ascending."""

    def __init__(self, system: System, settings: ControllerSettings, owned: Sequence[int]) -> None:
        self.system, self.settings, self.uavs = system, settings, tuple(owned)
        self.own = input_indices(self.uavs)  # positions in u, (m_own,)
        self.others = np.setdiff1d(np.arange(system.m), self.own)  # those of all other inputs, (m - m_own,)
        self.shape = settings.horizon, len(self.own)
        self.size = settings.horizon * len(self.own)
        self.lower, self.upper = settings.lower(len(self.uavs)), settings.upper(len(self.uavs))  # bounds, (m_own,)
        self.rate = settings.step(len(self.uavs))  # largest change over one sampling period, (m_own,)
        # Half the range, (m_own,): unit of the decision in the QP, so that newtons and newton metres weigh alike.
        self.scale = (self.upper - self.lower) / 2.0

    def clip(self, inputs: Array) -> Array:
        """Return owned inputs within their bounds, (..., m_own)."""
        return np.minimum(np.maximum(inputs, self.lower), self.upper)

    def inputs(self, z: Array) -> Array:
        """Return the decision in SI units, (N_p, m_own), from the QP's variables: scaled inputs, then slacks."""
        return np.asarray(z[: self.size].reshape(self.shape) * self.scale)

    def bounds(self, U_free: Array, u0: Array) -> tuple[Array, Array]:
        """Return the bounds on the scaled decision, (N_p m_own,) each; the first step's rate limit is one of them.

        The owned inputs are U_free, (N_p, m_own), without it, and were u0[own] before. Inputs in force outside their
        bounds return at once: the bounds are the actuators', the rates a preference.
        """
        lower, upper = self.lower - U_free, self.upper - U_free
        first = u0[self.own] - U_free[0]
        lower[0] = np.minimum(np.maximum(lower[0], first - self.rate), upper[0])
        upper[0] = np.maximum(np.minimum(upper[0], first + self.rate), lower[0])
        return (lower / self.scale).reshape(-1), (upper / self.scale).reshape(-1)
