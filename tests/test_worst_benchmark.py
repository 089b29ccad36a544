"""Searches for the worst case: what is planted and searched, and the tables of hand-made results."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import worst
from benchmarks.worst import Found
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.search.space import Bounds, Space

INFINITE = float("inf")


def test_planted_faults_are_searched_until_the_first_failure() -> None:
    """Each switches one mended weakness on in a flight of 7 s, with a failure that the attitude tells."""
    searches = {name: case.search(8, 3) for name, case in worst.PLANTED.items()}
    for one in searches.values():
        assert (one.budget, one.seed, one.until_failure) == (8, 3, True)
        phases = one.problem.base.scenario.maneuver.phase
        assert sum(phase.duration_s or 0.0 for phase in phases) == 7.0
        objective = one.problem.objective
        assert (objective.measure, objective.limit) == ("attitude", 10.0)
    law, fail_safe, paper = (one.problem.base.scenario for one in searches.values())
    assert law.controller.silence == "law"
    assert fail_safe.controller.fail_safe == "level"
    assert (law.name, fail_safe.name, paper.name) == ("resilient", "resilient", "paper")


def test_ready_scenarios_have_events_to_draw() -> None:
    """Each case is a scenario whose space has the events that it names."""
    for case in worst.READY.values():
        scenario = read_scenario(find_scenario(case.scenario), case.settings)
        assert Space(case.over, Bounds(), scenario).dimension >= len(case.over)


@pytest.mark.parametrize(
    ("first_failure", "drawn", "expected"),
    [
        (5, [False, False, True, True], Found(by_search=5, by_chance=3, events=2)),
        (None, [False, False], Found(by_search=INFINITE, by_chance=INFINITE, events=0)),
    ],
)
def test_runs_until_a_fault_is_found(
    monkeypatch: pytest.MonkeyPatch, first_failure: int | None, drawn: list[bool], expected: Found
) -> None:
    """By the search that ends with it, and by the first random draw that fails, counted from 1."""
    minimal = SimpleNamespace(candidate=SimpleNamespace(events=("a death", "a silence")))
    result = SimpleNamespace(first_failure=first_failure, minimal=first_failure and minimal)
    chosen: Any = SimpleNamespace(problem=None, run=lambda *_: result)
    cases = [
        SimpleNamespace(number=number, evaluation=SimpleNamespace(failed=failed))
        for number, failed in enumerate(drawn, start=1)
    ]
    monkeypatch.setattr(worst, "flying", lambda _: None)
    monkeypatch.setattr(worst, "SearchProgress", lambda *_: nullcontext())
    monkeypatch.setattr(worst, "random_search", lambda *_: iter(cases))
    case: Any = SimpleNamespace(search=lambda *_: chosen)
    workers: Any = SimpleNamespace(jobs=1)
    assert worst.find(case, 8, 0, workers) == expected


def test_medians_over_the_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ratio is that of search over chance, infinite medians have none; most events of a minimal case."""
    found: dict[str, list[Any]] = {
        "easy": [(4, 10, 1), (6, 20, 3), (20, 40, 2)],
        "rare": [(30, INFINITE, 1), (40, INFINITE, 1), (50, 8, 1)],
        "unlucky": [(INFINITE, 10, 0)] * 3,
        "never": [(INFINITE, INFINITE, 0)] * 3,
    }
    monkeypatch.setattr(worst, "PLANTED", {name: name for name in found})

    def find(case: Any, _budget: int, seed: int, _workers: object) -> Found:
        by_search, by_chance, events = found[case][seed]
        return Found(by_search=by_search, by_chance=by_chance, events=events)

    monkeypatch.setattr(worst, "find", find)
    workers: Any = None
    assert worst.planted([], 3, 8, workers).splitlines()[2:] == [
        "| easy | 6 | 20 | 0.30 | 3 |",
        "| rare | 40 | inf | 0.00 | 1 |",
        "| unlucky | inf | 10 | inf | 0 |",
        "| never | inf | inf | - | 0 |",
    ]
    assert len(worst.planted(["rare"], 3, 8, workers).splitlines()) == 3


def test_deaths_with_silences_by_both_fail_safes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The column is that of its fail-safe; a run that is ended at the limit diverges."""

    def problem(base: Any, objective: Any) -> Any:
        assert objective.limit == 80.0
        follows = base.scenario.controller.fail_safe == "follow"
        outcome, value = ("completed", 4.25) if follows else ("failed", 80.5)
        found = SimpleNamespace(outcome=outcome, value=value, end_s=6.5)
        return SimpleNamespace(evaluate=lambda _: found)

    monkeypatch.setattr(worst, "SearchProblem", problem)
    heading, _, *rows = worst.together().splitlines()
    assert heading == "| events | `follow` | `level` |"
    assert len(rows) == len(worst.TOGETHER)
    for row in rows:
        assert row.endswith(" | 4.2 deg | **diverges** at 6.5 s |")


def test_a_ready_scenario_is_searched_with_its_own_events(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """All its runs, within the limit; the row has its failures and worst case, in words."""
    asked: list[Any] = []

    def search(scenario: Any, source: str, options: Any, folder: Path, _: object) -> Any:
        asked.append((scenario.name, Path(source).stem, options.over, options.budget))
        asked.append((options.limit, options.jobs, folder))
        candidate = SimpleNamespace(in_words=lambda: "gusts")
        case = SimpleNamespace(candidate=candidate, evaluation=SimpleNamespace(value=12.34))
        return SimpleNamespace(cases=[case] * 30, failures=2, worst=case, minimal=minimal)

    monkeypatch.setattr(worst, "search", search)
    minimal: Any = None
    (row,) = worst.ready(["paper"], 30, 2, tmp_path).splitlines()[2:]
    assert row == "| paper | gusts, mass | 30 | 2 | 12.3 deg | gusts |"
    assert asked == [("paper", "paper", ("gusts", "mass"), 30), (20.0, 2, tmp_path / "paper")]

    # A minimal case takes the place of the worst one; a folder has no comma in its name.
    minimal = "a case"
    monkeypatch.setattr(worst, "in_words", lambda found: ["in", found])
    (row,) = worst.ready(["precise, sensors of the vehicles"], 30, 2, tmp_path).splitlines()[2:]
    assert row.endswith(" | in a case |")
    assert asked[-1][2] == tmp_path / "precise"


def test_defaults_of_the_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 runs, and ten seeds of planted faults, as docs/record/measured.md tells."""
    asked: list[Any] = []

    def note(*given: Any) -> str:
        asked.append(given)
        return ""

    monkeypatch.setattr(worst, "ready", note)
    monkeypatch.setattr(worst, "planted", note)
    monkeypatch.setattr(worst, "Workers", lambda jobs: nullcontext(jobs))
    worst.main([])
    worst.main(["--planted"])
    assert asked == [([], 300, None, Path("runs/worst")), ([], 10, 300, None)]


@pytest.mark.parametrize(
    ("arguments", "page", "marker"),
    [
        (["--planted", "--write"], "measured.md", "planted"),
        (["--together", "--write"], "guarantees.md", "together"),
        (["--write"], "guarantees.md", "ready"),
        (["paper"], "", ""),
    ],
)
def test_each_table_has_its_place(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], page: str, marker: str
) -> None:
    """With `--write` the table that was made takes its place, without it none does."""
    put = []
    for name in ("planted", "together", "ready"):
        monkeypatch.setattr(worst, name, lambda *_, name=name: f"table of {name}")
    monkeypatch.setattr(worst, "put", lambda document, *rest: put.append((document.name, *rest)))
    monkeypatch.setattr(worst, "origin", lambda: "today")
    worst.main([*arguments, "--jobs", "1"])
    assert put == ([(page, marker, f"table of {marker}\n\n*today*")] if page else [])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "names: expected one of resilient, "),
        (["paper", "--planted"], "names: expected one of a law without a fall-back in silence, "),
        (["paper", "--together"], "names: expected no names, got 'paper'"),
        (["paper", "--write"], "--write: expected no names"),
    ],
)
def test_wrong_names_are_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is simulated."""
    with pytest.raises(SystemExit):
        worst.main(arguments)
    assert message in capsys.readouterr().err
