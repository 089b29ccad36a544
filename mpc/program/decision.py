"""The decision variables of one controller: the scaled inputs of its own UAVs over the horizon."""

from collections.abc import Sequence

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.mpc.settings_period_horizon_weights import ControllerSettings


class Decision:
    """Positions, limits and scale of the owned inputs; owned UAVs are 0-based, ascending."""

    def __init__(self, system: System, settings: ControllerSettings, owned: Sequence[int]) -> None:
        self.system = system
        self.settings = settings
        self.uavs = tuple(owned)

        # Positions in u of the owned inputs, (m_own,), and of all others, (m - m_own,). Not by
        # `numpy.setdiff1d`, which imports masked arrays at its first call: 7 ms of each start.
        self.own = state.input_indices(self.uavs)
        self.others = np.delete(np.arange(system.m), self.own)
        self.shape = settings.horizon, len(self.own)
        self.size = settings.horizon * len(self.own)

        # Bounds, and largest change over one sampling period, (m_own,).
        self.lower = settings.lower(len(self.uavs))
        self.upper = settings.upper(len(self.uavs))
        self.rate = settings.largest_step(len(self.uavs))

        # Unit of the decision in the QP: half the range, (m_own,), so that newtons and newton
        # metres weigh alike.
        self.scale = (self.upper - self.lower) / 2.0

    def clip(self, inputs: Array) -> Array:
        """Return owned inputs within their bounds, (..., m_own)."""
        return np.minimum(np.maximum(inputs, self.lower), self.upper)

    def limit_rate(self, inputs: Array, before: Array) -> Array:
        """Return owned inputs within bounds and rates of those one period before, (m_own,)."""
        return self.clip(np.clip(inputs, before - self.rate, before + self.rate))

    def inputs(self, z: Array) -> Array:
        """Return the decision in SI units, (N_p, m_own), from z: scaled inputs, then slacks."""
        return np.asarray(z[: self.size].reshape(self.shape) * self.scale)

    def bounds(self, U_free: Array, u0: Array) -> tuple[Array, Array]:
        """Return bounds on the scaled decision about U_free, (N_p m_own,) each.

        The first step is also within the rate limit from u0, the inputs in force. Inputs in force
        outside their bounds return at once: the rate limit gives way.
        Source: docs/equations.md (28), (28a).
        """
        lower = self.lower - U_free
        upper = self.upper - U_free

        first = u0[self.own] - U_free[0]
        lower[0] = np.minimum(np.maximum(lower[0], first - self.rate), upper[0])
        upper[0] = np.maximum(np.minimum(upper[0], first + self.rate), lower[0])
        return (lower / self.scale).reshape(-1), (upper / self.scale).reshape(-1)
