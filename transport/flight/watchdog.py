"""Watchdog of a run: finds the process that keeps a run from beginning or from going on.

Each phase of a run has one deadline for silence. It is measured on what the processes do (`transport.flight.vitals`),
not on a clock: a slow host delays a run and does not end it.

| phase | who is watched | deadline |
|---|---|---|
| start | the fork server | `transport.flight.fork_server` |
| join, until the first tick | every process | stopped for 10 s, or for half of `clock.join_timeout_s` |
| run | the coordinator; it watches the others | stopped for 15 s, or idle for longer than it ever waits |
| end | every process | `Harness.end`: SIGTERM, 5 s later SIGKILL |
"""

import signal
import time

from protocol.scenario.setup import Setup
from protocol.wire.names import COORDINATOR
from transport.flight.harness import Child, Harness
from transport.flight.vitals import Pulse

# Longest stop of a process that joins, s: Zenoh gives up a silent process after the same time.
_JOIN_STOPPED_S = 10.0
# Longest stop of the coordinator in a run, s. The others notice a frozen process after 10 s by themselves, unless it
# still serves the network.
_RUN_STOPPED_S = 15.0
# How much longer than its timeouts the coordinator may be idle, s.
_IDLE_MARGIN_S = 15.0
# Interval between two looks at the processes, s.
_LOOK_EVERY_S = 0.25


class Watchdog:
    """Watches the processes of one run in the phases "join" and "run"; the harness ends them."""

    def __init__(self, setup: Setup, harness: Harness) -> None:
        self._harness = harness
        self._pulses: dict[int, Pulse] = {}  # by process id
        self._look_s = 0.0
        clock = setup.scenario.clock
        period_s = 0.0 if clock.speed == 0.0 else setup.period_ns / 1e9 / clock.speed
        self._join_stopped_s = min(_JOIN_STOPPED_S, 0.5 * clock.join_timeout_s)
        self._idle_s = _IDLE_MARGIN_S + max(clock.barrier_timeout_s, clock.join_timeout_s, period_s)

    def find_absent(self) -> str:
        """Return why the run cannot begin, naming the process that does not answer; empty as long as it may."""
        stuck = [(child, p) for child, p in self._look(self._harness.alive()) if p.stopped_s > self._join_stopped_s]
        if not stuck:
            return ""
        child, pulse = max(stuck, key=lambda found: found[1].stopped_s)
        return f"{child.name} does not answer: {pulse.description} for {pulse.stopped_s:.0f} s before the run began"

    def end_silent_coordinator(self) -> str:
        """Kill the coordinator if it does not work any more; return why, or an empty text.

        Without it no tick opens, and its peers wait for as long as its connections live.
        """
        child = self._harness.child(COORDINATOR)
        if child is None or child.process.poll() is not None:
            return ""
        for _, pulse in self._look([child]):
            if pulse.stopped_s > _RUN_STOPPED_S or pulse.idle_s > self._idle_s:
                silent_s = max(pulse.stopped_s, pulse.idle_s)
                reason = f"{COORDINATOR} did not answer ({pulse.description} for {silent_s:.0f} s) and was killed"
                self._harness.signal(COORDINATOR, signal.SIGKILL)
                return reason
        return ""

    def _look(self, children: list[Child]) -> list[tuple[Child, Pulse]]:
        """Return children with their pulses, when a look is due."""
        if time.monotonic() < self._look_s:
            return []
        self._look_s = time.monotonic() + _LOOK_EVERY_S
        found = [(child, self._pulses.setdefault(child.process.pid, Pulse(child.process.pid))) for child in children]
        for _, pulse in found:
            pulse.look()
        return found
