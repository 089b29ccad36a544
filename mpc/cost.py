"""The cost that every agent minimises and that measures every run."""

from collections.abc import Collection, Sequence

import numpy as np

from model.arrays import Array
from model.dynamics import Symbols
from model.hover import Hover
from model.linearisation import Model
from model.parameters import System
from mpc.expressions import Expressions, read_term
from mpc.settings import CostTerm, SettingsError, Weights


class Cost:
    """Quadratic cost of the team; yaw rates of UAVs that are `off`, and outputs of `released` ones, have no weight."""

    def __init__(
        self, weights: Weights, system: System, hover: Hover, off: Collection[int] = (), released: Collection[int] = ()
    ) -> None:
        N = system.N
        Q = weights.Q(N)
        for uav in released:
            Q[3 * uav : 3 * uav + 3] = 0.0
        for uav in off:
            Q[3 * N + 3 + uav] = 0.0
        self.Q, self.R = Q, weights.R(system)  # stage weights on the output error, (p,), and on the inputs, (m,)
        # Input without cost: hover, or zero, (m,).
        self.u_target = hover.u if weights.penalised_input == "deviation" else np.zeros_like(hover.u)

    def stage(self, y: Array, y_ref: Array, u: Array) -> float:
        """Return the cost of y and y_ref, (p,), and u, (m,), SI, at one instant: equations.md (21); paper (17)."""
        error, effort = y - y_ref, u - self.u_target
        return float(error @ (self.Q * error) + effort @ (self.R * effort))


class UserCosts(Expressions):
    """Weighted squares of the user's expressions of the state. Raises: SettingsError: one cannot be read."""

    def __init__(self, terms: Sequence[CostTerm], model: Model) -> None:
        symbols = Symbols.of(model.system.N, model.system.commands_rates)
        values = [read_term(term.expression, symbols) for term in terms]
        super().__init__(values, symbols.x, symbols.p, model.system.vector())
        self._terms = tuple(terms)
        self.weights = np.array([term.weight for term in terms])  # of each term, per square of its unit, (t,)

    def about(self, x: Array) -> Array:
        """Return the roots of the weights times the gradients, (t, n). Raises: SettingsError: one is not finite."""
        values, slopes = self.at(x)
        for term, value, slope in zip(self._terms, values, slopes, strict=True):
            if not np.isfinite([value, *slope]).all():
                expected = "expected a finite value and slope at hover"
                raise SettingsError(f"cost {term.expression!r}: {expected}, got {value}")
        return np.asarray(np.sqrt(self.weights)[:, None] * slopes)
