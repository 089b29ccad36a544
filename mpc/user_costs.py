"""The user's own terms of the cost."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.dynamics import Symbols
from model.linearisation import Model
from mpc.expressions import Affine, Expressions, read_term
from mpc.settings import CostTerm, SettingsError


class UserCosts:
    """Weighted squares of the user's expressions of the state, with exact derivatives.

    Raises: SettingsError: one cannot be read; the text says which and why.

    Attributes:
        weights: Of each term, per square of its unit, (t,).
    """

    def __init__(self, terms: Sequence[CostTerm], model: Model) -> None:
        symbols = Symbols.of(model.system.N)
        self._terms = tuple(terms)
        self.weights = np.array([term.weight for term in terms])
        values = [read_term(term.expression, symbols) for term in terms]
        self._expressions = Expressions(values, symbols.x, symbols.p, model.system.vector())

    def __len__(self) -> int:
        return len(self._terms)

    def at(self, x: Array) -> Affine:
        """Linearise about a state. Source: docs/equations.md (48)."""
        return self._expressions.at(x)

    def about(self, x: Array) -> Array:
        """Return the square roots of the weights times the gradients at a state, (t, n).

        Raises: SettingsError: a term has no finite value and slope there.
        """
        at = self.at(x)
        for term, value, slope in zip(self._terms, at.value, at.slope, strict=True):
            if not np.isfinite([value, *slope]).all():
                expected = "expected a finite value and slope at hover"
                raise SettingsError(f"cost {term.expression!r}: {expected}, got {value}")
        roots: Array = np.sqrt(self.weights)[:, None] * at.slope
        return roots
