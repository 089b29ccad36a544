"""The recorder: what it tells of the run, and when it ends, as its connection comes and goes."""

from collections.abc import Callable, Iterable
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
from transport.protocol.admission.acceptance_and_refusals import Sample
from transport.protocol.network.bus_events import Arrival
from transport.protocol.wire.codec import encode, header_of
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Control, FaultNote, Message, Presence

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
        self.timeouts_s: list[float | None] = []  # of all waits

    def announce(self) -> None:
        """Show nothing: no process waits."""

    def join(self, *_: object) -> None:
        """All processes have joined."""

    def next(self, timeout_s: float | None) -> Arrival | None:
        """Return the next event, or None when the time is up before."""
        self.timeouts_s.append(timeout_s)
        for event in self._events:
            if isinstance(event, Presence):
                self.alive = {name: 0 for name in self.alive if name != event.name}
                self.alive |= {event.name: 0} if event.alive else {}
            if event is not SILENCE or timeout_s is not None:
                return None if event is None else Arrival(event, 0)
        return None

    def close(self) -> None:
        """Nothing to close."""


def recorder_of(folder: Path, bus: Any, say: Callable[[str], None] = lambda _: None) -> Recorder:
    """Return the recorder of the run over a connection, with a log in a folder."""
    header = with_scenario(HEADER, RUN)
    writer = LogWriter(folder / "run.mcap", header, period_ns=RUN.period_ns)
    place = runs.place(RUN.scenario.name)
    return Recorder(RUN, place, writer, say, bus_of=lambda *_args, **_options: bus)


def recorded(folder: Path, bus: ScriptedBus) -> list[Message]:
    """Return the messages in the log of a recorder that receives the events of a connection."""
    recorder = recorder_of(folder, bus)
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    assert recorder.error is None
    return [entry.message for entry in read_log(folder / "run.mcap").messages]


@pytest.fixture
def flight() -> list[Event]:
    """Return the messages of coordinator and plant in a completed run of six ticks."""
    messages: list[Event] = [runs.roster()]
    for k in range(6):
        messages += [replace(runs.tick(k), sequence=k + 1), runs.plant_state(RUN, k)]
    return [*messages, replace(runs.end(5), sequence=7)]


def test_processes_that_were_unreachable_return(tmp_path: Path, flight: list[Event]) -> None:
    """Recording goes on when all processes reconnect after a pause that closed their connections."""
    messages = recorded(
        tmp_path, ScriptedBus([*flight[:5], *GONE, *BACK, SILENCE, *flight[5:], *reversed(GONE)])
    )
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight if isinstance(message, Message)
    ]


def test_a_coordinator_that_stays_away_ends_the_record(tmp_path: Path, flight: list[Event]) -> None:
    """Without it the recorder writes the end of the run, and nothing that comes later."""
    *messages, end = recorded(
        tmp_path, ScriptedBus([*flight[:5], *GONE, SILENCE, *flight[5:], *reversed(GONE)])
    )
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight[:5] if isinstance(message, Message)
    ]
    assert isinstance(end, Control)
    assert (end.outcome, end.reason) == ("aborted", "coordinator is gone")


def test_it_waits_for_the_last_messages_of_the_processes_that_are_there(
    tmp_path: Path, flight: list[Event]
) -> None:
    """2 s after the end of the run for a process with a token; once all tokens are gone 0.05 s."""
    bus = ScriptedBus([*flight, *reversed(GONE)])
    recorded(tmp_path, bus)
    assert bus.timeouts_s[-3:] == [2.0, 2.0, 0.05]


KEYS = Keys(RUN.scenario.name)
NOT_A_MESSAGE = b"\x00"


def sample(message: Message, *, key: str = "", data: bytes = b"") -> Sample:
    """Return a message as it comes from the network, perhaps under another key or garbled."""
    whole = encode(message)
    return Sample(
        f"{KEYS.prefix}/{key}" if key else KEYS.of(message), data or whole, header_of(whole)
    )


def test_progress_is_that_of_the_newest_genuine_message(tmp_path: Path) -> None:
    """Late messages, ticks beyond the run and kinds under a foreign key are recorded, and are no progress."""
    recorder = recorder_of(tmp_path, ScriptedBus([]))
    first, third = runs.plant_state(RUN, 0), runs.plant_state(RUN, 3)
    beyond = replace(runs.tick(1), tick=RUN.ticks)
    rows = [
        (sample(runs.tick(3)), 3, None),
        (sample(runs.tick(2)), 3, None),
        (sample(beyond), 3, None),
        (sample(runs.tick(9), key="plant_state"), 3, None),
        (sample(first, key="tick"), 3, None),
        (sample(first), 3, 0),
        (sample(third), 3, 3),
        (sample(runs.plant_state(RUN, 4), data=NOT_A_MESSAGE), 3, 3),
        (sample(runs.tick(39)), 39, 3),
    ]
    for event, tick, state_tick in rows:
        recorder.receive(event)
        state = recorder.plant_state
        assert (recorder.tick, state and state.tick) == (tick, state_tick)
        assert (recorder.started_s is None) == (state_tick is None)
    assert recorder.received == len(rows)
    recorder.close()


def test_roster_and_faults_are_told(tmp_path: Path) -> None:
    """The first roster is no news; a fault without a tick is noted at the newest one, 0 before the first."""
    told: list[str] = []
    recorder = recorder_of(tmp_path, ScriptedBus([]), told.append)
    recorder.note("agent1", "stopped", "person")
    recorder.receive(runs.roster())
    assert recorder.members == {"agent1", "agent2", "agent3", "agent4"}
    recorder.receive(replace(runs.roster({1: 1, 2: 1}, k=4, version=2), reason="gone"))
    assert recorder.members == {"agent1", "agent2"}
    recorder.receive(sample(runs.tick(7)))
    recorder.note("agent2", "killed", "person")
    recorder.note("agent2", "killed", "script", 5)
    recorder.close()

    assert told == ["fault: agent1 stopped", "roster: gone", *["fault: agent2 killed"] * 2]
    notes = read_log(tmp_path / "run.mcap").of(FaultNote)
    assert [note.tick for note in notes] == [0, 7, 5]
