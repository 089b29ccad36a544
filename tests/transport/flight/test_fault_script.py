"""Faults of a script, with the processes and the recorder of a run in place of real ones."""

import math
import signal
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support import runs
from transport.flight.fault_script import FaultScript
from transport.flight.local_processes import Harness
from transport.flight.recorder import Recorder
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE
from transport.protocol.wire.messages import Request

STOP = "{at_s=0.3,target='coordinator',do='stop'},{at_s=1.2,target='coordinator',do='continue'}"
STOPPED_S = 0.9
SECOND_STOP = (
    "{at_s=1.5,target='coordinator',do='stop'},{at_s=1.8,target='coordinator',do='continue'}"
)
SECOND_STOPPED_S = 0.3
AGENT_STOP = "{at_s=0.3,target='agent2',do='stop'},{at_s=0.5,target='agent2',do='continue'}"
AGENT_KILL = "{at_s=0.3,target='agent2',do='kill'},{at_s=0.5,target='agent2',do='restart'}"
PLANT_STOP = "{at_s=0.3,target='plant',do='stop'},{at_s=0.5,target='plant',do='continue'}"
STOP_TICK = 6
RETURN_TICK = 10
PATIENCE_S = 10.0  # longer than a process that is due to leave is waited for


class Child:
    """A process that can be stopped, continued and killed."""

    code: int | None = None
    is_noted = False

    def __init__(
        self, incarnation: int = 0, *, name: str = "agent2", is_stopped: bool = False
    ) -> None:
        self.incarnation = incarnation
        self.name = name
        self.is_stopped = is_stopped

    def signal(self, number: int) -> bool:
        """Stop at SIGSTOP, continue at SIGCONT, end at SIGKILL; return whether the process ran."""
        if self.code is not None:
            return False
        self.is_stopped = number == signal.SIGSTOP
        if number == signal.SIGKILL:
            self.code = -number
        return True

    def wait(self, _timeout_s: float) -> int | None:
        """Return the exit code at once: a killed process has ended."""
        return self.code


class Run:
    """A run with a script and one process, which the test stops in place of the script's fault.

    `agent1` is a process of its own if it is asked for; the one process stands for all others.
    """

    def __init__(
        self,
        script: str,
        *settings: str,
        seen: int,
        is_stopped: bool = False,
        scenario: str = "resilient",
        with_agent1: bool = False,
    ) -> None:
        self.children = [Child(is_stopped=is_stopped)]
        self.agent1 = Child(name="agent1")
        self._with_agent1 = with_agent1
        self.notes: list[tuple[str, str]] = []
        self.noted: list[tuple[str, str, int | None]] = []  # target, what and tick of each note
        self.now_s = 0.0
        self.recorder = SimpleNamespace(
            tick=seen,
            members=frozenset(),
            control=None,
            requests=SimpleQueue[Request](),
            note=self._note,
        )
        harness = SimpleNamespace(
            ended=lambda: [c for c in (self.agent1, *self.children) if c.code is not None],
            child=self._child_of,
            mesh=("coordinator", "plant", "agent2"),
            start=self._start,
        )
        run = runs.ready(
            scenario, "clock.on_agent_loss=continue", f"faults.event=[{script}]", *settings
        )
        self._script = FaultScript(
            run, cast("Harness", harness), cast("Recorder", self.recorder), lambda: self.now_s
        )

    @property
    def child(self) -> Child:
        """The process that was started last."""
        return self.children[-1]

    def _child_of(self, name: str) -> Child:
        return self.agent1 if self._with_agent1 and name == "agent1" else self.child

    def _start(self, _target: str, incarnation: int) -> None:
        self.children.append(Child(incarnation))

    def _note(self, target: str, what: str, origin: str, tick: int | None = None) -> None:
        self.notes.append((what, origin))
        self.noted.append((target, what, tick))

    def work(self) -> None:
        """Apply due faults and answer requests."""
        self._script.work()

    def has_killed(self) -> bool:
        """Return whether the script has ended the process."""
        return self._script.has_killed(cast("Any", self.child))

    def answer(self, action: str, target: str, what: str = "fault") -> dict[str, Any]:
        """Ask for a fault as an operator does; return the answer."""
        answers: list[Any] = []
        self.recorder.requests.put(Request(what, {"do": action, "target": target}, answers.append))
        self.work()
        answer: dict[str, Any] = answers[0]
        return answer

    def ask(self, action: str, target: str) -> None:
        """Ask for a fault that must be applied."""
        assert "error" not in self.answer(action, target)


def continued_agent() -> Run:
    """Return a run in which the script has just continued an agent that is off the roster."""
    run = Run(AGENT_STOP, seen=RETURN_TICK, is_stopped=True)
    run.work()
    run.work()
    assert run.notes == [("stopped", "script"), ("continued", "script")]
    return run


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


@pytest.mark.parametrize(("seen", "is_noted"), [(STOP_TICK - 2, False), (STOP_TICK - 1, True)])
def test_a_stopped_process_is_at_its_stop_from_the_tick_before_on(
    seen: int, is_noted: bool
) -> None:
    """An agent may read its message of tick 6 before the recorder sees that tick, not that of tick 5."""
    run = Run(AGENT_STOP, seen=seen, is_stopped=True)
    run.work()
    assert run.noted == [("agent2", "stopped", STOP_TICK)] * is_noted


def test_a_plant_that_a_person_has_stopped_is_not_at_its_stop_in_the_tick_before() -> None:
    """The script would continue such a plant, which then stops at its tick and never returns."""
    run = Run(PLANT_STOP, seen=STOP_TICK - 1)
    run.ask("stop", "plant")
    run.work()
    assert run.notes == [("stopped", "person")]


def test_a_return_by_script_ends_a_stop_by_a_person() -> None:
    """A coordinator stopped by the script and by a person is continued: its next stop is the script's.

    The wait for the return from that stop begins with it.
    """
    run = Run(f"{STOP},{SECOND_STOP}", seen=2, is_stopped=True)
    run.work()
    run.ask("stop", "coordinator")
    run.now_s += STOPPED_S + 0.01
    run.work()
    run.child.is_stopped = True
    run.work()
    assert run.notes == [
        ("stopped", "script"),
        ("stopped", "person"),
        ("continued", "script"),
        ("stopped", "script"),
    ]

    run.now_s += SECOND_STOPPED_S - 0.01
    run.work()
    assert run.child.is_stopped
    run.now_s += 0.02
    run.work()
    assert not run.child.is_stopped


@pytest.mark.parametrize("speed", [0.0, 1.0, 2.0])
def test_a_stop_of_the_coordinator_lasts_its_time_at_the_pace_of_the_run(speed: float) -> None:
    """0.9 s of scenario time are 0.45 s at speed 2; a run without a pace waits as at speed 1."""
    run = Run(STOP, f"clock.speed={speed}", seen=4, is_stopped=True)
    run.work()
    wait_s = STOPPED_S / (speed or 1.0)
    run.now_s = wait_s - 0.01
    run.work()
    assert run.child.is_stopped
    run.now_s = wait_s + 0.01
    run.work()
    assert not run.child.is_stopped


def test_an_agent_returns_once_the_tick_before_is_open() -> None:
    """The coordinator opens the tick of a return once the agent is ready, so that tick is too late."""
    run = Run(AGENT_STOP, seen=RETURN_TICK - 2, is_stopped=True)
    run.work()
    run.now_s = math.inf
    run.work()
    assert run.child.is_stopped
    run.recorder.tick = RETURN_TICK - 1
    run.work()
    assert not run.child.is_stopped


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
        run.work()
        assert run.notes[-1] == note
        assert run.has_killed() is killed
        run.children.append(Child())


def test_a_kill_is_over_once_its_process_has_been_restarted() -> None:
    """A process that did not reach its scripted kill in time is ended for its restart, and only that."""
    run = Run(AGENT_KILL, seen=RETURN_TICK)
    for run.now_s in (0.0, 2.9):
        run.work()
        assert run.notes == []
    run.now_s = 3.0
    run.work()
    assert run.notes == [("restarted", "script")]

    run.child.code = -signal.SIGKILL
    run.work()
    assert run.notes[1:] == [("ended by SIGKILL", "unknown")]


def test_each_process_has_faults_of_its_own() -> None:
    """A return that waits delays no other process; a return is the end of earlier kills of its process alone."""
    first = "{at_s=0.3,target='agent1',do='kill'},{at_s=0.4,target='agent1',do='restart'}"
    second_kill = "{at_s=0.8,target='agent2',do='kill'}"
    run = Run(f"{first},{AGENT_KILL},{second_kill}", seen=RETURN_TICK, with_agent1=True)
    run.child.code = -signal.SIGKILL
    run.work()
    run.work()
    assert run.noted == [("agent2", "killed", STOP_TICK), ("agent2", "restarted", None)]

    run.agent1.code = -signal.SIGKILL  # which has read its message late
    run.child.code = -signal.SIGKILL
    run.work()
    assert ("agent1", "killed", STOP_TICK) in run.noted
    assert ("agent2", "killed", 16) in run.noted


def test_an_end_by_another_signal_is_no_kill_of_the_script() -> None:
    """A process that crashes before its scripted kill is not known to the script."""
    run = Run("{at_s=0.3,target='agent2',do='kill'}", seen=2)
    run.child.code = -signal.SIGSEGV
    run.work()
    run.work()
    assert run.notes == [("ended by SIGSEGV", "unknown")]
    assert not run.has_killed()


@pytest.mark.parametrize(
    ("what", "action", "target", "problem"),
    [
        ("link", "kill", "agent2", "what: expected fault or health, got 'link'"),
        ("fault", "end", "agent2", "do: expected one of kill, stop, continue, restart, got 'end'"),
        ("fault", "kill", "agent9", "target: expected one of coordinator, plant, agent2, got 'agent9'"),
        ("fault", "stop", "agent2", "agent2 is not running"),
    ],
)  # fmt: skip
def test_a_request_that_cannot_be_is_refused(
    what: str, action: str, target: str, problem: str
) -> None:
    """With expected and got, or because the process has ended; nothing is noted."""
    run = Run(AGENT_STOP, seen=2)
    run.ask("kill", "agent2")
    assert run.answer(action, target, what) == {"error": problem}
    assert run.notes == [("killed", "person")]


def test_a_kill_by_a_person_is_noted_once() -> None:
    """The end of a process that an operator has killed is no second event of unknown cause."""
    run = Run(AGENT_STOP, seen=2)
    run.ask("kill", "agent2")
    run.work()
    assert run.notes == [("killed", "person")]


@pytest.mark.parametrize("seen", [2, STOP_TICK], ids=["before its stop", "while stopped"])
def test_the_script_does_not_continue_an_agent_that_a_person_has_killed(seen: int) -> None:
    """Killed before its stop, it does not execute that either; the next actions of the script are possible."""
    run = Run(AGENT_STOP, seen=seen)
    run.ask("kill", "agent2")
    executed = [*run.notes]
    for tick in (STOP_TICK, RETURN_TICK, RETURN_TICK + 1):
        run.recorder.tick = tick
        run.work()
    assert run.notes == executed
    assert executed[-1] == ("killed", "person")
    assert (("stopped", "script") in executed) == (seen == STOP_TICK)
    assert len(run.children) == 1


def test_a_restart_by_a_person_replaces_stop_and_return_of_the_script() -> None:
    """An agent killed before its stop and restarted after it has neither stopped nor been continued."""
    run = Run(AGENT_STOP, seen=2)
    run.ask("kill", "agent2")
    run.recorder.tick = STOP_TICK + 1
    run.ask("restart", "agent2")
    run.recorder.tick = RETURN_TICK
    run.work()
    run.now_s += PATIENCE_S
    run.work()
    assert run.notes == [("killed", "person"), ("restarted", "person")]


def test_the_script_does_not_continue_an_agent_that_a_person_has_continued() -> None:
    """The stop has ended before its time: the script notes no second return."""
    run = Run(AGENT_STOP, seen=STOP_TICK, is_stopped=True)
    run.ask("continue", "agent2")
    run.recorder.tick = RETURN_TICK
    run.work()
    run.now_s += PATIENCE_S
    run.work()
    assert run.notes == [("stopped", "script"), ("continued", "person")]


def test_the_script_restarts_an_agent_that_a_person_has_killed() -> None:
    """A restart needs no running process; the kill by the script before it was not executed."""
    run = Run(AGENT_KILL, seen=2)
    run.ask("kill", "agent2")
    run.recorder.tick = RETURN_TICK
    run.work()
    assert run.notes == [("killed", "person"), ("restarted", "script")]
    assert run.child.incarnation == 1


def test_a_continued_agent_without_connections_is_restarted() -> None:
    """An agent stopped for 12 s at speed 1 ends when it is continued: its return is a restart, once."""
    run = continued_agent()
    run.child.code = EXIT_UNREACHABLE
    run.work()
    assert run.notes[2:] == [("restarted", "script")]
    assert run.child.incarnation == 1

    run.child.code = EXIT_UNREACHABLE
    run.work()
    assert len(run.children) == 2


@pytest.mark.parametrize("code", [0, EXIT_INTERRUPTED])
def test_a_continued_agent_that_ends_for_another_reason_is_not_restarted(code: int) -> None:
    """An agent ends with 0 after the run, and with 130 by a signal of an operator."""
    run = continued_agent()
    run.child.code = code
    run.work()
    assert len(run.children) == 1


def test_a_continued_agent_that_a_person_kills_is_not_restarted() -> None:
    """The kill is newer than the return."""
    run = continued_agent()
    run.ask("kill", "agent2")
    run.work()
    assert len(run.children) == 1


def test_a_continued_agent_that_was_on_the_roster_again_is_not_restarted() -> None:
    """Its return has succeeded: a later loss of its connections has another cause."""
    run = continued_agent()
    run.recorder.members = frozenset({"agent2"})
    run.work()
    run.recorder.members = frozenset()
    run.child.code = EXIT_UNREACHABLE
    run.work()
    assert len(run.children) == 1


def test_no_agent_is_restarted_after_the_end_of_the_run() -> None:
    """Agents lose their connections at the end, too."""
    run = continued_agent()
    run.recorder.control = object()
    run.child.code = EXIT_UNREACHABLE
    run.work()
    assert len(run.children) == 1


def test_a_continued_coordinator_is_not_restarted() -> None:
    """The run ends with the coordinator."""
    run = Run(STOP, seen=4, is_stopped=True)
    run.work()
    run.now_s += STOPPED_S + 0.01
    run.work()
    run.child.code = EXIT_UNREACHABLE
    run.work()
    assert len(run.children) == 1


@pytest.mark.parametrize("target", ["coordinator", "plant"])
def test_only_agents_are_restarted_by_hand(target: str) -> None:
    """A restart of plant or coordinator is refused before the process is killed."""
    run = Run(AGENT_STOP, seen=2)
    problem = f"expected an agent to restart, as a run ends with its {target}"
    assert run.answer("restart", target) == {"error": f"target: {problem}"}
    assert run.child.code is None
    assert run.notes == []


def test_a_coordinator_is_restarted_where_the_team_goes_on_without_it() -> None:
    """With `clock.on_coordinator_loss` continue the run does not end with it; it does with the plant."""
    run = Run("", seen=2, scenario="flight")
    assert "error" in run.answer("restart", "plant")
    run.ask("restart", "coordinator")
    assert [child.incarnation for child in run.children] == [0, 1]


def test_a_request_before_the_first_tick_is_answered_with_tick_0() -> None:
    """The recorder notes such a fault at tick 0."""
    run = Run(AGENT_STOP, seen=-1)
    assert run.answer("stop", "agent2") == {"tick": 0}
