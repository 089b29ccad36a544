"""The quadratic program and the optimality check that every solution must pass.

minimise 1/2 z' H z + g' z   subject to   lower <= z <= upper,   row_lower <= A z <= row_upper
"""

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np

from model import native
from model.arrays import Array

Status = Literal["solved", "infeasible", "limit", "numerical"]

# Largest residual of a solved QP, relative to its data: solvers then agree in the stage cost to 1e-6 relative, where
# 1e-3 is required.
RESIDUAL_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class QP:
    """The data of one program; equalities are rows with equal bounds, missing bounds are infinite."""

    H: Array  # positive definite, (n, n)
    g: Array  # (n,)
    lower: Array  # bounds on z, (n,)
    upper: Array
    A: Array  # rows, (r, n)
    row_lower: Array  # bounds on A z, (r,)
    row_upper: Array

    @cached_property
    def addresses(self) -> list[int]:
        """Addresses of the data for the compiled kernels; row-major copies are kept where needed."""
        data = (self.H, self.g, self.lower, self.upper, self.A, self.row_lower, self.row_upper)
        self.__dict__["_row_major"] = rows = [np.ascontiguousarray(array) for array in data]
        return [native.at(array) for array in rows]

    def __getstate__(self) -> dict[str, Array]:
        """Return the data for copies, which have addresses of their own."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def objective(self, z: Array) -> float:
        """Return 1/2 z' H z + g' z."""
        return float(z @ (0.5 * (self.H @ z) + self.g))


@dataclass(frozen=True, slots=True)
class Residuals:
    """The violations of the optimality conditions, relative to the data."""

    stationarity: float  # |H z + g + multipliers| relative to 1 + |g|
    primal: float  # largest violation of a bound or row, relative to 1 + |z|
    complementarity: float  # largest multiplier times distance to its bound, relative to 1 + |objective|

    @property
    def worst(self) -> float:
        """Largest of the three; nan counts as infinite."""
        values = (self.stationarity, self.primal, self.complementarity)
        return max(values) if math.isfinite(sum(values)) else np.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """The result of a solver, also of one that failed."""

    status: Status  # "solved" only if the residuals pass
    z: Array  # (n,), meaningless unless solved
    bound_multipliers: Array  # (n,), positive when the upper bound pushes
    row_multipliers: Array  # (r,), positive when the upper bound pushes
    residuals: Residuals  # optimality conditions at z
    iterations: int  # the solver's own count
    solver: str
    fallback: bool = False  # the chosen solver failed, and this one solved or tried


def residuals(qp: QP, z: Array, bound_multipliers: Array, row_multipliers: Array) -> Residuals:
    """Return the Karush-Kuhn-Tucker residuals; arguments as in `Solution`. Source: docs/equations.md (28)."""
    if native.AVAILABLE:
        return Residuals(*native.residuals(qp.A.shape, qp.addresses, z, bound_multipliers, row_multipliers))
    return _residuals(qp, z, bound_multipliers, row_multipliers)


def _residuals(qp: QP, z: Array, bound_multipliers: Array, row_multipliers: Array) -> Residuals:
    values = np.concatenate([z, qp.A @ z])
    multipliers = np.concatenate([bound_multipliers, row_multipliers])
    lower = np.concatenate([qp.lower, qp.row_lower])
    upper = np.concatenate([qp.upper, qp.row_upper])
    slope = qp.H @ z + qp.g + bound_multipliers + row_multipliers @ qp.A
    outside = np.maximum(np.maximum(lower - values, values - upper), 0.0)
    # A multiplier at an infinite bound must be zero, so its own size is the violation.
    to_upper = np.where(np.isfinite(upper), upper - values, 1.0)
    to_lower = np.where(np.isfinite(lower), values - lower, 1.0)
    slackness = np.where(multipliers > 0.0, multipliers * to_upper, -multipliers * to_lower)
    return Residuals(
        stationarity=float(np.abs(slope).max() / (1.0 + np.abs(qp.g).max())),
        primal=float(outside.max() / (1.0 + np.abs(z).max())),
        complementarity=float(np.abs(slackness).max() / (1.0 + abs(qp.objective(z)))),
    )
