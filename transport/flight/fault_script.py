"""Faults of local processes, applied by their parent: scripted, or requested by the operator; all are logged.

Processes kill or stop themselves at a scripted tick (`protocol.scenario.faults`); the parent brings them back.
"""

import signal
import time
from collections.abc import Callable, Mapping

from protocol.scenario.faults import OF_UAVS
from protocol.scenario.setup import Setup
from protocol.wire.messages import FaultOrigin, Request
from transport.flight.harness import Harness
from transport.flight.recorder import Recorder


class FaultScript:
    """Faults of the local processes of one run, noted by its recorder."""

    def __init__(self, setup: Setup, harness: Harness, recorder: Recorder) -> None:
        self._setup, self._harness, self._recorder = setup, harness, recorder
        # The plant applies the failures of UAVs.
        self._faults = [fault for fault in setup.faults if fault.do not in OF_UAVS]
        self._dead: set[int] = set()  # children whose end has been noted
        for target in {fault.target for fault in self._faults if fault.do == "start"}:
            harness.prepare(target)
        self._actions: Mapping[str, Callable[[str], bool]] = {
            "kill": lambda name: harness.signal(name, signal.SIGKILL),
            "stop": lambda name: harness.signal(name, signal.SIGSTOP),
            "continue": lambda name: harness.signal(name, signal.SIGCONT),
            "restart": self._restart,
        }

    def work(self) -> None:
        """Apply due faults, answer requests, and note ended processes; to be called often."""
        while self._faults and self._is_due(self._faults[0].tick - (self._faults[0].do in ("continue", "start"))):
            fault = self._faults.pop(0)
            if fault.do in ("kill", "stop"):
                self._note(fault.target, fault.do, "script", fault.tick)
            else:
                self._do(fault.target, "restart" if fault.do == "start" else "continue", "script")
        while not self._recorder.requests.empty():
            self._answer(self._recorder.requests.get())
        for child in self._harness.ended():
            code = child.code or 0
            if child.process.pid in self._dead or code >= 0:
                continue
            expected = (fault for fault in self._faults if (fault.do, fault.target) == ("kill", child.name))
            kill = next(expected, None) if code == -signal.SIGKILL else None
            self._dead.add(child.process.pid)
            if kill is None:
                self._recorder.note(child.name, f"ended by {signal.Signals(-code).name}", "unknown")
            else:
                self._faults.remove(kill)
                self._note(child.name, "kill", "script", kill.tick)

    def _is_due(self, tick: int) -> bool:
        if self._recorder.tick >= tick:
            return True
        # Without ticks, estimate the tick from the wall clock.
        speed, started_s = self._setup.scenario.clock.speed, self._recorder.started_s
        if speed == 0.0 or started_s is None:
            return False
        return (time.monotonic() - started_s) * speed >= (tick + 1) * self._setup.settings.sampling_period_s

    def _answer(self, request: Request) -> None:
        action, target = (str(request.given.get(key, "")) for key in ("do", "target"))
        names = list(self._harness.mesh)
        if request.what != "fault" or action not in self._actions:
            request.reply({"error": f"do: expected one of {', '.join(self._actions)}, got {action!r}"})
        elif target not in names:
            request.reply({"error": f"target: expected one of {', '.join(names)}, got {target!r}"})
        elif action == "restart" and not target.startswith("agent"):
            request.reply({"error": f"target: expected an agent to restart, as a run ends with its {target}"})
        elif not self._do(target, action, "person"):
            request.reply({"error": f"{target} is not running"})
        else:
            request.reply({"tick": self._recorder.tick})

    def _do(self, target: str, action: str, origin: FaultOrigin) -> bool:
        done = self._actions[action](target)
        if done:
            self._note(target, action, origin)
        return done

    def _note(self, target: str, action: str, origin: FaultOrigin, tick: int | None = None) -> None:
        done = {"kill": "killed", "stop": "stopped", "continue": "continued", "restart": "restarted"}
        self._recorder.note(target, done[action], origin, tick)
        child = self._harness.child(target)
        if action == "kill" and child is not None:
            self._dead.add(child.process.pid)

    def _restart(self, name: str) -> bool:
        old = self._harness.child(name)
        if old is not None:
            self._dead.add(old.process.pid)
        self._harness.restart(name)
        if any((fault.do, fault.target) == ("start", name) for fault in self._faults):
            self._harness.prepare(name)
        return True
