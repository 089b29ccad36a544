"""Hard constraints of the user that no plan meets (docs/equations.md (30e))."""

from collections.abc import Mapping
from typing import Any

import pytest

from tests.support import runs
from tests.support.logs import log_of
from tests.support.runs import completed
from tests.support.systems import controller, paper_setup, situation, step
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.model.arrays import Array
from transport.mpc.settings_period_horizon_weights import ConstraintSection, ControllerSettings

OWNED, SEED = (0,), 5
# Newtons beyond the solver's tolerance.
HELD = 1e-4


def _plan(*constraints: ConstraintSection) -> tuple[Mapping[str, float], Array]:
    """Return violations and planned thrusts of one step of UAV 1."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=5, relaxation=1.0, constraint=constraints)
    result = step(controller(setup, settings, OWNED), situation(setup, settings, SEED))
    assert result.solution.status == "solved"
    return result.solution.violations, result.U[:, 0]


def _softened(expression: str, *, ticks: int) -> Any:
    """Return the summary of a run whose steps meet no constraint and do not fail."""
    own = f"controller.constraint=[{{expression='{expression}'}}]"
    run = runs.ready("resilient", runs.ticks(ticks), own)
    summary = summarise(AnalysedRun.of(run, log_of(completed(run))))
    assert summary["solver"]["failures"] == 0
    assert summary["own_constraints"][0]["softened_steps"] > 0
    return summary


def test_a_constraint_that_a_plan_meets_stays_hard() -> None:
    """A bound just below the present thrust holds, and there is nothing to report."""
    _, free_N = _plan()
    bound_N = float(free_N.max()) - 0.5
    violations, thrust_N = _plan(ConstraintSection(expression=f"thrust1 <= {bound_N!r}"))
    assert violations == {}
    assert thrust_N.max() <= bound_N + HELD


@pytest.mark.parametrize("relation", ["<=", "=="])
def test_a_constraint_that_no_plan_meets_is_violated_least(relation: str) -> None:
    """The rate of the thrust allows no such bound at the first step: the plan goes there at that rate."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=5)
    before_N = situation(setup, settings, SEED).u[0]
    text = f"thrust1 {relation} 1.0"
    violations, thrust_N = _plan(ConstraintSection(expression=text))
    first_N = before_N - settings.largest_step(1)[0]
    assert thrust_N[0] == pytest.approx(first_N, abs=HELD)
    assert violations == {text: pytest.approx(first_N - 1.0, abs=HELD)}


def test_an_equality_that_several_agents_cannot_meet_costs_no_step() -> None:
    """A speed of climb that a hover lacks: each step has a plan, and the team stays level."""
    summary = _softened("v0[2] == -0.1", ticks=30)
    assert summary["attitude_max_deg"] < 1.0


def test_constraints_that_contradict_each_other_share_the_violation() -> None:
    """Of two bounds a newton apart the plan is between, and both are named."""
    _, free_N = _plan()
    low, high = (f"thrust1 <= {float(free_N[0]) - 0.5!r}", f"thrust1 >= {float(free_N[0]) + 0.5!r}")
    violations, _ = _plan(ConstraintSection(expression=low), ConstraintSection(expression=high))
    assert sum(violations.values()) == pytest.approx(1.0, abs=HELD)


def test_the_summary_counts_softened_steps() -> None:
    """A payload that has to tilt at once: no step fails, each is counted and named."""
    summary = _softened("Theta0[0] == 0.2", ticks=4)
    notices = [event["what"] for event in summary["faults"]]
    assert any("no plan meets Theta0[0] == 0.2" in text for text in notices)
