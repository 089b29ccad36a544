"""The benchmark of silent networks: its measure of errors, and rows of its table."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import silence, silence_cases
from benchmarks.silence import Flown
from benchmarks.silence_cases import Case
from docs.tables import table
from tests.support.messages import sample
from tests.support.runs import plant_state
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.wire.messages import Note

PERIOD_S = 0.05
CASE = Case(name="a case", scenario="precise", silent_s=3.0)


def _flown(error_m: Array) -> Flown:
    ticks = len(error_m)
    return Flown(
        outcome="completed",
        reason="",
        error_m=error_m,
        attitude_deg=np.arange(ticks, dtype=np.float64),
        separation_m=np.full(ticks, 0.5),
        resets=0,
        period_s=PERIOD_S,
    )


def test_errors_of_all_seeds_count_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """A silence that doubles the error of one seed, and leaves that of another, does not double it."""
    ticks = 500

    def fly(_: str, settings: tuple[str, ...]) -> Flown:
        is_first = "seed=0" in settings
        is_silent = any("partition" in setting for setting in settings)
        level_m = 0.01 if is_first else 0.1
        return _flown(np.full(ticks, level_m * (2.0 if is_first and is_silent else 1.0)))

    monkeypatch.setattr(silence, "fly", fly)
    result = silence.run(CASE, range(2))
    flown_m, alone_m, undisturbed_m = result.during.rms()
    assert flown_m == pytest.approx(math.sqrt((0.02**2 + 0.1**2) / 2.0))
    assert alone_m == undisturbed_m == pytest.approx(math.sqrt((0.01**2 + 0.1**2) / 2.0))
    assert result.runs == result.completed == 2


def test_cells_of_two_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worst attitude and distance, sum of resets, and errors of both intervals beside those of the other runs.

    Errors before the silence, and in the 3 s after it, count in neither interval.
    """
    #          in silence, 3 s after it, then; m
    levels_m = {"silent": (0.04, 8.0, 0.03), "alone": (0.02, 8.0, 7.0), "open": (0.01, 8.0, 0.02)}
    ticks = 500

    def fly(_: str, settings: tuple[str, ...]) -> Flown:
        seed = 0 if "seed=0" in settings else 1
        is_silent = any("partition" in setting for setting in settings)
        kind = "silent" if is_silent else "alone" if silence.ALONE[0] in settings else "open"
        first = round(silence_cases.begins(CASE, seed) / PERIOD_S)
        error_m = np.full(ticks, 9.0)
        for number, level_m in enumerate(levels_m[kind]):
            error_m[first + 60 * number :] = level_m  # 60 ticks are 3 s
        completed = not (is_silent and seed == 1)
        return Flown(
            outcome="completed" if completed else "diverged",
            reason="",
            error_m=error_m,
            attitude_deg=np.array([1.0, 4.0 + 3.0 * seed, 2.0] if is_silent else [50.0]),
            separation_m=np.array([0.6, 0.49 - 0.04 * seed, 0.5] if is_silent else [0.1]),
            resets=1 + seed if is_silent else 100,
            period_s=PERIOD_S,
        )

    monkeypatch.setattr(silence, "fly", fly)
    assert silence._cells(silence.run(CASE, range(2))) == [
        "1 of 2, 3 resets of filters", "7.0 deg", "0.450 m", "0.040 m",
        "0.020 m (x2.00)", "0.010 m (x4.00)", "0.030 m", "0.020 m (x1.50)",
    ]  # fmt: skip


def test_errors_of_an_interval() -> None:
    """From its first tick to that before its end, or to the end of the run."""
    flown = _flown(np.arange(8.0))
    assert flown.squares(0.1, 0.3).tolist() == [4.0, 9.0, 16.0, 25.0]
    assert flown.squares(0.3, math.inf).tolist() == [36.0, 49.0]


@pytest.mark.parametrize(
    ("given", "runs", "beside"),
    [
        ({}, 3, 5),
        ({"silent_s": math.inf}, 3, 3),  # nothing comes after it
        ({"from_start": True}, 3, 3),
        ({"silent_s": math.inf, "from_start": True, "compared": False}, 1, 1),
        ({"compared": False}, 1, 2),
    ],
)
def test_what_a_case_is_compared_with(
    given: dict[str, Any], runs: int, beside: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The UAVs alone, and the network without silence that is as late; after a silence that ends as well."""
    asked: list[tuple[str, ...]] = []

    def fly(scenario: str, settings: tuple[str, ...]) -> Flown:
        assert scenario == "precise"
        asked.append(settings)
        return _flown(np.ones(500))

    monkeypatch.setattr(silence, "fly", fly)
    case = replace(CASE, settings=("name=x",), **given)
    _, _, _, *errors = silence._cells(silence.run(case, [3]))
    assert sum(error != "-" for error in errors) == beside
    same = ("name=x", "seed=3")
    late = (*same, *silence_cases.LATE)
    assert asked[1:] == [(*same, *silence.ALONE), late][: runs - 1]
    assert asked[0][: len(late)] == late


def test_a_run_as_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ticks in order, the largest angle of any sign in degrees, and the nearest two UAVs; other notes are no resets.

    In tick 1 the payload is 3 cm and 4 cm aside and turned, and the rod of UAV 1 leans so far that it is 0.2 m
    nearer to UAV 4.
    """
    lean, length_m = 0.2 / 3.2, 3.2

    def simulate(setup: Any, record: Callable[[Any], None]) -> Any:
        for problem in ("filter: reset", "planner: late", "filter: again"):
            record(sample(Note, problem=problem))
        moved = plant_state(setup, 1)
        view = state.StateView(moved.x)
        view.r0_I += (0.03, 0.04, 0.0)
        view.Theta0[:] = (0.1, -0.3, 0.2)
        view.e_P[0] = (lean, 0.0, math.sqrt(1.0 - lean**2))
        record(moved)
        record(plant_state(setup, 0))
        return SimpleNamespace(outcome="aborted", reason="no")

    monkeypatch.setattr(silence, "simulate", simulate)
    flown = silence.fly("paper", ("name=recorded",))
    assert (flown.resets, flown.outcome, flown.reason) == (2, "aborted", "no")
    np.testing.assert_allclose(flown.error_m, [0.0, 0.05], atol=1e-9)
    np.testing.assert_allclose(flown.attitude_deg, [0.0, 54.0 / math.pi], atol=1e-9)
    lower_m = length_m * (1.0 - math.sqrt(1.0 - lean**2))
    np.testing.assert_allclose(flown.separation_m, [0.5, math.hypot(0.3, lower_m)], atol=1e-9)


@pytest.mark.parametrize(
    ("words", "flown", "written"),
    [
        ([], [("a still", range(10)), ("b", range(10))], 0),
        (["--case", "still", "--write"], [("a still", range(10))], 1),
        (["--seeds", "2", "--first", "5", "--case", "b"], [("b", range(5, 7))], 0),
    ],
)
def test_cases_and_seeds_are_those_that_are_asked_for(
    words: list[str], flown: list[Any], written: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page is renewed only if that is asked for."""
    done: list[Any] = []
    pages: list[Any] = []

    def run(case: Case, seeds: Sequence[int], *, each: bool) -> silence.Result:
        done.append((case.name, seeds))
        return silence.Result()

    chosen = [Case(name=name, scenario="precise") for name in ("a still", "b")]
    monkeypatch.setattr(silence, "cases", lambda: chosen)
    monkeypatch.setattr(silence, "run", run)
    monkeypatch.setattr(silence, "write", lambda results, only: pages.append((len(results), only)))
    silence.main(words)
    assert done == flown
    assert pages == [(1, "still")] * written


def test_a_hover_as_flown() -> None:
    """Half a second at rest: ten ticks without error, level, with the UAVs as far apart as their rods, 0.5 m."""
    phases = "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
    flown = silence.fly("paper", (phases,))
    assert (flown.outcome, flown.reason, flown.resets, flown.period_s) == ("completed", "", 0, 0.05)
    assert [len(one) for one in (flown.error_m, flown.attitude_deg, flown.separation_m)] == [10] * 3
    np.testing.assert_allclose(flown.error_m, 0.0, atol=1e-6)
    np.testing.assert_allclose(flown.attitude_deg, 0.0, atol=1e-4)
    np.testing.assert_allclose(flown.separation_m, 0.5, atol=1e-6)


def test_each_row_keeps_its_origin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two selections renewed after each other have their own origins; one renewed again has its new one."""
    names = ["a still", "a windy", "b still", "c"]
    chosen = {name: Case(name=name, scenario="precise") for name in names}
    monkeypatch.setattr(silence, "cases", lambda: iter(chosen.values()))
    monkeypatch.setattr(silence, "ROOT", tmp_path)
    (tmp_path / "docs" / "record").mkdir(parents=True)
    page = tmp_path / "docs" / "record" / "guarantees.md"
    rows = [[name, *(["-"] * (len(silence.HEADINGS) - 1))] for name in names]
    old = f"{table(silence.HEADINGS, rows)}\n\n*Old; rows with 'b': CPU; day 0.*"
    page.write_text(f"<!-- bench: silence -->\n{old}\n<!-- end of bench: silence -->\n")

    def renewed(day: str, only: str, *done: str) -> str:
        monkeypatch.setattr(silence, "origin", lambda: f"CPU; {day}")
        silence.write([(chosen[name], silence.Result()) for name in done], only=only)
        return page.read_text().splitlines()[-2]

    kept = "*Old; rows with 'b': CPU; day 0; rows "
    assert renewed("day 1", "a", "a still") == f"{kept}with 'a' up to 'a still': CPU; day 1.*"
    assert renewed("day 1", "a", "a still", "a windy") == f"{kept}with 'a': CPU; day 1.*"
    both = f"{kept}with 'a': CPU; day 1; rows with 'windy': CPU; day 2.*"
    assert renewed("day 2", "windy", "a windy") == both
    again = "*Old; rows with 'b': CPU; day 0; rows with 'a': CPU; day 3.*"
    assert renewed("day 3", "a", "a still", "a windy") == again
    started = again.removesuffix(".*") + "; rows up to 'a still': CPU; day 4.*"
    assert renewed("day 4", "", "a still") == started
    assert renewed("day 4", "", *names) == "*CPU; day 4.*"


@pytest.mark.parametrize("is_selected", [True, False])
def test_each_row_is_renewed_as_its_case_is_done(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, is_selected: bool
) -> None:
    """Of two rows the one that is done changes, the other stays, and the page says whence each is."""
    renewed, stays = list(silence_cases.cases())[-2:]
    monkeypatch.setattr(silence, "cases", lambda: iter((renewed, stays)))
    (tmp_path / "docs" / "record").mkdir(parents=True)
    page = tmp_path / "docs" / "record" / "guarantees.md"
    rows = [[case.name, *(["-"] * (len(silence.HEADINGS) - 1))] for case in (renewed, stays)]
    before = table(silence.HEADINGS, rows)
    page.write_text(
        f"<!-- bench: silence -->\n{before}\n\n*Earlier.*\n<!-- end of bench: silence -->\n"
    )
    monkeypatch.setattr(silence, "ROOT", tmp_path)
    monkeypatch.setattr(silence, "origin", lambda: "Today")

    new = f"rows with {renewed.name!r}" if is_selected else f"rows up to {renewed.name!r}"
    result = silence.Result(runs=1, completed=1, attitude_deg=2.0, separation_m=0.5)
    for _ in range(2):
        silence.write([(renewed, result)], only=renewed.name if is_selected else "")
        lines = page.read_text().splitlines()
        assert lines[1:3] == before.splitlines()[:2]
        assert lines[3].startswith(f"| {renewed.name} | 1 of 1 | 2.0 deg | 0.500 m |")
        assert lines[4:7] == [before.splitlines()[3], "", f"*Earlier; {new}: Today.*"]

    silence.write([(renewed, result), (stays, result)], only="")
    lines = page.read_text().splitlines()
    assert lines[4].startswith(f"| {stays.name} | 1 of 1 |")
    assert lines[6] == "*Today.*"


@pytest.mark.parametrize("seed", [0, 7])
def test_a_silence_begins_between_4_and_10_s(seed: int) -> None:
    """All agents but one are cut off alone from an instant of the seed on, for the time of the case."""
    begin_s = silence_cases.begins(CASE, seed)
    assert 4.0 <= begin_s <= 10.0
    (*_, partition) = silence_cases.network(CASE, seed, 3)
    times = f"start_s={begin_s!r}, end_s={begin_s + 3.0!r}"
    cuts = f"{{between=['agent1'], {times}}}, {{between=['agent2'], {times}}}"
    assert partition == f"links.partition=[{cuts}]"


def test_a_maneuver_lasts_until_the_comparison_ends() -> None:
    """A silence of 30 s from 10 s on, 3 s after it, and 5 s to compare: 48 s in all; a short one changes nothing."""
    long = Case(name="", scenario="precise", silent_s=30.0)
    (setting,) = silence_cases.longer_hover(long)
    scenario = read_scenario(find_scenario("precise"), [setting])
    assert sum(phase.duration_s or 0.0 for phase in scenario.maneuver.phase) == pytest.approx(48.0)
    assert silence_cases.longer_hover(Case(name="", scenario="precise", silent_s=1.0)) == ()
