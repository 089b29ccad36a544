"""Watchdog of a run: finds the process that keeps a run from beginning or from going on.

| phase | what is watched | limit |
|---|---|---|
| join, until the first tick | every process: whether it is stopped | 10 s, or half of `clock.join_timeout_s` |
| run | the coordinator, which watches the others: whether it is stopped, and whether messages arrive | 15 s stopped; \
15 s longer than its longest timeout without a message |
| end | every process | `Harness.end`: SIGTERM, 5 s later SIGKILL |
"""

import signal
import time
from collections import defaultdict

from protocol.scenario.setup import Setup
from protocol.wire.names import COORDINATOR
from transport.flight.fork_server import STOPPED
from transport.flight.harness import Harness

# Longest stop of a process that joins, s: Zenoh gives up a silent process after the same time.
_JOIN_STOPPED_S = 10.0
# Longest stop of the coordinator, s, and how much longer than its timeouts it may send nothing: the others notice a
# frozen process after 10 s by themselves, unless it still serves the network.
_RUN_STOPPED_S, _SILENT_MARGIN_S = 15.0, 15.0
# Interval of looks, s, and the longest time that one accounts for: this process may have been stopped itself.
_LOOK_S, _LONGEST_LOOK_S = 0.25, 1.0


class Watchdog:
    """Watches the processes of one run in the phases "join" and "run"; the harness ends them."""

    def __init__(self, setup: Setup, harness: Harness) -> None:
        self._harness = harness
        self._stopped_s = defaultdict[str, float](float)  # by name
        self._silent_s, self._received, self._looked_s = 0.0, 0, time.monotonic()
        clock = setup.scenario.clock
        period_s = 0.0 if clock.speed == 0.0 else setup.period_ns / 1e9 / clock.speed
        self._join_stopped_s = min(_JOIN_STOPPED_S, 0.5 * clock.join_timeout_s)
        self._longest_silence_s = _SILENT_MARGIN_S + max(clock.barrier_timeout_s, clock.join_timeout_s, period_s)

    def find_absent(self) -> str:
        """Return why the run cannot begin, naming the process that does not answer; empty as long as it may."""
        if not self._look(0):
            return ""
        name = max(self._stopped_s, key=lambda name: self._stopped_s[name], default="")
        if self._stopped_s[name] <= self._join_stopped_s:
            return ""
        return f"{name} does not answer: {self._state(name)} for {self._stopped_s[name]:.0f} s before the run began"

    def end_silent_coordinator(self, received: int) -> str:
        """Kill the coordinator if it does not work any more, given the number of recorded messages; return why.

        Without it no tick opens, and its peers wait for as long as its connections live. The text may be empty.
        """
        if not self._look(received):
            return ""
        stopped_s = self._stopped_s[COORDINATOR]
        if stopped_s > _RUN_STOPPED_S:
            found = f"{self._state(COORDINATOR)} for {stopped_s:.0f} s"
        elif self._silent_s > self._longest_silence_s:
            found = f"no message for {self._silent_s:.0f} s"
        else:
            return ""
        killed = self._harness.signal(COORDINATOR, signal.SIGKILL)
        return f"{COORDINATOR} did not answer ({found}) and was killed" if killed else ""

    def _state(self, name: str) -> str:
        child = self._harness.child(name)
        return "" if child is None else child.state

    def _look(self, received: int) -> bool:
        """Look at the processes if that is due; return whether it was."""
        since_s = time.monotonic() - self._looked_s
        if since_s < _LOOK_S:
            return False
        self._looked_s += since_s
        since_s = min(since_s, _LONGEST_LOOK_S)
        self._silent_s = 0.0 if received != self._received else self._silent_s + since_s
        self._received = received
        for child in self._harness.alive():
            is_stopped = child.state in STOPPED.values()
            self._stopped_s[child.name] = self._stopped_s[child.name] + since_s if is_stopped else 0.0
        return True
