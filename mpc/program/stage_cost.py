"""The cost that every agent minimises and that measures every run."""

from collections.abc import Collection

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.hover import Hover
from transport.model.physics.parameters import System
from transport.mpc.settings_period_horizon_weights import Weights


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
        self.Q = Q  # stage weights on the output error, (p,)
        self.R = weights.R(system)  # on the inputs, (m,)

        # Input without cost: hover, or zero, (m,).
        is_deviation = weights.penalised_input == "deviation"
        self.u_target = hover.u if is_deviation else np.zeros_like(hover.u)

    def stage(self, y: Array, y_ref: Array, u: Array) -> float:
        """Return |y - y_ref|^2_Q + |u - u_target|^2_R at one instant; y, y_ref (p,), u (m,), SI.

        Source: docs/equations.md (21); paper (17).
        """
        error = y - y_ref
        effort = u - self.u_target
        return float(error @ (self.Q * error) + effort @ (self.R * effort))
