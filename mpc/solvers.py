"""QP solvers behind one call: DAQP for speed, Clarabel as an alternative and the fallback."""

from collections.abc import Callable
from dataclasses import replace

import clarabel
import daqp
import numpy as np

from model.arrays import Array
from mpc import bounded
from mpc.qp import QP, RESIDUAL_TOLERANCE, Residuals, Solution, Status, residuals
from mpc.settings import SolverName

_ITERATIONS = 2000  # DAQP needs about as many as active constraints; the limit ends a cycle
_INFINITY = 1e30  # DAQP's own
_NO_RESIDUALS = Residuals(stationarity=np.inf, primal=np.inf, complementarity=np.inf)
_CLARABEL: dict[str, Status] = {
    "Solved": "solved", "PrimalInfeasible": "infeasible", "MaxIterations": "limit", "MaxTime": "limit"
}  # fmt: skip


def solve(qp: QP, solver: SolverName) -> Solution:
    """Solve by the chosen solver, check the residuals, and use Clarabel as fallback; return the last failure else."""
    if not (np.isfinite(qp.g).all() and np.isfinite(qp.H).all()):
        return unsolved(len(qp.g), len(qp.A), solver)
    first = _SOLVERS[solver](qp)
    if first.status == "solved" or solver == "clarabel":
        return first
    return replace(solve_clarabel(qp), fallback=True)


def unsolved(n: int, rows: int, solver: str) -> Solution:
    """Return the failure of a QP that is not solved because its numbers are out of range."""
    return Solution(
        status="numerical", z=np.zeros(n), bound_multipliers=np.zeros(n), row_multipliers=np.zeros(rows),
        residuals=_NO_RESIDUALS, iterations=0, solver=solver,
    )  # fmt: skip


def solve_daqp(qp: QP) -> Solution:
    """Dual active-set method (Arnstrom, Bemporad, Axehill 2022).

    Most QPs of a run have no active row, and preparing the rows is most of the work: the QP with bounds alone is
    solved first, and its solution is accepted if it passes the residual check of the whole QP.
    """
    if not (qp.row_lower == qp.row_upper).any():
        z, multipliers, guesses = bounded.solve(qp.H, qp.g, qp.lower, qp.upper)
        if guesses:
            answer = _checked(qp, z, multipliers, np.zeros(len(qp.A)), "solved", guesses, "active_set")
            if answer.status == "solved":
                return answer
    z, multipliers, status, iterations = _daqp(qp)
    n = len(qp.g)
    return _checked(qp, z, multipliers[:n], multipliers[n:], status, iterations, "daqp")


def _daqp(qp: QP) -> tuple[Array, Array, Status, int]:
    """Return DAQP's z, multipliers of bounds and rows, status, iterations."""
    lower = np.maximum(np.concatenate([qp.lower, qp.row_lower]), -_INFINITY)
    upper = np.minimum(np.concatenate([qp.upper, qp.row_upper]), _INFINITY)
    sense = np.where(lower == upper, 5, 0).astype(np.int32)
    z, _, flag, info = daqp.solve(
        np.ascontiguousarray(qp.H), qp.g, np.ascontiguousarray(qp.A), upper, lower, sense,
        iter_limit=_ITERATIONS, primal_tol=1e-9, dual_tol=1e-9,
    )  # fmt: skip
    status: Status = "solved" if flag > 0 else "infeasible" if flag == -1 else "limit" if flag == -4 else "numerical"
    return np.asarray(z), np.asarray(info["lam"], dtype=np.float64), status, int(info["iterations"])


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
    bound_multipliers, row_multipliers = np.zeros(n), np.zeros(len(qp.A))
    row_multipliers[equal] = duals[0]
    bound_multipliers[bound_upper] += duals[1]
    bound_multipliers[bound_lower] -= duals[2]
    row_multipliers[has_upper] += duals[3]
    row_multipliers[has_lower] -= duals[4]
    return _checked(
        qp, np.asarray(answer.x), bound_multipliers, row_multipliers, status, int(answer.iterations), "clarabel"
    )


def _checked(
    qp: QP, z: Array, bound_multipliers: Array, row_multipliers: Array, status: Status, iterations: int, solver: str
) -> Solution:
    """Return the solution, with status "solved" only if the residuals pass."""
    found = _NO_RESIDUALS
    if status == "solved":
        found = residuals(qp, z, bound_multipliers, row_multipliers)
        if found.worst > RESIDUAL_TOLERANCE:
            status = "numerical"
    return Solution(
        status=status, z=z, bound_multipliers=bound_multipliers, row_multipliers=row_multipliers,
        residuals=found, iterations=iterations, solver=solver,
    )  # fmt: skip


_SOLVERS: dict[str, Callable[[QP], Solution]] = {"daqp": solve_daqp, "clarabel": solve_clarabel}
