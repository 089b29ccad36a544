"""A program without solution is data.

The shifted previous plan, a status that says so, never an exception.
"""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from tests.support.systems import Situation, controller, paper_setup, situation, step
from transport.mpc.controller import Controller, StepResult
from transport.mpc.program.prediction import Prediction
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    SolverName,
)

HORIZON = 6
SOLVERS: list[SolverName] = ["daqp", "clarabel"]

# N. Thrust that UAV2 announces and that no controller of UAV1 can do anything about.
THRUST_LIMIT = 20.0

# Hard constraints of the user that no plan meets.
NOT_MET = {
    "payload 15 m below": (ConstraintSection(expression="r0[2] >= 5", soft=False),),
    "two thrusts at once": (
        ConstraintSection(expression="thrust1 == 10"),
        ConstraintSection(expression="thrust1 == 12"),
    ),
    "beyond the bounds": (ConstraintSection(expression="thrust1 >= 50"),),
    "faster than the rates": (ConstraintSection(expression="thrust1 == 40"),),
}


def contradicted(one: Controller, at: Situation) -> StepResult:
    """Return the step of a program in which the first correction is at once above and below 0."""
    linear = one.linearise(at.x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, None)
    qp = one.condense(linear, prediction, at.y_ref)
    first = np.zeros((2, len(qp.g)))
    first[:, 0] = 1.0
    contradiction = replace(
        qp,
        A=np.vstack([qp.A, first]),
        row_lower=np.append(qp.row_lower, [1.0, -np.inf]),
        row_upper=np.append(qp.row_upper, [np.inf, -1.0]),
    )
    return one.conclude(one.solve(contradiction), prediction, at.U, None)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("owned", [(0,), (0, 2), (0, 1, 2, 3)])
def test_no_solution_keeps_the_shifted_plan(owned: tuple[int, ...], solver: SolverName) -> None:
    """Contradictory rows (26)-(27) return the announced plan untouched and status "infeasible"."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=HORIZON, solver=solver)
    at = situation(setup, settings, seed=1)
    one = controller(setup, settings, owned)
    optimum = contradicted(one, at)
    assert optimum.solution.status == "infeasible"
    assert optimum.solution.fallback
    assert optimum.solution.solver != solver, "the second opinion is the other solver's"
    assert np.array_equal(optimum.U, at.U[:, one.own])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("owned", [(0,), (0, 2), (0, 1, 2, 3)])
@pytest.mark.parametrize("name", NOT_MET)
def test_constraints_that_no_plan_meets_are_softened(
    name: str, owned: tuple[int, ...], solver: SolverName
) -> None:
    """Hard constraints of the user leave a plan, whichever solver, and the result names them (30e)."""
    setup = paper_setup()
    constraints = NOT_MET[name]
    settings = ControllerSettings(horizon=HORIZON, constraint=constraints, solver=solver)
    at = situation(setup, settings, seed=1)
    optimum = step(controller(setup, settings, owned), at)
    assert optimum.solution.status == "solved"
    assert set(optimum.solution.violations) == {each.expression for each in constraints}
    assert min(optimum.solution.violations.values()) > 1e-3


@pytest.mark.parametrize("is_contradicted", [False, True])
def test_only_what_softening_helps_is_softened(*, is_contradicted: bool) -> None:
    """A program that has a solution keeps it, and one that has none either way is what it was: without violations."""
    setup = paper_setup()
    low = (ConstraintSection(expression="r0[2] <= 5", soft=False),)
    settings = ControllerSettings(horizon=HORIZON, constraint=low)
    at, one = situation(setup, settings, seed=1), controller(setup, settings, (0, 1, 2, 3))
    found = (contradicted if is_contradicted else step)(one, at).solution
    assert found.status == ("infeasible" if is_contradicted else "solved")
    assert not found.violations
    assert len(found.z) == one.settings.horizon * len(one.own), "a slack of a softened constraint"


def test_softened_constraint_never_fails() -> None:
    """The same demand on the payload, softened, costs a penalty and has a solution.

    Docs/equations.md (29)-(30).
    """
    setup = paper_setup()
    settings = ControllerSettings(
        horizon=HORIZON, constraint=(ConstraintSection(expression="r0[2] >= 5"),)
    )
    optimum = step(controller(setup, settings, (0, 1, 2, 3)), situation(setup, settings, seed=1))
    assert optimum.solution.status == "solved"
    assert optimum.solution.z[-1] > 10.0, (
        "15 m are missing and the horizon is too short to win them"
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_recovers_when_the_next_program_has_a_solution(solver: SolverName) -> None:
    """A failure leaves no trace: the controller solves the next program as a fresh one does."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=HORIZON, solver=solver)
    good = situation(setup, settings, seed=2)
    one = controller(setup, settings, (0, 1, 2, 3))
    assert contradicted(one, good).solution.status == "infeasible"
    after, fresh = step(one, good), step(controller(setup, settings, (0, 1, 2, 3)), good)
    assert after.solution.status == "solved"
    assert np.array_equal(after.U, fresh.U)


def test_a_plan_out_of_range_is_not_called_solved() -> None:
    """A solution whose inputs are not numbers is discarded, and the result says so."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=HORIZON)
    at = situation(setup, settings, seed=1)
    one = controller(setup, settings, (0,))
    linear = one.linearise(at.x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, None)
    assert isinstance(prediction, Prediction)
    solution = one.solve(one.condense(linear, prediction, at.y_ref))
    assert solution.status == "solved"
    broken = replace(prediction, U_free=np.full_like(prediction.U_free, np.nan))
    result = one.conclude(solution, broken, at.U, None)
    assert result.solution.status != "solved"
    assert np.array_equal(result.U, at.U[:, one.own])


def test_corrections_out_of_range_are_not_announced() -> None:
    """Inputs within their bounds may belong to corrections that no message carries: those announced go on."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=HORIZON, prediction="closed_loop")
    at = situation(setup, settings, seed=1)
    one = controller(setup, settings, (0,))
    law = one.law(at.x, np.tile(setup.x, (HORIZON, 1)), np.full_like(at.U, 0.01))
    assert law is not None
    linear = one.linearise(at.x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, law)
    solution = one.solve(one.condense(linear, prediction, at.y_ref, law))
    assert solution.status == "solved"
    far = msgspec.structs.replace(law, K=1e9 * law.K)
    result = one.conclude(solution, prediction, at.U, far)
    assert result.solution.status != "solved"
    np.testing.assert_array_equal(result.c, law.c[:, one.own])
    np.testing.assert_array_equal(result.U, at.U[:, one.own])


@pytest.mark.parametrize("expression", [f"thrust2 <= {THRUST_LIMIT}", "thrust2 == thrust3"])
def test_others_inputs_do_not_stop_a_controller(expression: str) -> None:
    """In (26)-(27) a row without owned inputs is a constant.

    Broken by the others' plans, it must not fail this one.

    UAV1 cannot repair it, so refusing every program would freeze UAV1 for what UAV2 announces.
    """
    setup = paper_setup()
    settings = ControllerSettings(
        horizon=HORIZON, constraint=(ConstraintSection(expression=expression),)
    )
    at = situation(setup, settings, seed=1)
    U = np.tile(setup.hover.u, (HORIZON, 1))
    U[:, 4] = THRUST_LIMIT + 1.0
    optimum = step(
        controller(setup, settings, (0,)), Situation(x=at.x, u=at.u, U=U, y_ref=at.y_ref)
    )
    assert optimum.solution.status == "solved"


@pytest.mark.parametrize("expression", ["norm(v0) <= 1", "norm(omega0) <= 0.5"])
def test_speed_limit_holds_at_rest(expression: str) -> None:
    """A limit on a norm is solvable where the norm is zero, its corner.

    Every flight starts at rest.

    The derivative that (20) needs does not exist there; a nan in its place makes every program
    unsolvable.
    """
    setup = paper_setup()
    settings = ControllerSettings(
        horizon=HORIZON, constraint=(ConstraintSection(expression=expression),)
    )
    at = Situation(
        x=setup.x,
        u=setup.hover.u,
        U=np.tile(setup.hover.u, (HORIZON, 1)),
        y_ref=np.tile(setup.model.outputs(setup.x), (HORIZON + 1, 1)),
    )
    assert step(controller(setup, settings, (0, 1, 2, 3)), at).solution.status == "solved"
