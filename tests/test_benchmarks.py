"""The benchmarks measure what they say: same plans, same answers, all rows. No time is judged."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from benchmarks import __main__ as command
from benchmarks import aims, loop, parts, solvers, step, structured, watched
from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.flights import Situation, programs, setup, situations
from benchmarks.page import BenchmarkError, Table, check, write
from benchmarks.solvers import SOLVERS, TIGHT, Solver
from mpc.qp import QP
from tests.runs import truth
from transport.log import Recorded, RunLog

DOCUMENT = (
    "a\n<!-- bench: aims -->\nold\n<!-- end of bench -->\nb\n<!-- bench: step -->\nold\n<!-- end of bench -->\nc\n"
)
FAILED, INTERRUPTED = 1, 130
ACTIVE_SETS = ("this project's", "quadprog")


def silent(_: str) -> None:
    """No progress."""


@lru_cache
def met() -> list[Situation]:
    """Situations of a flight, the first of them with limits that bind."""
    return situations(setup("paper", QUICK.climb), QUICK.programs)


@lru_cache
def asked() -> list[QP]:
    """Programs of two flights, few limits binding on one of them, many on the other."""
    return [qp for settings in ((), TIGHT) for qp in programs(setup("paper", QUICK.climb, *settings), QUICK.programs)]


def first_cells(table: Table) -> list[str]:
    """What the rows are about."""
    return [row[0] for row in table.rows]


def numbers(table: Table, column: str) -> list[float]:
    """A column of medians, whatever stands in brackets behind them."""
    at = list(table.columns).index(column)
    return [float(row[at].partition(" ")[0]) for row in table.rows]


def test_the_naive_step_makes_the_same_plans() -> None:
    """Stacked matrices multiplied out are the controller's program: to 1e-9, with Clarabel to what that leaves."""
    assert len(met()) == QUICK.programs
    assert max(aims.plan_difference(at) for at in met()) < aims.SAME_PLAN
    assert max(aims.plan_difference(at, "daqp") for at in met()) < aims.SAME_PROGRAM


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: solver.name)
def test_solvers_agree(solver: Solver) -> None:
    """Every solver that is installed answers all programs, as near to Clarabel as a solver of its kind comes."""
    if not solver.installed:
        pytest.skip(f"{solver.package} is not installed")
    outcome = solvers.compare([solver], asked(), 1)[solver.name]
    assert outcome.unsolved == 0
    assert outcome.from_clarabel < solver.agrees
    if solver.name in ACTIVE_SETS:
        assert outcome.from_daqp < solvers.SAME
    assert outcome.times.median > 0.0


@pytest.mark.parametrize("name", ["paper", "centralized"])
def test_both_ways_find_the_same_decision(name: str) -> None:
    """What is compared is the same problem: the condensed program and the recursion have one optimum."""
    at = situations(setup(name, QUICK.climb), 1)[0]
    for steps in (1, 2, 7):
        one, other = structured.condensed(at, steps), structured.riccati(at, steps)
        assert np.abs(one - other).max() < 1e-6 * max(1.0, np.abs(one).max())
        assert np.abs(one).max() > 0.0


def test_aims_have_their_rows() -> None:
    """Steps, naive step and ratios, each with what was wanted beside it."""
    (table,) = aims.measure(QUICK, silent)
    assert first_cells(table) == [
        "agent, `paper`", "agent, `resilient`", "agent, `centralized`", f"agent, `{aims.PLAIN}`",
        "`Controller.step`, `paper`", "naive step, same plans", "centralized over `paper`",
        "centralized over `resilient`", "naive over `Controller.step`", f"`{aims.PLAIN}` over `paper`",
    ]  # fmt: skip
    assert min(numbers(table, "median, ms")) > 0.0


def test_steps_have_their_rows() -> None:
    """Every team at every horizon, and the scenarios with four UAVs."""
    (table,) = step.measure(QUICK, silent)
    teams = [("`resilient`", str(uavs), str(horizon)) for uavs in QUICK.teams for horizon in QUICK.horizons]
    assert [tuple(row[:3]) for row in table.rows] == [*teams, ("`paper`", "4", "20"), ("`centralized`", "4", "20")]
    assert min(value for stage in (*step.SHOWN, "step") for value in numbers(table, stage)) > 0.0


def test_solvers_have_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that is not installed is named as missing; all others have numbers."""
    missing = Solver(name="nobody", package="no_such_solver", answer=lambda _: None, agrees=0.0)
    monkeypatch.setattr(solvers, "SOLVERS", (*SOLVERS[:2], missing))
    (table,) = solvers.measure(replace(QUICK, programs=2), silent)
    assert [row[1] for row in table.rows] == [*(solver.name for solver in SOLVERS[:2]), "nobody"]
    assert table.rows[-1][2] == "not installed"
    assert all(row[2] != "not installed" for row in table.rows[:-1])


def test_parts_have_their_rows() -> None:
    """The plant of every team, and a plan's way to bytes and back."""
    (table,) = parts.measure(QUICK, silent)
    plants = [f"plant, one period, {uavs} UAVs" for uavs in QUICK.teams]
    assert first_cells(table) == [*plants, "plan to bytes", "bytes to plan", "bytes to plan, all checks"]
    assert min(numbers(table, "median")) > 0.0


@pytest.mark.slow
def test_the_loop_has_its_rows() -> None:
    """Teams, the maneuver and recording, flown with processes; times are more than the floor beneath them."""
    teams, maneuver, recording = loop.measure(QUICK, silent)
    assert first_cells(teams) == [str(uavs) for uavs in QUICK.processes]
    assert first_cells(maneuver) == ["processes", "in memory"]
    assert first_cells(recording) == ["with a recorder", "without a recorder", "ratio"]
    assert all(all(cell != "-" for cell in row) for row in teams.rows)
    assert numbers(teams, "tick, ms")[0] > numbers(teams, "floor")[0] > 0.0


def test_only_what_was_measured_is_written(tmp_path: Path) -> None:
    """A section is replaced between its own markers, twice with the same result; the rest of the document stays."""
    document = tmp_path / "page.md"
    document.write_text(DOCUMENT)
    for _ in range(2):
        write(document, {"step": r"new \1 |"})
        before, _, after = DOCUMENT.rpartition("old")
        assert document.read_text() == rf"{before}new \1 |{after}"
    assert list(tmp_path.iterdir()) == [document]


def test_a_document_without_the_section_is_refused(tmp_path: Path) -> None:
    """Before anything is measured, naming document and section; the document of the project has them all."""
    document = tmp_path / "page.md"
    document.write_text(DOCUMENT)
    with pytest.raises(BenchmarkError, match=r"page\.md: expected <!-- bench: loop -->"):
        check(document, ["aims", "loop"])
    with pytest.raises(BenchmarkError, match=r"none\.md: cannot be read"):
        check(tmp_path / "none.md", ["aims"])
    check(command.DOCUMENT, list(command.SECTIONS))


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """It writes when all is measured, with the machine; interrupted or failed it leaves the document as it was."""
    document = tmp_path / "page.md"
    document.write_text(DOCUMENT)
    efforts = []

    def measured(effort: Effort, _: Callable[[str], None]) -> list[Table]:
        efforts.append(effort)
        return [Table(text="what", columns=("a", "b"), rows=[("1", "2")])]

    def failing(error: BaseException) -> Callable[[Effort, Callable[[str], None]], list[Table]]:
        def measure(_: Effort, __: Callable[[str], None]) -> list[Table]:
            raise error

        return measure

    for error, code, said in ((KeyboardInterrupt(), INTERRUPTED, "interrupted"), (BenchmarkError("no"), FAILED, "no")):
        monkeypatch.setattr(command, "SECTIONS", {"aims": measured, "step": failing(error)})
        assert command.main(["--document", str(document)]) == code
        assert f"benchmarks: {said}" in capsys.readouterr().err
        assert document.read_text() == DOCUMENT
    assert command.main(["--quick", "--only", "aims"]) == 0
    assert "| 1 | 2 |" in capsys.readouterr().out
    assert document.read_text() == DOCUMENT
    assert command.main(["--only", "aims", "--document", str(document)]) == 0
    assert "what\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\n*" in document.read_text()
    assert efforts == [FULL, FULL, QUICK, FULL]


def test_parts_of_a_flight_that_is_watched() -> None:
    """Factors are of the ticks within each part, but for its beginning; what the flight's end cuts is left out."""
    skipped_ms = [*range(0, 2000, 500)]
    parts_ms = [[*range(2000, 4000, 50)], [*range(2000, 4000, 100)], [*range(2000, 4000, 25)], [], [], [3999]]
    ticks_ms = [4000 * part + at_ms for part, inside in enumerate(parts_ms) for at_ms in skipped_ms + inside]
    run = setup("paper", QUICK.climb)
    entries = [Recorded(message=truth(run, tick), received_ns=at_ms * 1_000_000) for tick, at_ms in enumerate(ticks_ms)]
    log = RunLog(header={}, messages=tuple(entries), cut="")
    changes_ns = [at_s * 1_000_000_000 for at_s in range(0, 32, 4)]
    factors = watched.paces(log, changes_ns, period_s=0.05)
    np.testing.assert_allclose(factors, [1.0, 0.5, 2.0, 0.0, 0.0])  # it stands still in the fourth and fifth
    np.testing.assert_allclose(watched.losses(factors), [100.0 * (1.0 - 0.5 / 1.5), 100.0])
    np.testing.assert_allclose(watched.paces(log, changes_ns[:5], period_s=0.05), [1.0, 0.5, 2.0])
    for few in (changes_ns[:3], changes_ns[:1], []):
        assert watched.paces(log, few, period_s=0.05).size == 0
        assert watched.losses(watched.paces(log, few, period_s=0.05)).size == 0
    assert watched.paces(RunLog(header={}, messages=(), cut=""), changes_ns, period_s=0.05).size == 0


def test_the_row_of_who_looks_on() -> None:
    """Median and its interval where there are turns enough for one."""
    busy, opening_s = np.array([[0.02, 0.01]]), np.array([0.5, 20.0])
    lost = np.arange(-10.0, 15.0)
    row = watched._row("all", np.full(25, 4.0), lost, busy, opening_s)
    assert row == ("all", "4.00 (4.00 to 4.00)", "25", "2.0 (-3.0 to 7.0)", "0.020 + 0.010", "0.5 + 20.0")
    assert watched._row("all", np.full(3, 4.0), lost[:3], busy, opening_s)[3] == "-9.0 (too few for an interval)"
    assert watched._row("all", np.zeros(0), np.zeros(0), busy, opening_s) == ("all", "-", "0", "-", "-", "-")


def test_who_looks_on_has_to_stay() -> None:
    """What has ended by itself is named, and its end is not in the way of that."""
    with (
        pytest.raises(BenchmarkError, match=r"'false'.*expected to stay, ended with 1"),
        watched._started(["false"]) as process,
    ):
        watched._wait(lambda: False, Event(), process)
    over = Event()
    over.set()
    with watched._started(["sleep", "60"]) as process:
        assert not watched._wait(lambda: False, over, process)
        watched._require(process)
    with pytest.raises(BenchmarkError, match=r"'sleep', '60'.*ended with -15"):
        watched._require(process)


@pytest.mark.slow
def test_being_watched_has_its_rows() -> None:
    """Nobody, and each kind of those who look on; a flight that short has no turn, but at real speed a pace."""
    by_turns, paced = watched.measure(QUICK, silent)
    assert first_cells(by_turns) == [watched.NOBODY, *watched.WATCHERS]
    assert first_cells(paced)[0] == watched.NOBODY
    assert 0.5 < float(paced.rows[0][1].split()[0]) < 1.5
