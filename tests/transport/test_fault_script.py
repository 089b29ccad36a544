"""Faults of a script, with the processes and the recorder of a run in place of real ones."""

import signal
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support import runs
from transport.flight.fault_script import FaultScript
from transport.flight.harness import Harness
from transport.flight.recorder import Recorder
from transport.protocol.wire.messages import Request

STOP = "{at_s=0.3,target='coordinator',do='stop'},{at_s=1.2,target='coordinator',do='continue'}"
STOPPED_S = 0.9
AGENT_STOP = "{at_s=0.3,target='agent2',do='stop'},{at_s=0.5,target='agent2',do='continue'}"
AGENT_KILL = "{at_s=0.3,target='agent2',do='kill'},{at_s=0.5,target='agent2',do='restart'}"
RETURN_TICK = 10
PATIENCE_S = 10.0  # longer than a process that is due to leave is waited for


class Child:
    """A process that can be stopped and continued."""

    name = "agent2"
    code: int | None = None
    incarnation = 0
    is_noted = False

    def __init__(self, *, is_stopped: bool) -> None:
        self.is_stopped = is_stopped

    def signal(self, number: int) -> bool:
        """Stop at SIGSTOP; take any other signal as one that continues."""
        self.is_stopped = number == signal.SIGSTOP
        return True

    def wait(self, _timeout_s: float) -> None:
        """End by the signal before."""
        self.code = -signal.SIGKILL


class Run:
    """A run with a script and one process, which the test stops in place of the script's fault."""

    def __init__(self, script: str, *settings: str, seen: int, is_stopped: bool = False) -> None:
        self.child = Child(is_stopped=is_stopped)
        self.notes: list[tuple[str, str]] = []
        self.now_s = 0.0
        self.recorder = SimpleNamespace(
            tick=seen,
            members=frozenset(),
            control=None,
            requests=SimpleQueue[Request](),
            note=self._note,
        )
        self.ended: list[Child] = []
        harness = SimpleNamespace(
            ended=lambda: self.ended,
            child=lambda _: self.child,
            mesh=("coordinator", "agent2"),
            start=self._start,
        )
        run = runs.ready(
            "resilient", "clock.on_agent_loss=continue", f"faults.event=[{script}]", *settings
        )
        self._script = FaultScript(
            run, cast("Harness", harness), cast("Recorder", self.recorder), lambda: self.now_s
        )

    def _start(self, _target: str, incarnation: int) -> None:
        self.child = Child(is_stopped=False)
        self.child.incarnation = incarnation

    def _note(self, _target: str, what: str, origin: str, *_: Any) -> None:
        self.notes.append((what, origin))

    def work(self) -> None:
        """Apply due faults and answer requests."""
        self._script.work()

    def has_killed(self) -> bool:
        """Return whether the script has ended the process."""
        return self._script.has_killed(cast("Any", self.child))

    def ask(self, action: str, target: str) -> None:
        """Ask for a fault as an operator does."""
        answers: list[Any] = []
        self.recorder.requests.put(
            Request("fault", {"do": action, "target": target}, answers.append)
        )
        self.work()
        assert "error" not in answers[0]


@pytest.mark.parametrize("seen", [2, 4, 5])
def test_a_frozen_coordinator_is_continued_whatever_the_recorder_has_seen(seen: int) -> None:
    """It stops before tick 6; on a busy machine earlier ticks have not left it either."""
    run = Run(STOP, seen=seen, is_stopped=True)
    run.work()
    assert run.notes == [("stopped", "script")]
    assert run.child.is_stopped
    run.now_s += STOPPED_S + 0.01
    run.work()
    assert not run.child.is_stopped


def test_a_stop_by_a_person_is_not_that_of_the_script() -> None:
    """A coordinator that a person has stopped is not at its scripted stop; continued, it may be."""
    run = Run(STOP, seen=2)
    run.ask("stop", "coordinator")
    run.now_s += 2.0 * STOPPED_S
    run.work()
    assert run.notes == [("stopped", "person")]
    assert run.child.is_stopped

    run.ask("continue", "coordinator")
    run.child.is_stopped = True  # at its tick, which the recorder has not seen
    run.work()
    assert run.notes[1:] == [("continued", "person"), ("stopped", "script")]


@pytest.mark.parametrize(
    ("clock", "is_awaited"),
    [(("clock.mode=lockstep",), True), (("clock.mode=realtime", "clock.speed=1.0"), False)],
    ids=["lockstep", "realtime"],
)
def test_in_lockstep_a_stopped_agent_returns_once_off_the_roster(
    clock: tuple[str, ...], is_awaited: bool
) -> None:
    """Before, its answer to the tick of its stop would count; a real-time tick ends without it."""
    run = Run(AGENT_STOP, *clock, seen=RETURN_TICK, is_stopped=True)
    run.recorder.members = frozenset({"agent1", "agent2"})
    run.work()
    run.work()
    assert run.child.is_stopped == is_awaited

    run.recorder.members = frozenset({"agent1"})
    run.work()
    assert not run.child.is_stopped
    assert run.notes == [("stopped", "script"), ("continued", "script")]


def test_a_kill_by_script_is_known_before_the_recorder_has_any_tick() -> None:
    """On a busy machine a process is dead before the recorder has its tick; a second end is no kill."""
    run = Run("{at_s=0.3,target='agent2',do='kill'}", seen=-1)
    assert not run.has_killed()
    for killed, note in ((True, ("killed", "script")), (False, ("ended by SIGKILL", "unknown"))):
        run.child.code = -signal.SIGKILL
        run.ended = [run.child]
        run.work()
        assert run.notes[-1] == note
        assert run.has_killed() is killed
        run.child = Child(is_stopped=False)


def test_a_kill_is_over_once_its_process_has_been_restarted() -> None:
    """A process that did not reach its scripted kill in time is ended for its restart, and only that."""
    run = Run(AGENT_KILL, seen=RETURN_TICK)
    run.work()
    run.now_s += PATIENCE_S
    run.work()
    assert run.notes == [("restarted", "script")]

    run.child.code = -signal.SIGKILL
    run.ended.append(run.child)
    run.work()
    assert run.notes[1:] == [("ended by SIGKILL", "unknown")]
