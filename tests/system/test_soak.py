"""The soak test, shortened to two minutes, and its judgement."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.page import BenchmarkError
from tests.support import soak
from tests.support.soak import GROWTH_BYTES, Record, judge

# The clock waits for late processes: on a host busy with other tests the run would diverge. Bounds are wider than
# for thirty minutes, because the host's load may differ between the thirds; a leak of 3 kB a tick is still found.
MINUTES = 2
SOAK = ("--minutes", str(MINUTES), "--misses", "0.25", "--growth", "4", "--set", "clock.on_overrun=hold")

# Time for start and report on a slow host, s.
PATIENCE_S = 240


@pytest.mark.slow
@pytest.mark.timeout(60 * MINUTES + PATIENCE_S)
def test_nothing_grows() -> None:
    """In two minutes of real time memory, threads and open files do not grow."""
    command = [sys.executable, "-m", "tests.support.soak", *SOAK]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            table, errors = process.communicate()
        finally:
            process.terminate()  # only after an interrupt; the soak test ends its run first
    assert process.returncode == 0, errors
    assert all(f"| {name} |" in table for name in ("recorder", "coordinator", "plant", "agent1", "agent4"))


def test_judgement() -> None:
    """Growth is reported: memory beyond an allocator's fluctuation, threads, files, deadline misses."""

    def flat() -> Record:
        return Record(memory=[1e8] * 30, threads=[10.0] * 30, files=[20.0] * 30)

    assert judge({"a": flat()}, [0] * 90)[1] == []
    for change, step, word in (
        ("memory", 3.0 * GROWTH_BYTES, "memory 95.4 -> "),
        ("threads", 3.0, "threads 10 -> 13"),
        ("files", 1.0, "files 20 -> 21"),
    ):
        record = flat()
        values = getattr(record, change)
        values[-10:] = [values[0] + step] * 10
        wrong = judge({"a": record}, [0] * 90)[1]
        assert len(wrong) == 1
        assert word in wrong[0]
    early = flat()
    early.memory[:3] = [1e7] * 3  # the warm-up
    assert judge({"a": early}, [0] * 90)[1] == []
    assert "0.000 in the first third, 1.000 in the last" in judge({"a": flat()}, [0] * 60 + [1] * 30)[1][0]
    assert judge({"a": flat()}, [0] * 60 + [1] * 30, misses=1.0)[1] == []
    for runnable in ([3] * 90, [9] * 60 + [3] * 30, [3] * 89 + [9]):  # of a host that has not become busier
        assert "1.000 in the last" in judge({"a": flat()}, [0] * 60 + [1] * 30, runnable)[1][0]
    assert judge({"a": flat()}, [0] * 60 + [1] * 30, [3] * 60 + [9] * 30)[1] == []
    assert judge({"a": flat()}, [1] * 60 + [0] * 30)[1] == []
    assert judge({"a": flat()}, [0] * 61 + [None] * 29)[1] == []  # left out
    with pytest.raises(BenchmarkError, match="expected at least 4 samples"):
        judge({"a": Record(memory=[1.0], threads=[1.0], files=[1.0])}, [0] * 90)


def test_stolen_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stolen seconds are covered with the second after each, and no others."""
    now, path, hz = [100.0], tmp_path / "stat", os.sysconf("SC_CLK_TCK")
    monkeypatch.setattr(time, "time", lambda: now[0])

    def sample(at_s: float, stolen_s: float) -> None:
        now[0] = at_s
        path.write_text(f"cpu  1 2 3 4 5 6 7 {round(stolen_s * hz)} 0 0\ncpu0 0\n")
        stolen.sample()

    path.write_text("cpu  1 2 3 4 5 6 7 0 0 0\n")
    stolen = soak.Stolen(path)
    for at_s, stolen_s in ((101.0, 0.0), (102.0, 0.5), (103.0, 0.51), (104.0, 0.51), (105.0, 1.5), (106.0, 2.5)):
        sample(at_s, stolen_s)
    at = [100.5, 101.0, 101.9, 102.9, 103.0, 103.9, 104.0, 105.5, 106.9, 107.0]
    assert [stolen.covers(at_s) for at_s in at] == [False, True, True, True, False, False, True, True, True, False]
    assert not soak.Stolen(tmp_path / "missing").covers(100.0)
