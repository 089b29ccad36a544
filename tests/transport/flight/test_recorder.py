"""The recorder: when it goes on and when it ends, as its connection to the run comes and goes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.logs import HEADER, with_scenario
from tests.support.runs import setup
from transport.flight.recorder import Recorder
from transport.log.run_log import read_log
from transport.log.writer import LogWriter
from transport.protocol.network.bus_events import Arrival
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Control, Message, Presence

RUN = setup("controller.horizon=5", runs.ticks(40))
PROCESSES = ["coordinator", "plant"]
GONE = [Presence(name, 0, alive=False) for name in PROCESSES]
BACK = [Presence(name, 0, alive=True) for name in PROCESSES]
# A pause longer than any timeout of the recorder.
SILENCE = None

Event = Message | Presence | None


class ScriptedBus:
    """Connection that hands over prepared events in place of the network."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._events = iter(events)
        self.alive = dict.fromkeys(PROCESSES, 0)

    def announce(self) -> None:
        """Show nothing: no process waits."""

    def join(self, *_: object) -> None:
        """All processes have joined."""

    def next(self, timeout_s: float | None) -> Arrival | None:
        """Return the next event, or None when the time is up before."""
        for event in self._events:
            if isinstance(event, Presence):
                self.alive = {name: 0 for name in self.alive if name != event.name}
                self.alive |= {event.name: 0} if event.alive else {}
            if event is not SILENCE or timeout_s is not None:
                return None if event is None else Arrival(event, 0)
        return None

    def close(self) -> None:
        """Nothing to close."""


def recorded(folder: Path, events: list[Event]) -> list[Message]:
    """Return the messages in the log of a recorder that receives some events, then the processes' ends."""
    bus: Any = ScriptedBus([*events, *reversed(GONE)])
    path = folder / "run.mcap"
    writer = LogWriter(path, with_scenario(HEADER, RUN), period_ns=RUN.period_ns)
    recorder = Recorder(
        RUN, runs.place(RUN.scenario.name), writer, bus_of=lambda *_args, **_options: bus
    )
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    assert recorder.error is None
    return [entry.message for entry in read_log(path).messages]


@pytest.fixture
def flight() -> list[Event]:
    """Return the messages of coordinator and plant in a completed run of six ticks."""
    messages: list[Event] = [runs.roster()]
    for k in range(6):
        messages += [replace(runs.tick(k), sequence=k + 1), runs.plant_state(RUN, k)]
    return [*messages, replace(runs.end(5), sequence=7)]


def test_processes_that_were_unreachable_return(tmp_path: Path, flight: list[Event]) -> None:
    """Recording goes on when all processes reconnect after a pause that closed their connections."""
    messages = recorded(tmp_path, [*flight[:5], *GONE, *BACK, SILENCE, *flight[5:]])
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight if isinstance(message, Message)
    ]


def test_a_coordinator_that_stays_away_ends_the_record(tmp_path: Path, flight: list[Event]) -> None:
    """Without it the recorder writes the end of the run, and nothing that comes later."""
    *messages, end = recorded(tmp_path, [*flight[:5], *GONE, SILENCE, *flight[5:]])
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight[:5] if isinstance(message, Message)
    ]
    assert isinstance(end, Control)
    assert (end.outcome, end.reason) == ("aborted", "coordinator is gone")
