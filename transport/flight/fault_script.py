"""Faults of the local processes of one run, by script or by an operator."""

import signal
import time
from typing import Any

from transport.flight.harness import Child, Harness
from transport.flight.recorder import Recorder
from transport.protocol.scenario.faults import OF_UAVS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import FaultOrigin, Request

_SIGNALS = {
    "kill": signal.SIGKILL,
    "stop": signal.SIGSTOP,
    "continue": signal.SIGCONT,
    "restart": signal.SIGKILL,
}
_NOTES = {"kill": "killed", "stop": "stopped", "continue": "continued", "restart": "restarted"}

# Time for a process to end before it is started again, s.
_LEAVE_S = 3.0


class FaultScript:
    """Faults of the local processes of one run.

    By script a process kills or stops itself, which is noted here, and is continued or started
    again from here. An operator asks for faults by requests.
    """

    def __init__(self, setup: Setup, harness: Harness, recorder: Recorder) -> None:
        self._setup = setup
        self._harness = harness
        self._recorder = recorder
        # The plant applies the failures of UAVs. Kills are noted when the process has ended.
        self._kills = [fault for fault in setup.faults if fault.do == "kill"]
        self._faults = [fault for fault in setup.faults if fault.do not in (*OF_UAVS, "kill")]

    def work(self) -> None:
        """Apply due faults, answer requests, and note ended processes; to be called often."""
        for child in self._harness.ended():
            code = child.code or 0
            if code < 0 and not child.is_noted:
                self._note_end(child, signal.Signals(-code))

        self._apply_due()
        while not self._recorder.requests.empty():
            request = self._recorder.requests.get()
            request.reply(self._answer(request))

    def _note_end(self, child: Child, number: signal.Signals) -> None:
        """Note that a signal has ended a process: by script, or by an unknown origin."""
        child.is_noted = True
        kills = [fault for fault in self._kills if fault.target == child.name]
        if kills and number == signal.SIGKILL:
            self._kills.remove(kills[0])
            self._recorder.note(child.name, _NOTES["kill"], "script", kills[0].tick)
        else:
            self._recorder.note(child.name, f"ended by {number.name}", "unknown")

    def _apply_due(self) -> None:
        """Apply the scripted faults that are due."""
        while self._faults:
            fault = self._faults[0]
            is_stop = fault.do == "stop"
            # A process that comes back is needed at the tick: it starts one tick earlier.
            if not self._is_due(fault.tick if is_stop else fault.tick - 1):
                return

            self._faults.pop(0)
            if is_stop:
                self._recorder.note(fault.target, _NOTES["stop"], "script", fault.tick)
            else:
                self._do(fault.target, "restart" if fault.do == "start" else "continue", "script")

    def _is_due(self, tick: int) -> bool:
        """Return whether a tick has come.

        Without ticks, as while the coordinator is stopped, the wall clock of a paced run tells.
        """
        if self._recorder.tick >= tick:
            return True

        started_s = self._recorder.started_s
        since_s = 0.0
        if started_s is not None:
            since_s = (time.monotonic() - started_s) * self._setup.scenario.clock.speed
        return since_s >= (tick + 1) * self._setup.settings.sampling_period_s

    def _answer(self, request: Request) -> dict[str, Any]:
        """Apply the fault of a request, and return the answer."""
        if request.what != "fault":
            return {"error": f"what: expected fault or health, got {request.what[:40]!r}"}

        action = str(request.given.get("do", ""))
        target = str(request.given.get("target", ""))
        if action not in _NOTES:
            return {"error": f"do: expected one of {', '.join(_NOTES)}, got {action!r}"}
        if target not in self._harness.mesh:
            names = ", ".join(self._harness.mesh)
            return {"error": f"target: expected one of {names}, got {target!r}"}
        if action == "restart" and not target.startswith("agent"):
            expected = f"an agent to restart, as a run ends with its {target}"
            return {"error": f"target: expected {expected}"}

        if not self._do(target, action, "person"):
            return {"error": f"{target} is not running"}
        return {"tick": self._recorder.tick}

    def _do(self, target: str, action: str, origin: FaultOrigin) -> bool:
        """Apply a fault and note it; return whether the process was there."""
        child = self._harness.child(target)
        if not child.signal(_SIGNALS[action]) and action != "restart":
            return False

        child.is_noted |= action in ("kill", "restart")
        if action == "restart":
            child.wait(_LEAVE_S)
            self._harness.start(target, child.incarnation + 1)
        self._recorder.note(target, _NOTES[action], origin)
        return True
