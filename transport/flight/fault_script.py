"""Faults of the processes of one run: those of its script, and those an operator asks for.

A fault of the script is due at a tick, whatever the clock shows: kills and stops are acts of the
processes themselves (`protocol.network.node_process`), this module brings processes back. The clock
decides in one case only. No tick opens while coordinator or plant is stopped, so the end of such a
stop comes after a wait; no scenario time passes meanwhile.
"""

import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

from transport.flight.local_processes import Child, Harness
from transport.flight.recorder import Recorder
from transport.protocol.scenario.faults.faults_by_tick import OF_PLANT, Fault
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE
from transport.protocol.wire.messages import CONTINUED, FaultOrigin, Request
from transport.protocol.wire.names import COORDINATOR, PLANT

_SIGNALS = {
    "kill": signal.SIGKILL,
    "stop": signal.SIGSTOP,
    "continue": signal.SIGCONT,
    "restart": signal.SIGKILL,
}
_NOTES = {"kill": "killed", "stop": "stopped", "continue": CONTINUED, "restart": "restarted"}
_RESTART = "start"  # name of a restart in the script; operators and the tables above say "restart"

# Longest wait for a process to end or stop at its fault, or to end after SIGKILL, wall time, s.
_LEAVE_S = 3.0

# Processes with which a run ends; no tick opens while one of them is stopped.
_ESSENTIAL = (COORDINATOR, PLANT)


class FaultScript:
    """Applies and notes the faults of a run's local processes; the plant applies those of UAVs.

    `now_s` is a steady clock, s.
    """

    def __init__(
        self,
        setup: Setup,
        harness: Harness,
        recorder: Recorder,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._setup = setup
        self._harness = harness
        self._recorder = recorder
        self._now_s = now_s

        of_processes = [fault for fault in setup.faults if fault.do not in OF_PLANT]
        # A kill is noted when the process has ended.
        self._kills = [fault for fault in of_processes if fault.do == "kill"]
        self._pending = [fault for fault in of_processes if fault.do != "kill"]

        # The newest scripted stop of a process, and the steady-clock time at which it was seen, s.
        # It stays after the return of the process, until the next stop.
        self._stops: dict[str, tuple[Fault, float]] = {}
        # When the return of a process became due that had not left yet, steady clock, s.
        self._overdue_since_s: dict[Fault, float] = {}
        self._killed: list[Child] = []  # by the script
        # Processes that an operator has stopped.
        self._stopped_by_person: set[str] = set()
        # Agents that the script has continued, and that are not on the roster again.
        self._continued: set[str] = set()

    def work(self) -> None:
        """Note ended processes, apply due faults, and answer requests; to be called often."""
        for child in self._harness.ended():
            self._note_end(child)

        for fault in self._next_faults():
            if fault.do == "stop":
                self._note_stop(fault)
            else:
                self._bring_back(fault)
        self._restart_disconnected()

        while not self._recorder.requests.empty():
            request = self._recorder.requests.get()
            request.reply(self._answer(request))

    def has_killed(self, child: Child) -> bool:
        """Return whether the script has ended a process, as noted by `work`."""
        return any(killed is child for killed in self._killed)

    def _next_faults(self) -> Iterator[Fault]:
        """Yield the next scripted fault of each process: one that is not due delays no other."""
        targets = dict.fromkeys(fault.target for fault in self._pending)
        for target in targets:
            yield next(fault for fault in self._pending if fault.target == target)

    def _note_end(self, child: Child) -> None:
        """Note a process that a signal has ended, once."""
        code = child.code or 0
        if code >= 0 or child.is_noted:
            return
        child.is_noted = True

        is_killed = code == -signal.SIGKILL
        kills = [kill for kill in self._kills if is_killed and kill.target == child.name]
        if not kills:
            self._recorder.note(child.name, f"ended by {signal.Signals(-code).name}", "unknown")
            return
        self._kills.remove(kills[0])
        self._killed.append(child)
        self._recorder.note(child.name, _NOTES["kill"], "script", kills[0].tick)

    def _note_stop(self, fault: Fault) -> None:
        """Note a stop once its tick is open, or the process is seen to have stopped for it.

        A process that has ended before has not executed its stop, which is dropped.
        """
        child = self._harness.child(fault.target)
        is_open = self._recorder.tick >= fault.tick
        has_stopped = self._may_stop_unseen(fault) and child.is_stopped
        if not is_open and not has_stopped:
            return

        self._pending.remove(fault)
        if child.code is not None:
            return
        self._stops[fault.target] = fault, self._now_s()
        self._recorder.note(fault.target, _NOTES["stop"], "script", fault.tick)

    def _may_stop_unseen(self, fault: Fault) -> bool:
        """Return whether a stopped process may be at its fault, whose tick the recorder lacks."""
        if fault.target in self._stopped_by_person:
            return False

        # The coordinator stops before it opens the tick, and frozen it sends nothing more: the
        # recorder sees neither that tick nor, on a busy machine, those just before. So there is no
        # tick to wait for.
        if fault.target == COORDINATOR:
            return True

        # Other processes may read the message at which they stop before the recorder reads that of
        # the tick. It has then seen the tick before, or will: the coordinator has sent both.
        return self._recorder.tick >= fault.tick - 1

    def _bring_back(self, fault: Fault) -> None:
        """Continue or restart a process if that is due and the process has left.

        A process that is not stopped is not continued: it has ended, has not executed its stop, or an
        operator has continued it.
        """
        if not self._is_due(fault) or not self._has_left(fault):
            return
        self._pending.remove(fault)
        if fault.do == _RESTART:
            self._do(fault.target, "restart", "script")
        elif self._harness.child(fault.target).is_stopped:
            self._do(fault.target, "continue", "script")
            if fault.target not in _ESSENTIAL:
                self._continued.add(fault.target)

        # A kill that is not noted by now was not executed: the process had ended before, or was off
        # the roster and received no measurement of that tick. A later end is not of the script.
        self._kills = [kill for kill in self._kills if not _is_before(kill, fault)]

    def _restart_disconnected(self) -> None:
        """Restart continued agents that have ended because their connections were closed.

        A connection survives a stop of some seconds of wall time: without this, the pace of a run
        would decide whether an agent returns. Its state is the same as after a return in place.
        An agent that has ended for another reason, as by a kill, is not restarted.
        """
        self._continued -= self._recorder.members
        if self._recorder.control is not None:
            return
        for target in sorted(self._continued):
            if self._harness.child(target).code == EXIT_UNREACHABLE:
                self._continued.remove(target)
                self._do(target, "restart", "script")

    def _is_due(self, fault: Fault) -> bool:
        """Return whether the tick before that of a return is open, or its wait is over."""
        # The coordinator does not open the tick of a return before the agent is ready.
        if self._recorder.tick >= fault.tick - 1:
            return True

        # No tick opens while coordinator or plant is stopped: only their return waits by the clock.
        if fault.target not in _ESSENTIAL or fault.target not in self._stops:
            return False
        stop, seen_s = self._stops[fault.target]
        speed = self._setup.scenario.clock.speed or 1.0  # an unpaced run waits as in real time
        stopped_s = (fault.tick - stop.tick) * self._setup.settings.sampling_period_s / speed
        return self._now_s() - seen_s >= stopped_s

    def _has_left(self, fault: Fault) -> bool:
        """Return whether the process of a due return has ended or stopped, and its team knows.

        - It may still have to read the message at which it kills or stops itself: a signal before
          that would be of no effect, or take part of its last tick.
        - In lockstep a stopped agent has to be off the roster, too: its answer to the tick at which it
          stopped would still count.
        - A process that has neither ended nor stopped after 3 s will not: an agent that was off the
          roster at the tick of its fault received no measurement of that tick, at which it would have
          executed the fault.
        """
        child = self._harness.child(fault.target)
        is_gone = child.code is not None
        is_stopped = child.is_stopped
        if is_stopped and self._is_awaited(fault):
            return False
        if is_gone or is_stopped:
            return True
        since_s = self._overdue_since_s.setdefault(fault, self._now_s())
        return self._now_s() - since_s >= _LEAVE_S

    def _is_awaited(self, fault: Fault) -> bool:
        """Return whether the coordinator still waits for an answer of a stopped agent."""
        is_lockstep = self._setup.scenario.clock.mode == "lockstep"
        return is_lockstep and fault.target in self._recorder.members

    def _answer(self, request: Request) -> dict[str, Any]:
        """Apply a fault that an operator asks for; return the answer."""
        if request.what != "fault":
            # The bus has answered requests for health.
            return {"error": f"what: expected fault or health, got {request.what[:40]!r}"}

        action = str(request.given.get("do", ""))
        target = str(request.given.get("target", ""))
        for key, got, allowed in (("do", action, _NOTES), ("target", target, self._harness.mesh)):
            if got not in allowed:
                return {"error": f"{key}: expected one of {', '.join(allowed)}, got {got!r}"}
        goes_on = self._setup.scenario.clock.on_coordinator_loss == "continue"
        returns = target not in _ESSENTIAL or (target == COORDINATOR and goes_on)
        if action == "restart" and not returns:
            problem = f"expected an agent to restart, as a run ends with its {target}"
            return {"error": f"target: {problem}"}

        if not self._do(target, action, "person"):
            return {"error": f"{target} is not running"}
        return {"tick": max(self._recorder.tick, 0)}  # as in the note

    def _do(self, target: str, action: str, origin: FaultOrigin) -> bool:
        """Apply a fault and note it; return False if its process has ended, except for a restart."""
        child = self._harness.child(target)
        was_running = child.signal(_SIGNALS[action])
        if action == "restart":
            child.wait(_LEAVE_S)
            child.is_noted |= was_running
            self._note_end(child)
            self._harness.start([target], child.incarnation + 1)
        elif not was_running:
            return False
        child.is_noted |= action == "kill"

        self._stopped_by_person.discard(target)
        if action == "stop":  # asked for by an operator: a scripted stop is an act of the process
            self._stopped_by_person.add(target)
        self._recorder.note(target, _NOTES[action], origin)
        return True


def _is_before(kill: Fault, back: Fault) -> bool:
    """Return whether a kill is one that a return of its process ends."""
    return kill.target == back.target and kill.tick < back.tick
