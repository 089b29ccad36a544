"""Drawn teams against silences: what each case asks of a team, and the row of hand-made results."""

from pathlib import Path

import pytest

from benchmarks import teams as program
from benchmarks.teams import (
    AFTER_S,
    CASES,
    FROM_S,
    TEMPLATE,
    Row,
    TeamCase,
    cells,
    flown,
    flown_scenario,
    seeds,
    template,
)
from benchmarks.teams_alone import MarginsAlone
from benchmarks.teams_alone import cells as margin_cells
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.teams.drawn_team import drawn


def result(outcome: str, attitude_deg: float = 0.0) -> Result:
    """Return the result of a run with a largest attitude."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS)
    numbers |= {"attitude_max_deg": attitude_deg, "lost_s": None}
    return Result(key="", outcome=outcome, reason="", numbers=numbers)


def silence(scenario: Scenario) -> tuple[float, float]:
    """Return begin and end of the silence of a run, s: all agents but the last one are cut off alone."""
    cuts = scenario.links.partition
    assert [cut.between for cut in cuts] == [
        [f"agent{agent}"] for agent in range(1, len(scenario.owned))
    ]
    ((start_s, end_s),) = {(cut.start_s, cut.end_s) for cut in cuts}
    return start_s, end_s


@pytest.mark.parametrize("seed", [0, 5])
def test_a_silence_begins_at_an_instant_of_the_seed(seed: int) -> None:
    """Within the range, for the time of the case; the run lasts four seconds beyond it, and keeps its network."""
    case = TeamCase(name="silent 4 s", silent_s=4.0)
    scenario = flown_scenario(case, seed)
    start_s, end_s = silence(scenario)
    assert FROM_S[0] <= start_s <= FROM_S[1]
    assert end_s - start_s == pytest.approx(4.0)
    assert sum(phase.duration_s or 0.0 for phase in scenario.maneuver.phase) >= end_s + 4.0
    own = drawn(seed, *template())
    assert (scenario.links.delay_s, scenario.links.loss) == (own.links.delay_s, own.links.loss)
    assert tuple(scenario.plant.wind.gust_mps) == (1.0, 1.0, 1.0)


def test_a_death_is_in_the_silence() -> None:
    """A second after its begin, and the run goes on."""
    scenario = flown_scenario(TeamCase(name="", silent_s=4.0, death=True), 3)
    start_s, _ = silence(scenario)
    (fault,) = scenario.faults.event
    assert fault.do == "kill"
    assert fault.at_s == pytest.approx(start_s + AFTER_S)
    assert scenario.clock.on_agent_loss == "continue"


def test_the_ready_team_has_a_network_and_gusts_of_its_own() -> None:
    """Where the case leaves them to the team; its sensors are those of the case."""
    case = TeamCase(name="", sensors="vehicle", gust_mps=None)
    scenario = flown_scenario(case, 2, is_ready=True)
    assert scenario.name == TEMPLATE
    assert (scenario.links.delay_s, scenario.links.loss) == (0.2, 0.3)
    assert tuple(scenario.plant.wind.gust_mps) == (1.0, 1.0, 1.0)
    assert (scenario.plant.sensors, scenario.controller.estimator) == ("vehicle", "kalman")
    assert scenario.seed == 2


def test_teams_of_a_case_have_at_most_its_size() -> None:
    """The first so many seeds whose teams are small enough."""
    case = TeamCase(name="", teams=5, most_uavs=5)
    chosen = list(seeds(case))
    assert len(chosen) == case.teams
    sizes = [len(drawn(seed, *template()).system.uav) for seed in range(chosen[-1] + 1)]
    assert chosen == [seed for seed, size in enumerate(sizes) if size <= case.most_uavs]


def test_a_row_counts_completed_held_and_refused_teams() -> None:
    """Attitudes are of completed runs; above 15 deg a run is completed and not held."""
    teams = [
        result("completed", 2.0),
        result("completed", 15.0),
        result("completed", 16.0),
        result("diverged", 90.0),
        Result(key="", outcome=ERROR, reason="ScenarioError: no", numbers={}),
    ]
    name, completed, held, refused, _, largest, *ready = cells(CASES[0], teams, [])
    assert (name, refused, largest) == ("silent 4 s", "1", "16.0")
    assert completed.startswith("3 of 5 (")
    assert held == "2 of 5"
    assert ready == ["0 of 0", "", ""]


def test_the_readme_has_some_columns_and_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All rows are on the page; the README leaves out what is held and refused, and says so in its headings."""
    rows = [[case.name, *"ABCDEFGH"] for case in CASES]
    put: dict[str, str] = {}
    monkeypatch.setattr(program, "count", lambda _options: rows)
    monkeypatch.setattr(program, "put", lambda page, _, text: put.update({page.name: text}))
    program.main(["--write"])
    assert len(put["guarantees.md"].split("\n\n")[0].splitlines()) == 2 + len(CASES)
    headings, _, *short = put["README.md"].splitlines()
    assert "within 15 deg" not in headings
    assert "refused" not in headings
    assert [row.split(" | ")[0].strip("| ") for row in short] == list(program._SHORT_ROWS)
    assert all(row.endswith("| A | D | E | F | G | H |") for row in short)


def test_kept_runs_alone_are_counted(tmp_path: Path) -> None:
    """Without flights nothing is simulated: a new folder has no results."""
    row = Row(TeamCase(name="short", teams=1), is_ready=True)
    assert flown([row], tmp_path, no_fly=True) == {row: {}}


def test_margins_count_the_teams_that_meet_each_criterion() -> None:
    """Decay of at least 0.04/s, 20 ms of delay, 25 ms of lag, and all of them."""
    teams = [
        MarginsAlone(growth=-0.1, delay_ms=40.0, lag_ms=30.0),
        MarginsAlone(growth=-0.05, delay_ms=20.0, lag_ms=24.0),
        MarginsAlone(growth=-0.03, delay_ms=19.0, lag_ms=25.0),
        MarginsAlone(growth=0.2, delay_ms=0.0, lag_ms=0.0),
    ]
    expected = ["gains", "2 of 4", "2 of 4", "2 of 4", "1 of 4", "3"]
    assert margin_cells("gains", teams, 3) == expected
