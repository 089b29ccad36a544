"""QP solvers behind one call: DAQP for speed, Clarabel as an alternative and the fallback."""

from dataclasses import replace

import clarabel
import daqp
import numpy as np

from model import native
from model.arrays import Array
from mpc.qp import QP, RESIDUAL_TOLERANCE, Residuals, Solution, Status, residuals
from mpc.settings import SolverName

# A usual QP needs one guess of its active bounds, others two or three; the limit ends a cycle.
MOST_GUESSES = 8
_ITERATIONS = 2000  # DAQP needs about as many as active constraints; the limit ends a cycle
_INFINITY = 1e30  # DAQP's own
_NO_RESIDUALS = Residuals(np.inf, np.inf, np.inf)
_DAQP: dict[int, Status] = {-1: "infeasible", -4: "limit"}
_CLARABEL: dict[str, Status] = {
    "Solved": "solved", "PrimalInfeasible": "infeasible", "MaxIterations": "limit", "MaxTime": "limit"
}  # fmt: skip


def solve(qp: QP, solver: SolverName) -> Solution:
    """Solve by the chosen solver, check the residuals, and use Clarabel as fallback; return the last failure else."""
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
    """Return the solution of the QP with its bounds alone if it passes the residual check of the whole QP.

    Most QPs have no active row, and preparing the rows is most of a solver's work. The kernel guesses active bounds,
    solves, releases and adds bounds until the guess is consistent (primal-dual active-set method: Hintermueller, Ito,
    Kunisch 2003). None without compiled kernels, and if the method cycles.
    """
    if not native.AVAILABLE:
        return None
    guesses, z, multipliers, found = native.solve_within_bounds(qp.A.shape, qp.addresses, MOST_GUESSES)
    if guesses <= 0 or (passed := Residuals(*found)).worst > RESIDUAL_TOLERANCE:
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
    G = np.concatenate([qp.A[equal], identity[bound_upper], -identity[bound_lower], qp.A[has_upper], -qp.A[has_lower]])
    parts = qp.row_upper[equal], qp.upper[bound_upper], -qp.lower[bound_lower], qp.row_upper[has_upper]
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
    return _checked(qp, np.asarray(answer.x), bounds, rows, status, int(answer.iterations), "clarabel")


def _checked(qp: QP, z: Array, bounds: Array, rows: Array, status: Status, iterations: int, solver: str) -> Solution:
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
