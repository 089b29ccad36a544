"""Random deaths: the same for the same seed, each of an agent of the scenario within its maneuver."""

import pytest

from protocol.scenario.file import find_scenario, read_scenario
from transport.experiments.agent_failures import deaths
from transport.experiments.cases import cases_of
from transport.experiments.errors import ExperimentError

SCENARIOS = {"resilient": read_scenario(find_scenario("resilient"), [])}


def test_each_run_kills_one_agent_for_good() -> None:
    """Twenty valid scenarios with one kill each, at distinct times within 25 s, of agents 1 to 4; one without."""
    experiment = deaths(SCENARIOS, 20, 0)
    cases = cases_of(experiment.points, [], 1)
    assert len({case.key for case in cases}) == len(cases) == 21
    baseline, *others = [case.scenario for case in cases]
    assert baseline.faults.event == []
    events = [event for scenario in others for event in scenario.faults.event]
    assert len(events) == 20
    assert {event.do for event in events} == {"kill"}
    assert {event.target for event in events} <= {f"agent{i}" for i in range(1, 5)}
    assert len({event.at_s for event in events}) == 20
    assert all(0.0 <= event.at_s < 25.0 for event in events)
    assert {scenario.clock.on_agent_loss for scenario in others} == {"continue"}


def test_the_seed_decides() -> None:
    """One seed gives the same deaths every time, another one others; no death is refused."""
    assert deaths(SCENARIOS, 5, 1).points == deaths(SCENARIOS, 5, 1).points
    assert deaths(SCENARIOS, 5, 1).points != deaths(SCENARIOS, 5, 2).points
    with pytest.raises(ExperimentError, match="--count: expected a number of runs >= 1, got 0"):
        deaths(SCENARIOS, 0, 0)
