"""The quadratic program, its solvers (DAQP, Clarabel), and the optimality check that every solution must pass.

minimise 1/2 z' H z + g' z   subject to   lower <= z <= upper,   row_lower <= A z <= row_upper
"""

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal

import clarabel
import daqp
import numpy as np

from transport.model import native
from transport.model.arrays import Array
from transport.mpc.settings import SolverName

Status = Literal["solved", "infeasible", "limit", "numerical"]

# Largest residual of a solved QP, relative to its data: solvers then agree in the stage cost to
# 1e-6.
RESIDUAL_TOLERANCE = 1e-6
# A usual QP needs one guess of its active bounds, others two or three; the limit ends a cycle.
MOST_GUESSES = 8
_ITERATIONS = 2000  # DAQP needs about as many as active constraints; the limit ends a cycle
_INFINITY = 1e30  # DAQP's own
_DAQP: dict[int, Status] = {-1: "infeasible", -4: "limit"}
_CLARABEL: dict[str, Status] = {
    "Solved": "solved", "PrimalInfeasible": "infeasible", "MaxIterations": "limit", "MaxTime": "limit"
}  # fmt: skip


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
        return [native.at(array) for array in data]

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
    complementarity: (
        float  # largest multiplier times distance to its bound, relative to 1 + |objective|
    )

    @property
    def worst(self) -> float:
        """Largest of the three; nan counts as infinite."""
        values = (self.stationarity, self.primal, self.complementarity)
        return max(values) if math.isfinite(sum(values)) else np.inf


_NO_RESIDUALS = Residuals(np.inf, np.inf, np.inf)


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
    """Return the Karush-Kuhn-Tucker residuals.

    Arguments as in `Solution`. Source: docs/equations.md (28).
    """
    if native.AVAILABLE:
        (rows, n), found, answer = (
            qp.A.shape,
            np.empty(3),
            map(native.at, (z, bound_multipliers, row_multipliers)),
        )
        native.KERNELS.residuals(
            n, rows, *qp.addresses, *answer, native.at(found), native.work("residuals", n)
        )
        return Residuals(*found.tolist())
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


def solve(qp: QP, solver: SolverName) -> Solution:
    """Solve by the chosen solver, check the residuals, and use Clarabel as fallback.

    Return the last failure else.
    """
    first = within_bounds(qp) if solver == "daqp" else None
    if first is not None:
        return first
    if not (np.isfinite(qp.g).all() and np.isfinite(qp.H).all()):
        return unsolved(len(qp.g), len(qp.A), solver)
    if solver == "clarabel":
        return solve_clarabel(qp)
    first = solve_daqp(qp)
    return first if first.status == "solved" else replace(solve_clarabel(qp), fallback=True)


def unsolved(n: int, rows: int, solver: str) -> Solution:
    """Return the failure of a QP that is not solved because its numbers are out of range."""
    return Solution(
        status="numerical", z=np.zeros(n), bound_multipliers=np.zeros(n), row_multipliers=np.zeros(rows),
        residuals=_NO_RESIDUALS, iterations=0, solver=solver,
    )  # fmt: skip


def within_bounds(qp: QP) -> Solution | None:
    """Return the solution of a QP in which no row is active, else None (Hintermueller, Ito, Kunisch 2003)."""
    if not native.AVAILABLE:
        return None
    (rows, n), z, multipliers, found = (
        qp.A.shape,
        np.empty_like(qp.g),
        np.empty_like(qp.g),
        np.empty(3),
    )
    work = native.work("within_bounds", native.KERNELS.within_bounds_work(n, rows))
    answer = map(native.at, (z, multipliers, found))
    guesses = native.KERNELS.solve_within_bounds(
        n, rows, *qp.addresses, MOST_GUESSES, *answer, work
    )
    if guesses <= 0 or (passed := Residuals(*found.tolist())).worst > RESIDUAL_TOLERANCE:
        return None
    return Solution(
        status="solved", z=z, bound_multipliers=multipliers, row_multipliers=np.zeros(len(qp.A)),
        residuals=passed, iterations=guesses, solver="active_set",
    )  # fmt: skip


def solve_daqp(qp: QP) -> Solution:
    """Dual active-set method (Arnstrom, Bemporad, Axehill 2022)."""
    lower = np.maximum(np.concatenate([qp.lower, qp.row_lower]), -_INFINITY)
    upper = np.minimum(np.concatenate([qp.upper, qp.row_upper]), _INFINITY)
    sense = np.where(lower == upper, 5, 0).astype(np.int32)
    z, _, flag, info = daqp.solve(
        np.ascontiguousarray(qp.H), qp.g, np.ascontiguousarray(qp.A), upper, lower, sense,
        iter_limit=_ITERATIONS, primal_tol=1e-9, dual_tol=1e-9,
    )  # fmt: skip
    status: Status = "solved" if flag > 0 else _DAQP.get(flag, "numerical")
    bounds, rows = np.split(np.asarray(info["lam"], dtype=np.float64), [len(qp.g)])
    return _checked(qp, np.asarray(z), bounds, rows, status, int(info["iterations"]), "daqp")


def solve_clarabel(qp: QP) -> Solution:
    """Interior-point method (Goulart, Chen 2024), single-threaded so that equal data give equal bits."""
    from scipy import sparse  # 0.3 s at start, and only this solver needs it

    n = len(qp.g)
    equal = qp.row_lower == qp.row_upper
    has_upper, has_lower = np.isfinite(qp.row_upper) & ~equal, np.isfinite(qp.row_lower) & ~equal
    bound_upper, bound_lower = np.isfinite(qp.upper), np.isfinite(qp.lower)
    identity = np.eye(n)
    G = np.concatenate(
        [
            qp.A[equal],
            identity[bound_upper],
            -identity[bound_lower],
            qp.A[has_upper],
            -qp.A[has_lower],
        ]
    )
    parts = (
        qp.row_upper[equal],
        qp.upper[bound_upper],
        -qp.lower[bound_lower],
        qp.row_upper[has_upper],
    )
    h = np.concatenate([*parts, -qp.row_lower[has_lower]])
    equalities = int(equal.sum())
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.direct_solve_method = "qdldl"
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.ZeroConeT(equalities), clarabel.NonnegativeConeT(len(h) - equalities)]
    H = sparse.triu(sparse.csc_matrix(qp.H), format="csc")
    answer = clarabel.DefaultSolver(H, qp.g, sparse.csc_matrix(G), h, cones, settings).solve()
    status = _CLARABEL.get(str(answer.status).removeprefix("Almost"), "numerical")
    duals = np.split(np.asarray(answer.z), np.cumsum([len(part) for part in parts]))
    bounds, rows = np.zeros(n), np.zeros(len(qp.A))
    rows[equal] = duals[0]
    bounds[bound_upper] += duals[1]
    bounds[bound_lower] -= duals[2]
    rows[has_upper] += duals[3]
    rows[has_lower] -= duals[4]
    return _checked(
        qp, np.asarray(answer.x), bounds, rows, status, int(answer.iterations), "clarabel"
    )


def _checked(
    qp: QP, z: Array, bounds: Array, rows: Array, status: Status, iterations: int, solver: str
) -> Solution:
    """Return the solution with multipliers of bounds and rows, with status "solved" only if the residuals pass."""
    found = _NO_RESIDUALS
    if status == "solved":
        found = residuals(qp, z, bounds, rows)
        if found.worst > RESIDUAL_TOLERANCE:
            status = "numerical"
    return Solution(
        status=status, z=z, bound_multipliers=bounds, row_multipliers=rows,
        residuals=found, iterations=iterations, solver=solver,
    )  # fmt: skip
