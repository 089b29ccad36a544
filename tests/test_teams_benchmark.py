"""Drawn teams against silences: what each case asks of a team, and the row of hand-made results."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from transport.experiments.cases import Case
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
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


@pytest.mark.parametrize(
    ("given", "links", "gust_mps"),
    [
        ({"links": (0.1, 0.0), "gust_mps": 0.5}, (0.1, 0.0), 0.5),
        ({"links": (0.0, 0.0), "gust_mps": 0.0}, (0.0, 0.0), 0.0),
        ({"gust_mps": None}, (0.2, 0.3), 1.0),
    ],
)
def test_a_case_may_have_a_network_and_gusts(
    given: dict[str, Any], links: tuple[float, float], gust_mps: float
) -> None:
    """Zero is a value, too; there is no jitter, and no noise without the sensors of the vehicles."""
    scenario = flown_scenario(TeamCase(name="", **given), 2, is_ready=True)
    assert (scenario.links.delay_s, scenario.links.loss, scenario.links.jitter_s) == (*links, 0.0)
    assert tuple(scenario.plant.wind.gust_mps) == (gust_mps,) * 3
    assert scenario.plant.noise == type(scenario.plant.noise)()
    assert scenario.controller.estimator == "measured"


def test_any_agent_may_die_in_a_silence_for_good() -> None:
    """By the seed; the run ends 40 s after the begin of such a silence."""
    case = TeamCase(name="", silent_s=program.FOR_GOOD_S, death=True)
    targets = set()
    for seed in range(12):
        scenario = flown_scenario(case, seed, is_ready=True)
        targets.add(scenario.faults.event[0].target)
        start_s, _ = silence(scenario)
        flown_s = sum(phase.duration_s or 0.0 for phase in scenario.maneuver.phase)
        assert flown_s >= start_s + 40.0
        assert flown_s <= start_s + 41.0
    assert targets == {"agent1", "agent2", "agent3", "agent4"}


def test_refused_runs_are_results_of_their_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ready team has ten instants, drawn teams their number; other runs are cases of their row."""

    def refuse(_case: TeamCase, seed: int, *, is_ready: bool) -> Scenario:
        if seed == 1:
            raise ScenarioError("team 1", "seed", "expected another")
        return template()[0]

    monkeypatch.setattr(program, "flown_scenario", refuse)
    case = TeamCase(name="", teams=3, most_uavs=99)
    for is_ready, count in ((True, 10), (False, 3)):
        runs = dict(Row(case, is_ready=is_ready).runs(7))
        assert list(runs) == list(range(count))
        refused = runs.pop(1)
        assert (refused.outcome, refused.reason) == (ERROR, "team 1: seed: expected another")  # type: ignore[union-attr]
        assert {one.point for one in runs.values()} == {7}  # type: ignore[union-attr]


def test_results_are_those_of_their_rows_and_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kept ones as simulated ones; one that is neither is left out."""
    rows = [Row(TeamCase(name=name), is_ready=True) for name in ("a", "b")]
    scenario = template()[0]

    def runs(row: Row, number: int) -> Any:
        yield 0, result("refused")
        for seed in (1, 2):
            own = scenario.model_copy(update={"seed": seed})
            yield (
                seed,
                Case(point=number, scenario=own, source="", key=f"{row.case.name}{seed}"),
            )

    kept: dict[str, Result] = {key: result("completed", 3.0) for key in ("a1", "b2")}
    swept: list[Any] = []
    monkeypatch.setattr(Row, "runs", runs)
    monkeypatch.setattr(program, "Results", lambda *_: nullcontext(kept))
    monkeypatch.setattr(program, "sweep", lambda *given: swept.append(given))
    for no_fly in (True, False):
        found = flown(rows, tmp_path, no_fly=no_fly)
        assert [list(found[row]) for row in rows] == [[0, 1], [0, 2]]
        assert len(swept) == (not no_fly)
    assert [case.key for case in swept[0][1]] == ["a1", "a2", "b1", "b2"]


@pytest.mark.parametrize(
    ("words", "teams", "told"),
    [
        (["--case", "silent 4 s"], ["drawn", "precise"], ["completed, 16.00 deg"]),
        (["--case", "silent 4 s", "--ready"], ["precise"], ["completed, 16.00 deg"]),
        (
            ["--case", "silent 4 s", "--ready", "--runs"],
            ["precise"],
            ["completed, 2.00 deg", "diverged at 7.25 s, 90.00 deg far", "refused, no"],
        ),
    ],
)  # fmt: skip
def test_runs_that_are_not_held_are_told(
    words: list[str],
    teams: list[str],
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of the chosen cases, with seed, end and attitude; with `--runs` the others as well."""
    lost = result("diverged", 90.0)
    lost = replace(lost, reason="far", numbers={**lost.numbers, "lost_s": 7.25})
    results = [result("completed", 2.0), result("completed", 16.0), lost]
    results.append(Result(key="", outcome=ERROR, reason="no", numbers={}))
    flown_rows: list[str] = []

    def fly(rows: list[Row], *_: object, **__: object) -> Any:
        flown_rows.extend(row.point.scenario for row in rows)
        return {row: dict(enumerate(results)) for row in rows}

    monkeypatch.setattr(program, "flown", fly)
    program.main(words)
    lines = capsys.readouterr().out.splitlines()
    assert flown_rows == teams
    seen = [line.partition(": ")[2] for line in lines if line.startswith("silent 4 s, precise, ")]
    assert set(told) <= set(seen)
    assert len(seen) == (4 if "--runs" in words else 3)
    assert lines[-1].startswith("silent 4 s | ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--write", "--ready"], "expected neither --ready nor --case"),
        (["--write", "--case", "silent"], "expected neither --ready nor --case"),
        (["--write", "--margins", "--first", "3"], "expected no --first"),
    ],
)
def test_a_page_has_all_cases_and_teams(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A choice of them is refused before anything is simulated."""
    with pytest.raises(SystemExit):
        program.main(words)
    assert f"--write: {message}" in capsys.readouterr().err


def test_margins_take_the_place_of_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the teams that are asked for; their table has its own place."""
    asked: list[Any] = []
    put: list[str] = []

    def count(_template: object, *, first: int, each: bool) -> list[list[str]]:
        asked.append((first, each))
        return []

    monkeypatch.setattr("benchmarks.teams_alone.count", count)
    monkeypatch.setattr(program, "put", lambda _page, marker, _text: put.append(marker))
    program.main(["--margins", "--first", "3", "--runs"])
    program.main(["--margins", "--write"])
    assert asked == [(3, True), (0, False)]
    assert put == ["bench: teams alone"]


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
