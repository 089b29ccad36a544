"""The quadratic program, its solution, and the residuals that every solution must pass.

minimise 1/2 z' H z + g' z   subject to   lower <= z <= upper,   row_lower <= A z <= row_upper
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.model.kernels import native

Status = Literal["solved", "infeasible", "limit", "numerical"]


@dataclass(frozen=True, kw_only=True)
class QP:
    """The data of one program, row-major.

    Equalities are rows with equal bounds, missing bounds are infinite.
    """

    H: Array  # positive definite, (n, n)
    g: Array  # (n,)
    lower: Array  # bounds on z, (n,)
    upper: Array
    A: Array  # rows, (r, n)
    row_lower: Array  # bounds on A z, (r,)
    row_upper: Array

    @cached_property
    def addresses(self) -> list[int]:
        """Addresses of the data, row-major, for the compiled kernels."""
        data = self.H, self.g, self.lower, self.upper, self.A, self.row_lower, self.row_upper
        return [native.address(array) for array in data]

    @cached_property
    def work(self) -> int:
        """Address of a work space for `within_bounds`, for the compiled kernels."""
        rows, n = self.A.shape
        return native.work("within_bounds", native.KERNELS.within_bounds_work(n, rows))

    def __getstate__(self) -> dict[str, Array]:
        """Return the data for copies, which have addresses of their own."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def objective(self, z: Array) -> float:
        """Return 1/2 z' H z + g' z."""
        return float(z @ (0.5 * (self.H @ z) + self.g))


class Residuals(msgspec.Struct, frozen=True):
    """The violations of the optimality conditions, relative to the data."""

    stationarity: float  # |H z + g + multipliers| relative to 1 + |g|
    primal: float  # largest violation of a bound or row, relative to 1 + |z|
    # Largest multiplier times distance to its bound, relative to 1 + |objective|.
    complementarity: float

    @property
    def worst(self) -> float:
        """Largest of the three; nan counts as infinite."""
        values = (self.stationarity, self.primal, self.complementarity)
        return max(values) if math.isfinite(sum(values)) else np.inf


NO_RESIDUALS = Residuals(np.inf, np.inf, np.inf)
RESIDUALS = 3  # numbers


class Solution(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a solver, also of one that failed."""

    status: Status  # "solved" only if the residuals pass, or if nothing of it is used
    z: Array  # (n,), meaningless unless solved
    bound_multipliers: Array  # (n,), positive when the upper bound pushes
    row_multipliers: Array  # (r,), positive when the upper bound pushes
    residuals: Residuals  # optimality conditions at z
    iterations: int  # the solver's own count
    solver: str
    fallback: bool = False  # the chosen solver failed, and this one solved or tried
    # Planned violations of hard constraints that no plan meets, by expression, in its unit.
    violations: Mapping[str, float] = msgspec.field(default_factory=dict)


def residuals(qp: QP, z: Array, bound_multipliers: Array, row_multipliers: Array) -> Residuals:
    """Return the Karush-Kuhn-Tucker residuals of a solution, arguments as in `Solution`.

    H z + g + m + A' m_rows = 0,   lower <= z <= upper,   m (distance to its bound) = 0
    Source: docs/equations.md (28).
    """
    if native.AVAILABLE:
        return _compiled_residuals(qp, z, bound_multipliers, row_multipliers)
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


def _compiled_residuals(
    qp: QP, z: Array, bound_multipliers: Array, row_multipliers: Array
) -> Residuals:
    """Return the residuals by the compiled kernel."""
    rows, n = qp.A.shape
    values = np.empty(RESIDUALS)
    solution = map(native.address, (z, bound_multipliers, row_multipliers))
    work = native.work("residuals", n)
    native.KERNELS.residuals(n, rows, *qp.addresses, *solution, native.address(values), work)
    return Residuals(*values.tolist())


def unsolved(n: int, rows: int, solver: str) -> Solution:
    """Return the failure of a QP that is not solved because its numbers are out of range."""
    return Solution(
        status="numerical",
        z=np.zeros(n),
        bound_multipliers=np.zeros(n),
        row_multipliers=np.zeros(rows),
        residuals=NO_RESIDUALS,
        iterations=0,
        solver=solver,
    )
