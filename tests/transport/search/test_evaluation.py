"""Evaluation of candidates: the run with perfect information, and how far a run has come."""

import pytest

from tests.support.runs import SCENARIOS, SHORT
from transport.protocol.scenario.scenario_file import read_scenario
from transport.search.candidate import Base, Candidate
from transport.search.evaluation import REFUSED, Evaluation, SearchProblem
from transport.search.kinds_of_events import Gusts
from transport.search.objective import SearchObjective

FILE = SCENARIOS / "resilient.toml"
BAD_NETWORK = ("links.loss=0.1", "links.measurement.delay_s=0.1", "radio.offsets='none'")
BAD_SENSORS = (
    "plant.sensors='vehicle'",
    "plant.noise.position_m=0.1",
    "controller.estimator='kalman'",
)
FAULTS = (
    "faults.event=[{at_s=0.2,do='kill',target='agent1'},"
    "{at_s=0.3,do='sensors_off',target='uav2',sensors=['position']},"
    "{at_s=0.4,do='degrade',target='uav3',efficiency=0.9},"
    "{at_s=0.5,do='motor_off',target='uav4'}]"
)
FAULTS_OF_PLANT = (
    "faults.event=[{at_s=0.4,do='degrade',target='uav3',efficiency=0.9},"
    "{at_s=0.5,do='motor_off',target='uav4'}]"
)


def problem(*settings: str) -> SearchProblem:
    """Return the problem of a short run and the distance of the UAVs."""
    scenario = read_scenario(FILE, [SHORT, *settings])
    objective = SearchObjective.of("separation", 0.3, scenario)
    return SearchProblem(base=Base(scenario=scenario, source=str(FILE)), objective=objective)


def test_perfect_information_leaves_only_the_faults_of_the_plant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One agent for all UAVs measures the state at once: no network, no noise, no fault of a process or sensor."""
    simulated = []

    def keep(of: SearchProblem, candidate: Candidate) -> Evaluation:
        simulated.append(of.base.scenario)
        return Evaluation(key="", robustness=1.0, value=0.0, outcome="completed", end_s=1.5)

    bad = problem(*BAD_NETWORK, *BAD_SENSORS, FAULTS)
    monkeypatch.setattr(SearchProblem, "evaluate", keep)
    bad.with_perfect_information(Candidate(()))

    expected = problem(FAULTS_OF_PLANT, "agents.owned=[[1,2,3,4]]").base.scenario
    assert [scenario.tree() for scenario in simulated] == [expected.tree()]


def test_a_run_has_survived_until_its_first_collision() -> None:
    """The motors of UAV1 are off, so that two others touch between the ticks at 0.95 s and 1 s of 1.5 s."""
    radii = [f"system.uav.{uav}.radius_m=0.24" for uav in (1, 2, 3, 4)]
    motor_off = "faults.event=[{at_s=0.3,do='motor_off',target='uav1'}]"
    evaluation = problem(motor_off, *radii).evaluate(Candidate(()))
    assert evaluation.outcome == "collided"
    assert evaluation.end_s > 0.95  # flown on
    assert 0.95 / 1.5 < evaluation.robustness + 1.0 < 1.0 / 1.5


@pytest.mark.parametrize(
    ("robustness", "outcome", "failed"),
    [(-0.1, "completed", True), (0.0, "completed", False), (-0.1, REFUSED, False)],
)
def test_a_case_at_its_limit_holds(robustness: float, outcome: str, *, failed: bool) -> None:
    """One that the scenario refuses has not been flown, and has not failed."""
    one = Evaluation(key="", robustness=robustness, value=0.0, outcome=outcome, end_s=1.5)
    assert one.failed is failed


def test_an_evaluation_is_that_of_events_objective_and_scenario() -> None:
    """Each of them makes another key; the same ones have the same."""
    base = problem().base
    problems = [
        problem(),
        problem("links.loss=0.1"),
        SearchProblem(base=base, objective=SearchObjective.of("separation", 0.2, base.scenario)),
        SearchProblem(base=base, objective=SearchObjective.of("payload", 0.3, base.scenario)),
    ]
    candidates = [Candidate(()), Candidate((Gusts(speed_mps=0.5, seed=1),))]
    keys = [one.key(candidate) for one in problems for candidate in candidates]
    assert len(set(keys)) == len(keys)
    assert problem().key(candidates[1]) == keys[1]


def test_no_verdict_without_a_centralized_form() -> None:
    """Clocks that are apart are listed by agent: one agent has no such list, and the reason says so."""
    apart = problem("clock.offsets_s=[0.0,0.01,0.02,0.03]")
    assert apart.with_perfect_information(Candidate(())).outcome == REFUSED
    verdict = apart.verdict(Candidate(()))
    assert verdict.beyond_physics is None
    assert "clock.offsets_s: expected one for each of 1 agents, got 4" in verdict.reason
