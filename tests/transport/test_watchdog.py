"""The watchdog names the process that keeps a run from beginning, and kills a coordinator that does not work."""

import signal
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support.runs import setup
from transport.flight import watchdog as module
from transport.flight.harness import Harness
from transport.flight.watchdog import Watchdog

# Timeouts of the scenario, s.
JOIN_S, BARRIER_S = 30.0, 5.0


class FakePulse:
    """Pulse of a process as a test has it, by its id."""

    now: dict[int, tuple[float, float]] = {}  # noqa: RUF012  # set by each test

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.stopped_s = self.idle_s = 0.0
        self.description = "stopped by a signal"

    def look(self) -> None:
        """Take what the test says."""
        self.stopped_s, self.idle_s = self.now.get(self.pid, (0.0, 0.0))


class FakeHarness:
    """Three processes that run, and the signals they got."""

    def __init__(self) -> None:
        self.names = ("coordinator", "plant", "agent1")
        self.children = [
            SimpleNamespace(name=name, process=SimpleNamespace(pid=pid, poll=lambda: None))
            for pid, name in enumerate(self.names)
        ]
        self.sent: list[tuple[str, int]] = []

    def alive(self) -> list[Any]:
        """Return all processes."""
        return self.children

    def child(self, name: str) -> Any:
        """Return a process by name."""
        return self.children[self.names.index(name)]

    def signal(self, name: str, number: int) -> bool:
        """Note a signal."""
        self.sent.append((name, number))
        return True


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> FakeHarness:
    """Return the processes; every look is due."""
    monkeypatch.setattr(module, "Pulse", FakePulse)
    monkeypatch.setattr(module, "_LOOK_EVERY_S", -1.0)
    monkeypatch.setattr(FakePulse, "now", {})
    return FakeHarness()


def watchdog(harness: FakeHarness, *changes: str) -> Watchdog:
    """Return a watchdog of the processes."""
    base = (f"clock.join_timeout_s={JOIN_S}", f"clock.barrier_timeout_s={BARRIER_S}")
    return Watchdog(setup(*base, *changes), cast("Harness", harness))


def test_before_the_run_stopped_processes_are_named(harness: FakeHarness) -> None:
    """Idle processes wait for others; the one that has been stopped for longest is to blame, after 10 s."""
    dog = watchdog(harness)
    FakePulse.now = {0: (0.0, 1e6), 1: (9.9, 9.9), 2: (3.0, 3.0)}
    assert dog.find_absent() == ""
    FakePulse.now = {0: (0.0, 1e6), 1: (12.0, 12.0), 2: (11.0, 11.0)}
    assert dog.find_absent() == "plant does not answer: stopped by a signal for 12 s before the run began"
    assert harness.sent == []


def test_a_short_join_timeout_shortens_the_patience(harness: FakeHarness) -> None:
    """The stopped process is named before the others give up because of it."""
    dog = watchdog(harness, "clock.join_timeout_s=4.0")
    FakePulse.now = {1: (1.9, 1.9)}
    assert dog.find_absent() == ""
    FakePulse.now = {1: (2.1, 2.1)}
    assert dog.find_absent().startswith("plant does not answer")


def test_in_the_run_the_coordinator_is_watched(harness: FakeHarness) -> None:
    """It is killed when it is stopped for 15 s; other processes are its own business."""
    dog = watchdog(harness)
    FakePulse.now = {0: (14.9, 14.9), 1: (1e6, 1e6)}
    assert dog.end_silent_coordinator() == ""
    assert harness.sent == []
    FakePulse.now = {0: (15.1, 15.1)}
    assert dog.end_silent_coordinator() == "coordinator did not answer (stopped by a signal for 15 s) and was killed"
    assert harness.sent == [("coordinator", signal.SIGKILL)]


@pytest.mark.parametrize(
    ("changes", "longest_s"), [((), JOIN_S), (("clock.speed=0.001",), 50.0), (("clock.barrier_timeout_s=70.0",), 70.0)]
)
def test_an_idle_coordinator(changes: tuple[str, ...], longest_s: float, harness: FakeHarness) -> None:
    """It may be idle for as long as its longest timeout, and 15 s more."""
    dog = watchdog(harness, *changes)
    FakePulse.now = {0: (0.0, longest_s + 14.9)}
    assert dog.end_silent_coordinator() == ""
    FakePulse.now = {0: (0.0, longest_s + 15.1)}
    assert "and was killed" in dog.end_silent_coordinator()
