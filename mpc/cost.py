"""The cost that every agent minimises and that measures every run."""

from collections.abc import Collection

import numpy as np

from transport.model.arrays import Array
from transport.model.hover import Hover
from transport.model.parameters import System
from transport.mpc.settings import Weights


class Cost:
    """Quadratic cost of the team.

    Yaw rates of UAVs that are `off`, and outputs of `released` ones, have no weight.
    """

    def __init__(
        self,
        weights: Weights,
        system: System,
        hover: Hover,
        off: Collection[int] = (),
        released: Collection[int] = (),
    ) -> None:
        N = system.N
        Q = weights.Q(N)
        for uav in released:
            Q[3 * uav : 3 * uav + 3] = 0.0
        for uav in off:
            Q[3 * N + 3 + uav] = 0.0
        self.Q, self.R = (
            Q,
            weights.R(system),
        )  # stage weights on the output error, (p,), and on the inputs, (m,)
        # Input without cost: hover, or zero, (m,).
        self.u_target = (
            hover.u if weights.penalised_input == "deviation" else np.zeros_like(hover.u)
        )

    def stage(self, y: Array, y_ref: Array, u: Array) -> float:
        """Return the cost of y and y_ref, (p,), and u, (m,), SI, at one instant.

        Equations.md (21); paper (17).
        """
        error, effort = y - y_ref, u - self.u_target
        return float(error @ (self.Q * error) + effort @ (self.R * effort))
