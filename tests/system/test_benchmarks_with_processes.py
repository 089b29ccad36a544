"""The benchmarks that start processes: the loop and being watched measure what they say. No time is judged."""

from threading import Event

import numpy as np
import pytest

from benchmarks import loop, watched
from benchmarks.effort import QUICK
from benchmarks.flights import setup
from benchmarks.page import BenchmarkError
from tests.support.runs import plant_state
from tests.support.tables import first_cells, numbers, silent
from transport.log.run_log import Recorded, RunLog


@pytest.mark.slow
def test_the_loop_has_its_rows() -> None:
    """Teams, the maneuver and recording, flown with processes; times are more than the floor beneath them."""
    teams, maneuver, recording = loop.measure(QUICK, silent)
    assert first_cells(teams) == [str(uavs) for uavs in QUICK.processes]
    assert first_cells(maneuver) == ["processes", "in memory"]
    assert first_cells(recording) == ["with a recorder", "without a recorder", "ratio"]
    assert all(all(cell != "-" for cell in row) for row in teams.rows)
    assert numbers(teams, "tick, ms")[0] > numbers(teams, "floor")[0] > 0.0


def test_parts_of_a_flight_that_is_watched() -> None:
    """Factors are of the ticks within each part, but for its beginning; what the flight's end cuts is left out."""
    skipped_ms = [*range(0, 2000, 500)]
    parts_ms = [[*range(2000, 4000, 50)], [*range(2000, 4000, 100)], [*range(2000, 4000, 25)], [], [], [3999]]
    ticks_ms = [4000 * part + at_ms for part, inside in enumerate(parts_ms) for at_ms in skipped_ms + inside]
    run = setup("paper", QUICK.climb)
    entries = [
        Recorded(message=plant_state(run, tick), received_ns=at_ms * 1_000_000) for tick, at_ms in enumerate(ticks_ms)
    ]
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
