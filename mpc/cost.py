"""The cost that every agent minimises and that measures every run."""

from collections.abc import Collection

import numpy as np

from model.arrays import Array
from model.hover import Hover
from mpc.settings import Weights


class Cost:
    """A quadratic cost with diagonal weights.

    Args:
        weights: Of outputs and inputs.
        hover: The equilibrium.
        off: UAVs without motors, 0-based; their yaw rates have no weight.
        released: UAVs no longer on their rods, 0-based; none of their outputs has a weight.

    Attributes:
        Q: Stage weight on the output error, (p,).
        R: Weight on the inputs, (m,).
        u_target: Input without cost: hover, or zero, (m,).
    """

    def __init__(
        self, weights: Weights, hover: Hover, off: Collection[int] = (), released: Collection[int] = ()
    ) -> None:
        N = len(hover.tensions)
        Q = weights.Q(N)
        for uav in released:
            Q[3 * uav : 3 * uav + 3] = 0.0
        for uav in off:
            Q[3 * N + 3 + uav] = 0.0
        self.Q, self.R = Q, weights.R(N)
        self.u_target = hover.u if weights.penalised_input == "deviation" else np.zeros_like(hover.u)

    def stage(self, y: Array, y_ref: Array, u: Array) -> float:
        """Return the cost of one sampling instant, (y - y_ref)' Q (y - y_ref) + (u - u_target)' R (u - u_target).

        Output y and its reference, (p,); input u, (m,). Source: docs/equations.md (21); paper (17).
        """
        error, effort = y - y_ref, u - self.u_target
        return float(error @ (self.Q * error) + effort @ (self.R * effort))
