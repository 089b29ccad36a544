"""The QP solvers against each other, against SciPy, and against answers made wrong on purpose."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import clarabel
import daqp
import numpy as np
import pytest

from tests.support.programs import collected, random_qp, without_solution
from transport.model.arrays import Array
from transport.mpc.program.qp_solvers import RESIDUAL_TOLERANCE, solve, solve_clarabel, solve_daqp
from transport.mpc.program.quadratic_program import QP, residuals
from transport.mpc.settings_period_horizon_weights import SolverName

# Relative to the largest entry: two solvers meeting the residual tolerance on well-conditioned
# programs.
AGREEMENT = 1e-6
# Half ranges of the inputs. A shared slack under many active rows leaves Clarabel, which stops at a
# duality gap of 1e-9, sqrt(2 * 1e-9 / 0.005) away at most, 0.005 being the weakest curvature (of
# the yaw moments).
AGREEMENT_WITH_SLACK = 6e-4
# Relative to the objective: quadratic around the optimum, so far below the answers' own agreement.
OBJECTIVE_AGREEMENT = 1e-8

NAMES: list[SolverName] = ["daqp", "clarabel"]
OTHER: dict[SolverName, SolverName] = {"daqp": "clarabel", "clarabel": "daqp"}


def agree(qp: QP, within: float = AGREEMENT) -> None:
    """Both solvers solve the program, pass the residual check, and find the same point and objective."""
    first, second = solve_daqp(qp), solve_clarabel(qp)
    for answer in (first, second):
        assert answer.status == "solved"
        found = residuals(qp, answer.z, answer.bound_multipliers, answer.row_multipliers)
        assert found == answer.residuals
        assert found.worst <= RESIDUAL_TOLERANCE
    scale = max(1.0, float(np.abs(first.z).max()))
    assert np.abs(first.z - second.z).max() <= within * scale
    assert qp.objective(first.z) == pytest.approx(
        qp.objective(second.z), rel=OBJECTIVE_AGREEMENT, abs=OBJECTIVE_AGREEMENT
    )


@pytest.mark.parametrize("seed", range(60))
def test_two_solvers_agree(seed: int) -> None:
    """On random strictly convex programs an active-set and an interior-point method meet at the one optimum."""
    agree(random_qp(seed))


@pytest.mark.parametrize(("minimum_m", "within"), [(0.4, AGREEMENT), (0.55, AGREEMENT_WITH_SLACK)])
def test_two_solvers_agree_on_the_controllers_programs(minimum_m: float, within: float) -> None:
    """The same holds for the programs of a real climb, paper (17), (20)-(21), (25)-(27), with constraints active."""
    programs = collected(minimum_m)
    for qp in programs:
        agree(qp, within)
    pushed = [np.abs(solve_daqp(qp).row_multipliers).max() > 1e-3 for qp in programs]
    assert all(pushed), "programs without active rows would show little"


@pytest.mark.parametrize("name", NAMES)
def test_closed_form(name: SolverName) -> None:
    """Minimise 1/2 |z|^2 - 3 z1 with z1 <= 1 and z1 + z2 = 4.

    Z = (1, 3), multipliers 5 and -3 by hand.
    """
    qp = QP(
        H=np.eye(2), g=np.array([-3.0, 0.0]), lower=np.full(2, -np.inf), upper=np.array([1.0, np.inf]),
        A=np.ones((1, 2)), row_lower=np.array([4.0]), row_upper=np.array([4.0]),
    )  # fmt: skip
    answer = solve(qp, name)
    assert answer.z == pytest.approx([1.0, 3.0], abs=AGREEMENT)
    assert answer.row_multipliers == pytest.approx([-3.0], abs=AGREEMENT)
    assert answer.bound_multipliers == pytest.approx([5.0, 0.0], abs=AGREEMENT)
    assert answer.solver == name
    assert not answer.fallback


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("program", without_solution())
def test_infeasible_is_data(program: str, name: SolverName) -> None:
    """A program without solution comes back as status "infeasible" after both were asked, never as an exception."""
    answer = solve(without_solution()[program], name)
    assert answer.status == "infeasible"
    assert answer.residuals.worst == np.inf
    assert answer.solver == OTHER[name]
    assert answer.fallback


def test_iteration_limit_hands_over() -> None:
    """DAQP cut short says "limit", and Clarabel's answer, flagged as fallback, is the optimum."""
    qp = collected(0.4)[-1]
    expected = solve_daqp(qp)
    assert expected.iterations > 2
    assert solve_daqp(qp, most_iterations=2).status == "limit"
    answer = solve(qp, "daqp", most_iterations=2)
    assert (answer.status, answer.solver, answer.fallback) == ("solved", "clarabel", True)
    assert np.abs(answer.z - expected.z).max() <= AGREEMENT * max(
        1.0, float(np.abs(expected.z).max())
    )


@pytest.mark.parametrize("said", ["InsufficientProgress", "PrimalInfeasible"])
def test_daqp_is_behind_clarabel(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Clarabel, chosen first, finds no optimum, DAQP's answer, flagged as fallback, is it."""
    qp = collected(0.4)[-1]
    expected = solve_daqp(qp)
    honest = clarabel.DefaultSolver

    def stuck(*arguments: Any) -> Any:
        answer = honest(*arguments).solve()
        changed = SimpleNamespace(x=answer.x, z=answer.z, iterations=answer.iterations, status=said)
        return SimpleNamespace(solve=lambda: changed)

    monkeypatch.setattr(clarabel, "DefaultSolver", stuck)
    answer = solve(qp, "clarabel")
    assert (answer.status, answer.solver, answer.fallback) == ("solved", "daqp", True)
    assert np.array_equal(answer.z, expected.z)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["at most", "at least"])
@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e6, 1e9])
def test_the_unit_of_a_row_does_not_matter(unit: float, sign: float, name: SolverName) -> None:
    """A program has the same optimum, and multipliers in the rows' units, whatever these units are.

    Minimise 1/2 |z|^2 - 3 z1 - 3 z2 with z1 + z2 <= 4 in this unit: z = (2, 2), multiplier 1 / unit.
    A row without decisions, as of an expression at its extremum, has none.
    """
    by = sign * unit
    ends = np.sort([4.0 * by, by * -np.inf])
    qp = QP(
        H=np.eye(2), g=np.full(2, -3.0), lower=np.full(2, -10.0), upper=np.full(2, 10.0),
        A=np.array([[by, by], [0.0, 0.0]]),
        row_lower=np.array([ends[0], -np.inf]), row_upper=np.array([ends[1], 1.0]),
    )  # fmt: skip
    answer = solve(qp, name, any_rows=True)
    assert answer.status == "solved"
    assert answer.z == pytest.approx([2.0, 2.0], abs=AGREEMENT)
    assert by * answer.row_multipliers[0] == pytest.approx(1.0, abs=AGREEMENT)
    assert answer.row_multipliers[1] == pytest.approx(0.0, abs=AGREEMENT)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("field", ["H", "g"])
def test_a_cost_that_is_no_number_has_no_solution(field: str, name: SolverName) -> None:
    """It is no program for a solver, whichever is chosen: the answer says so without an error."""
    qp = random_qp(0)
    broken = getattr(qp, field).copy()
    broken[-1] = np.nan
    answer = solve(replace(qp, **{field: broken}), name)
    assert (answer.status, answer.solver, answer.fallback) == ("numerical", name, False)
    assert not answer.z.any()


@pytest.mark.parametrize("name", NAMES)
def test_a_row_out_of_range_has_no_solution(name: SolverName) -> None:
    """Beside one that is scaled it stays infinite: the answer is no solution, without an error."""
    qp = QP(
        H=np.eye(2), g=np.full(2, -3.0), lower=np.full(2, -10.0), upper=np.full(2, 10.0),
        A=np.array([[1e6, 1e6], [np.inf, 0.0]]),
        row_lower=np.full(2, -np.inf), row_upper=np.array([4e6, 1.0]),
    )  # fmt: skip
    with warnings.catch_warnings(action="error"):
        answer = solve(qp, name, any_rows=True)
    assert answer.status != "solved"


Lie = Callable[[Array, Array], tuple[Array, Array]]
LIES: dict[str, Lie] = {
    "point moved": lambda z, lam: (z + 1e-3, lam),
    "multipliers forgotten": lambda z, lam: (z, 0.0 * lam),
    "multipliers of the wrong sign": lambda z, lam: (z, -lam),
    "multipliers scaled": lambda z, lam: (z, 1.01 * lam),
    "no number": lambda z, lam: (np.full_like(z, np.nan), lam),
}


@pytest.mark.parametrize("lie", LIES)
def test_lying_solver_is_not_believed(lie: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that reports success with a wrong answer fails the residual check and the other one takes over."""
    qp = collected(0.4)[-1]
    expected = solve_clarabel(qp)
    honest = daqp.solve

    def dishonest(*arguments: Any, **keywords: Any) -> Any:
        z, value, flag, info = honest(*arguments, **keywords)
        z, info["lam"] = LIES[lie](np.asarray(z), np.asarray(info["lam"]))
        return z, value, flag, info

    monkeypatch.setattr(daqp, "solve", dishonest)
    first = solve_daqp(qp)
    assert first.status == "numerical"
    assert first.residuals.worst > RESIDUAL_TOLERANCE
    answer = solve(qp, "daqp")
    assert (answer.status, answer.solver, answer.fallback) == ("solved", "clarabel", True)
    assert np.array_equal(answer.z, expected.z)


@pytest.mark.parametrize(
    ("program", "said", "status"),
    [
        (random_qp(0), "AlmostSolved", "solved"),
        (without_solution()["two ranges"], "AlmostPrimalInfeasible", "infeasible"),
        (random_qp(0), "InsufficientProgress", "numerical"),
    ],
    ids=["solution", "no solution", "no progress"],
)
def test_a_solver_that_is_almost_sure_is_believed(
    program: QP, said: str, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clarabel's reduced accuracy counts as its full one: the residual check decides."""
    honest = clarabel.DefaultSolver

    def unsure(*arguments: Any) -> Any:
        answer = honest(*arguments).solve()
        changed = SimpleNamespace(x=answer.x, z=answer.z, iterations=answer.iterations, status=said)
        return SimpleNamespace(solve=lambda: changed)

    expected = solve_clarabel(program)
    monkeypatch.setattr(clarabel, "DefaultSolver", unsure)
    answer = solve_clarabel(program)
    assert answer.status == status
    if status == "solved":
        assert np.array_equal(answer.z, expected.z)
        assert answer.residuals == expected.residuals
