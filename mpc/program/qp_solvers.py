"""Solvers of the quadratic program, each followed by the check of its residuals.

`solve` tries, until one passes the check: the program with bounds alone, the chosen solver, the other one.
"""

from dataclasses import dataclass, replace

import clarabel
import daqp
import msgspec
import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array
from transport.model.kernels import native
from transport.mpc.program.quadratic_program import (
    NO_RESIDUALS,
    QP,
    RESIDUALS,
    Residuals,
    Solution,
    Status,
    residuals,
    unsolved,
)
from transport.mpc.settings_period_horizon_weights import SolverName

# Largest residual of a solved QP, relative to its data: solvers then agree in the stage cost to 1e-6.
RESIDUAL_TOLERANCE = 1e-6
# A usual QP needs one guess of its active bounds, others two or three; the limit ends a cycle.
MOST_GUESSES = 8
# Largest entry of a row that is solved as it is, and the inverse of the smallest one.
_USUAL_ROW = 4096.0
MOST_ITERATIONS = 2000  # DAQP needs about as many as active constraints; the limit ends a cycle
_TOLERANCE = 1e-9  # of DAQP, primal and dual
_INTERIOR_TOLERANCE = 1e-11  # of Clarabel
_INFINITY = 1e30  # DAQP's own
_EQUALITY = 5  # DAQP's sense of a row that is active and stays so
_DAQP: dict[int, Status] = {-1: "infeasible", -4: "limit"}
_CLARABEL: dict[str, Status] = {
    "Solved": "solved",
    "PrimalInfeasible": "infeasible",
    "MaxIterations": "limit",
    "MaxTime": "limit",
}


def solve(
    qp: QP,
    solver: SolverName,
    most_iterations: int = MOST_ITERATIONS,
    *,
    any_rows: bool = False,
) -> Solution:
    """Solve by the chosen solver, check the residuals, and use the other one where that fails.

    With DAQP the program with bounds alone is tried first. If all fail, return the last failure,
    "infeasible" if one of them has found so.

    Args:
        qp: The program.
        solver: The first one.
        most_iterations: Limit of DAQP where it is the first.
        any_rows: Whether rows may be of any size, as those from a user's expressions; unusual ones
            are scaled before. The controller's own are of order one.
    """
    factors = _row_factors(qp.A) if any_rows else None
    if factors is not None:
        scaled = replace(
            qp,
            A=factors[:, None] * qp.A,
            row_lower=factors * qp.row_lower,
            row_upper=factors * qp.row_upper,
        )
        solution = solve(scaled, solver, most_iterations)
        return msgspec.structs.replace(solution, row_multipliers=factors * solution.row_multipliers)

    if solver == "daqp":
        by_bounds = within_bounds(qp)
        if by_bounds is not None:
            return by_bounds
    if not (np.isfinite(qp.g).all() and np.isfinite(qp.H).all()):
        return unsolved(len(qp.g), len(qp.A), solver)

    is_daqp = solver == "daqp"
    first = solve_daqp(qp, most_iterations) if is_daqp else solve_clarabel(qp)
    if first.status == "solved":
        return first
    second = solve_clarabel(qp) if is_daqp else solve_daqp(qp)
    # One of them may find no solution where the other only makes no progress.
    is_infeasible = second.status != "solved" and first.status == "infeasible"
    status = "infeasible" if is_infeasible else second.status
    return msgspec.structs.replace(second, status=status, fallback=True)


def _row_factors(A: Array) -> Array | None:
    """Return the factors, powers of two, that make rows of an unusual size about as large as one.

    The unit of a user's expression is free, the tolerance of a solver is not: a row in units of
    1e-8 N holds within it at any thrust, and one in units of 1e6 N at none. None where all rows are usual.
    """
    if not A.size:
        return None
    largest = np.maximum(A.max(axis=1), -A.min(axis=1))
    is_small = (largest < 1.0 / _USUAL_ROW) & (largest > 0.0)
    is_large = (largest > _USUAL_ROW) & (largest < np.inf)
    unusual = is_small | is_large
    if not unusual.any():
        return None
    factors = np.ones(len(largest))
    factors[unusual] = np.exp2(-np.round(np.log2(largest[unusual])))
    return factors


def within_bounds(qp: QP) -> Solution | None:
    """Return the solution of a QP in which no row is active, else None.

    Primal-dual active-set method (Hintermueller, Ito, Kunisch 2003), by the compiled kernel.
    """
    if not native.AVAILABLE:
        return None
    rows, n = qp.A.shape
    # z, the multipliers of the bounds, and the residuals, one after the other.
    answer = np.empty(2 * n + RESIDUALS)
    begin = native.address(answer)
    places = begin, begin + n * answer.itemsize, begin + 2 * n * answer.itemsize
    guesses = native.KERNELS.solve_within_bounds(
        n, rows, *qp.addresses, MOST_GUESSES, *places, qp.work
    )
    if guesses <= 0:  # 0: no such solution, or equalities; -1: H or g is not finite
        return None

    z = answer[:n]
    multipliers = answer[n : 2 * n]
    checked = Residuals(*answer[2 * n :].tolist())
    if checked.worst > RESIDUAL_TOLERANCE:
        return None
    return Solution(
        status="solved",
        z=z,
        bound_multipliers=multipliers,
        row_multipliers=np.zeros(rows),
        residuals=checked,
        iterations=guesses,
        solver="active_set",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Answer:
    """The answer of a solver, not checked yet."""

    status: Status
    z: Array
    bounds: Array  # multipliers of the bounds
    rows: Array  # multipliers of the rows
    iterations: int
    solver: SolverName


def solve_daqp(qp: QP, most_iterations: int = MOST_ITERATIONS) -> Solution:
    """Solve by the dual active-set method of Arnstrom, Bemporad, Axehill 2022."""
    lower = np.maximum(np.concatenate([qp.lower, qp.row_lower]), -_INFINITY)
    upper = np.minimum(np.concatenate([qp.upper, qp.row_upper]), _INFINITY)
    sense = np.where(lower == upper, _EQUALITY, 0).astype(np.int32)
    z, _, flag, info = daqp.solve(
        np.ascontiguousarray(qp.H),
        qp.g,
        np.ascontiguousarray(qp.A),
        upper,
        lower,
        sense,
        iter_limit=most_iterations,
        primal_tol=_TOLERANCE,
        dual_tol=_TOLERANCE,
    )
    status: Status = "solved" if flag > 0 else _DAQP.get(flag, "numerical")
    bounds, rows = np.split(np.asarray(info["lam"], dtype=np.float64), [len(qp.g)])
    iterations = int(info["iterations"])
    return _checked(
        qp,
        _Answer(
            status=status,
            z=np.asarray(z),
            bounds=bounds,
            rows=rows,
            iterations=iterations,
            solver="daqp",
        ),
    )


def solve_clarabel(qp: QP) -> Solution:
    """Solve by the interior-point method of Goulart, Chen 2024.

    Single-threaded, so that equal data give equal bits.
    """
    from scipy import sparse  # 0.3 s at start, and only this solver needs it

    sides = _Sides.of(qp)
    blocks = sides.blocks(qp)
    G = np.concatenate([rows for rows, _ in blocks])
    h = np.concatenate([bounds for _, bounds in blocks])
    lengths = [len(bounds) for _, bounds in blocks]
    # Equalities come first: G z + s = h with s = 0 there, and s >= 0 in all others.
    cones = [clarabel.ZeroConeT(lengths[0]), clarabel.NonnegativeConeT(sum(lengths[1:]))]
    H = sparse.triu(sparse.csc_matrix(qp.H), format="csc")
    solver = clarabel.DefaultSolver(H, qp.g, sparse.csc_matrix(G), h, cones, _clarabel_settings())
    answer = solver.solve()

    duals = np.split(np.asarray(answer.z), np.cumsum(lengths[:-1]))
    bounds, rows = sides.multipliers(duals)
    return _checked(
        qp,
        _Answer(
            status=_CLARABEL.get(str(answer.status).removeprefix("Almost"), "numerical"),
            z=np.asarray(answer.x),
            bounds=bounds,
            rows=rows,
            iterations=int(answer.iterations),
            solver="clarabel",
        ),
    )


def _clarabel_settings() -> clarabel.DefaultSettings:
    """Return the settings of Clarabel: quiet, by one thread, to its tolerance."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.direct_solve_method = "qdldl"
    settings.tol_gap_abs = _INTERIOR_TOLERANCE
    settings.tol_gap_rel = _INTERIOR_TOLERANCE
    settings.tol_feas = _INTERIOR_TOLERANCE
    return settings


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sides:
    """Places of the bounds and rows of a QP that have an equality, an upper or a lower side.

    Blocks of rows and their multipliers come in the order of the fields.
    """

    equal: npt.NDArray[np.bool_]  # (r,)
    upper: npt.NDArray[np.bool_]  # (n,)
    lower: npt.NDArray[np.bool_]  # (n,)
    row_upper: npt.NDArray[np.bool_]  # (r,)
    row_lower: npt.NDArray[np.bool_]  # (r,)

    @staticmethod
    def of(qp: QP) -> "_Sides":
        """Return the places of a QP."""
        equal = qp.row_lower == qp.row_upper
        return _Sides(
            equal=equal,
            upper=np.isfinite(qp.upper),
            lower=np.isfinite(qp.lower),
            row_upper=np.isfinite(qp.row_upper) & ~equal,
            row_lower=np.isfinite(qp.row_lower) & ~equal,
        )

    def blocks(self, qp: QP) -> list[tuple[Array, Array]]:
        """Return rows G and sides h of each block: G z = h in the first one, G z <= h in the others."""
        identity = np.eye(len(qp.g))
        return [
            (qp.A[self.equal], qp.row_upper[self.equal]),
            (identity[self.upper], qp.upper[self.upper]),
            (-identity[self.lower], -qp.lower[self.lower]),
            (qp.A[self.row_upper], qp.row_upper[self.row_upper]),
            (-qp.A[self.row_lower], -qp.row_lower[self.row_lower]),
        ]

    def multipliers(self, duals: list[Array]) -> tuple[Array, Array]:
        """Return multipliers of bounds and rows, positive at upper sides, from those of the blocks."""
        of_equal, of_upper, of_lower, of_row_upper, of_row_lower = duals
        bounds = np.zeros(len(self.upper))
        bounds[self.upper] += of_upper
        bounds[self.lower] -= of_lower

        rows = np.zeros(len(self.equal))
        rows[self.equal] = of_equal
        rows[self.row_upper] += of_row_upper
        rows[self.row_lower] -= of_row_lower
        return bounds, rows


def _checked(qp: QP, answer: _Answer) -> Solution:
    """Return the solution, with status "solved" only if the residuals pass."""
    status = answer.status
    conditions = NO_RESIDUALS
    if status == "solved":
        conditions = residuals(qp, answer.z, answer.bounds, answer.rows)
        if conditions.worst > RESIDUAL_TOLERANCE:
            status = "numerical"
    return Solution(
        status=status,
        z=answer.z,
        bound_multipliers=answer.bounds,
        row_multipliers=answer.rows,
        residuals=conditions,
        iterations=answer.iterations,
        solver=answer.solver,
    )
