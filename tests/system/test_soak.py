"""The soak test, shortened to the 600 ticks of half a minute at twice their pace, and its judgement."""

import subprocess
import sys

import pytest

from tests.campaigns.soak import GROWTH_BYTES, Record, judge
from tests.support.commands import settings

# The clock waits for late processes: on a host busy with other tests the run would diverge. The
# bound is wider than for thirty minutes; a leak of 10 kB a tick is still found. Two agents with short
# horizons take the least processor time.
MINUTES = 0.5
SOAK = (
    "--minutes",
    str(MINUTES),
    "--growth",
    "3",
    "--every",
    "1",
    *settings("clock.on_overrun=hold", "clock.speed=2", "controller.horizon=10"),
    *settings("agents.owned=[[1,2],[3,4]]"),
)

# Time for start and report on a slow host, s.
PATIENCE_S = 240


@pytest.mark.slow
@pytest.mark.timeout(60 * MINUTES + PATIENCE_S)
def test_nothing_grows() -> None:
    """In 600 ticks in real time memory, threads and open files do not grow."""
    command = [sys.executable, "-m", "tests.campaigns.soak", *SOAK]
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
    assert all(
        f"{name}: memory" in table
        for name in ("recorder", "coordinator", "plant", "agent1", "agent2")
    )


@pytest.mark.parametrize(
    ("resource", "step", "word"),
    [
        ("memory", 3.0 * GROWTH_BYTES, "memory 95.4 -> "),
        ("threads", 3.0, "threads 10.0 -> 13.0"),
        ("files", 1.0, "files 20.0"),
    ],
)
def test_growth_is_reported(resource: str, step: float, word: str) -> None:
    """Growth is reported: memory beyond an allocator's fluctuation, threads, files.

    The warm-up is not growth.
    """
    record = Record(memory=[1e8] * 30, threads=[10.0] * 30, files=[20.0] * 30)
    values = getattr(record, resource)
    values[:3] = [0.1 * values[0]] * 3
    assert judge({"a": record})[1] == []
    values[-10:] = [values[-1] + step] * 10
    assert [word in line for line in judge({"a": record})[1]] == [True]
