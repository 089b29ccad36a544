"""Faults of a script, with the processes and the recorder of a run in place of real ones."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support import runs
from transport.flight.fault_script import FaultScript
from transport.flight.harness import Harness
from transport.flight.recorder import Recorder

STOP = "{at_s=0.3,target='coordinator',do='stop'},{at_s=1.2,target='coordinator',do='continue'}"
STOPPED_S = 0.9


class Child:
    """A process that can be stopped and continued."""

    code = None
    incarnation = 0
    is_noted = False
    is_stopped = True

    def signal(self, number: int) -> bool:
        """Take any signal as one that continues."""
        self.is_stopped = not number
        return True


@pytest.mark.parametrize("seen", [2, 4, 5])
def test_a_frozen_coordinator_is_continued_whatever_the_recorder_has_seen(seen: int) -> None:
    """It stops before tick 6; on a busy machine earlier ticks have not left it either."""
    run = runs.ready("resilient", "clock.on_agent_loss=continue", f"faults.event=[{STOP}]")
    notes: list[str] = []

    def note(_target: str, what: str, *_: Any) -> None:
        notes.append(what)

    child = Child()
    harness = SimpleNamespace(ended=list, child=lambda _: child)
    requests = SimpleNamespace(empty=lambda: True)
    recorder = SimpleNamespace(
        tick=seen, members=frozenset(), control=None, requests=requests, note=note
    )
    now_s = 0.0
    script = FaultScript(run, cast("Harness", harness), cast("Recorder", recorder), lambda: now_s)
    script.work()
    assert notes == ["stopped"]
    assert child.is_stopped
    now_s += STOPPED_S + 0.01
    script.work()
    assert not child.is_stopped
