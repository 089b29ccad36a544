"""The watchdog names the process that keeps a run from beginning, and kills a coordinator that does not work."""

import signal
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support.runs import setup
from transport.flight.harness import Harness
from transport.flight.watchdog import Watchdog

# Timeouts of the scenario, s.
JOIN_S, BARRIER_S = 30.0, 5.0
STOPPED = "stopped by a signal"


class FakeHarness:
    """Three processes that run, their states, and the signals they got."""

    def __init__(self) -> None:
        self.children = {name: SimpleNamespace(name=name, state="sleeping") for name in ("coordinator", "plant", "a1")}
        self.sent: list[tuple[str, int]] = []

    def alive(self) -> list[Any]:
        """Return all processes."""
        return list(self.children.values())

    def child(self, name: str) -> Any:
        """Return a process by name."""
        return self.children[name]

    def signal(self, name: str, number: int) -> bool:
        """Note a signal."""
        self.sent.append((name, number))
        return True


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> FakeHarness:
    """Return the processes; every look is 1 s after the one before, or much longer, which counts as 1 s."""
    times = (k * 1.0 + (k > 3) * 1000.0 for k in range(10**6))
    monkeypatch.setattr(time, "monotonic", lambda: next(times))
    return FakeHarness()


def watchdog(harness: FakeHarness, *changes: str) -> Watchdog:
    """Return a watchdog of the processes."""
    base = (f"clock.join_timeout_s={JOIN_S}", f"clock.barrier_timeout_s={BARRIER_S}")
    return Watchdog(setup(*base, *changes), cast("Harness", harness))


def looks(dog: Watchdog, *, joined: bool, received: Iterator[int]) -> tuple[int, str]:
    """Return at which look the watchdog finds something, and what; (200, "") if it does not."""
    for k in range(1, 200):
        found = dog.end_silent_coordinator(next(received)) if joined else dog.find_absent()
        if found:
            return k, found
    return 200, ""


@pytest.mark.parametrize(("join_s", "longest_s"), [(30.0, 10), (4.0, 2)])
def test_before_the_run_stopped_processes_are_named(harness: FakeHarness, join_s: float, longest_s: int) -> None:
    """Idle processes wait for others; one that is stopped for 10 s, or half of a short timeout, is to blame."""
    dog = watchdog(harness, f"clock.join_timeout_s={join_s}")
    assert looks(dog, joined=False, received=iter(range(1000))) == (200, "")
    harness.child("plant").state = STOPPED
    text = f"plant does not answer: stopped by a signal for {longest_s + 1} s before the run began"
    assert looks(dog, joined=False, received=iter(range(1000))) == (longest_s + 1, text)
    assert harness.sent == []


@pytest.mark.parametrize(
    ("changes", "longest_s"),
    [((), 15 + JOIN_S), (("clock.speed=0.001",), 15 + 50.0), (("clock.barrier_timeout_s=70.0",), 15 + 70.0)],
)
def test_in_the_run_the_coordinator_is_watched(
    harness: FakeHarness, changes: tuple[str, ...], longest_s: float
) -> None:
    """It is killed if it is stopped for 15 s, or if nothing arrives for 15 s longer than its longest timeout."""
    dog = watchdog(harness, *changes)
    harness.child("plant").state = STOPPED
    assert looks(dog, joined=True, received=iter(range(1000))) == (200, "")
    text = f"coordinator did not answer (no message for {longest_s + 1:.0f} s) and was killed"
    assert looks(dog, joined=True, received=iter([300] * 300)) == (longest_s + 2, text)
    assert harness.sent == [("coordinator", signal.SIGKILL)]
    dog = watchdog(harness, *changes)
    harness.child("coordinator").state = STOPPED
    text = "coordinator did not answer (stopped by a signal for 16 s) and was killed"
    assert looks(dog, joined=True, received=iter(range(1000))) == (16, text)
