"""The recorder: what it lets into the log, and what it says of the rest."""

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from protocol.admission.gate import Gate, Sample
from protocol.network.bus import BusEvent
from protocol.network.endpoints import Endpoints
from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Bundle, Control, LinkChange, Measurement, Message, Presence, Record, Rejected, Relay
from protocol.wire.node import Outbox
from tests.support import runs
from tests.support.logs import HEADER, with_scenario
from tests.support.messages import sample
from tests.support.runs import setup
from transport.flight import recorder as recorder_module
from transport.flight.recorder import Recorder
from transport.log.run_log import read_log
from transport.log.writer import LogWriter

RUN = setup("controller.horizon=5", runs.ticks(40))
KEYS = Keys(RUN.scenario.name)
PROCESSES = ["coordinator", "plant"]


class ScriptedBus:
    """In the place of the network: hands over, through the gate, what a test has prepared."""

    # None: nothing comes for a long time; a function is called in its turn.
    script: tuple[tuple[str, bytes] | Presence | Callable[[], None] | None, ...] = ()
    arrived_ns = 0

    def __init__(self, *, gate: Gate, **_: object) -> None:
        self._gate, self._left = gate, deque(self.script)
        self.peers = SimpleNamespace()

    def join(self, *_: object) -> None:
        """All processes have joined."""

    def next(self, timeout_s: float | None) -> BusEvent | None:
        """The next event that gets through, or None when the time is up before."""
        while self._left:
            item = self._left.popleft()
            if item is None:
                if timeout_s is not None:
                    return None
                continue
            if callable(item):
                item()
                continue
            if isinstance(item, Presence):
                return item
            for message in self._gate.accept(*item):
                return message
        return None

    def close(self) -> None:
        """Nothing to close."""


Recording = Callable[..., list[Message]]


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """Records what a test says, to the end of the processes, and returns the log."""
    monkeypatch.setattr(recorder_module, "Bus", ScriptedBus)

    def recorded(
        *said: Message | tuple[str, bytes] | Presence | Callable[[], None] | None, run: Setup = RUN
    ) -> list[Message]:
        script = [(KEYS.of(item), encode(item)) if isinstance(item, Message) else item for item in said]
        gone = [Presence(name, 0, alive=False) for name in reversed(PROCESSES)]
        monkeypatch.setattr(ScriptedBus, "script", (*script, *gone))
        path = tmp_path / "run.mcap"
        writer = LogWriter(path, with_scenario(HEADER, run), period_ns=run.period_ns)
        recorder = Recorder(run, KEYS.run, writer, Endpoints(listen=[], connect=[]), 1.0)
        recorder.start(PROCESSES)
        recorder.join()
        recorder.close()
        assert recorder.error is None
        log = read_log(path)
        assert log.cut == ""
        return [entry.message for entry in log.messages]

    return recorded


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """Return a recorder without a network, which has not begun."""
    monkeypatch.setattr(recorder_module, "Bus", ScriptedBus)
    writer = LogWriter(tmp_path / "run.mcap", with_scenario(HEADER, RUN), period_ns=RUN.period_ns)
    return Recorder(RUN, KEYS.run, writer, Endpoints(listen=[], connect=[]), 1.0)


def flight(ticks: int) -> list[Message]:
    """Return the messages of coordinator and plant in a completed run of some ticks."""
    said: list[Message] = [runs.roster()]
    for k in range(ticks):
        said += [replace(runs.tick(k), sequence=k + 1), runs.plant_state(RUN, k)]
    return [*said, replace(runs.end(ticks - 1), sequence=ticks + 1)]


def changed(message: Message, **changes: Any) -> Message:
    """Return a changed message with its own sequence number."""
    return replace(message, **{"sequence": 10**6, **changes})


def test_processes_that_were_unreachable_return(record: Recording) -> None:
    """Recording goes on when all processes reconnect after a pause that closed their connections."""
    said = flight(6)
    gone, back = ([Presence(name, 0, alive=alive) for name in PROCESSES] for alive in (False, True))
    found = record(*said[:5], *gone, *back, None, *said[5:])
    assert [encode(message) for message in found] == [encode(message) for message in said]
    *heard, end = record(*said[:5], *gone, None, *said[5:])
    assert [encode(message) for message in heard] == [encode(message) for message in said[:5]]
    assert isinstance(end, Control)
    assert (end.outcome, end.reason) == ("aborted", "coordinator is gone")


def test_a_pause_is_used_to_write(record: Recording, tmp_path: Path) -> None:
    """After a pause without messages all earlier ones are in the file for readers, and recording goes on."""
    said, seen = flight(5), []

    def look() -> None:
        seen.append(len(read_log(tmp_path / "run.mcap").messages))

    messages = record(*said[:4], look, None, look, *said[4:])
    assert seen == [0, 4]
    assert [encode(message) for message in messages] == [encode(message) for message in said]


def test_a_note_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault note after a failure of the log raises no error; the recorder keeps the reason of the failure."""
    monkeypatch.setattr(recorder_module, "Bus", ScriptedBus)
    writer = LogWriter(tmp_path / "run.mcap", HEADER, period_ns=RUN.period_ns)
    recorder = Recorder(RUN, KEYS.run, writer, Endpoints(listen=[], connect=[]), 1.0)
    writer.close()
    recorder.note("agent1", "killed", "person")
    assert recorder.error is not None
    assert "the log is closed" in recorder.error
    assert recorder.received == 0


def test_refusals_are_on_record(record: Recording) -> None:
    """The recorder logs its own rejections, but not the refused messages."""
    said = flight(30)
    wrong = [
        (f"{KEYS.prefix}/plan/2", b"nonsense"),
        changed(runs.end(), tick=29),  # far from the newest tick
        changed(runs.plant_state(RUN, 9), x=RUN.initial_state()[:24], u=RUN.hover.u[:4], plan_ticks=(9,)),
        changed(sample(LinkChange), incarnation=0, tick=10, settings='{"loss": 7}'),
        said[3],
    ]
    messages = record(*said[:20], *wrong, *said[20:])
    notices = [message for message in messages if isinstance(message, Rejected)]
    assert [encode(m) for m in messages if not isinstance(m, Rejected)] == [encode(message) for message in said]
    assert {notice.sender for notice in notices} == {"recorder"}
    assert {(notice.offender, notice.reason) for notice in notices} == {
        ("plan/2", "wrong_version"),
        ("coordinator", "future"),
        ("plant", "wrong_shape"),
        ("coordinator", "out_of_range"),
        ("coordinator", "replayed"),
    }
    assert [notice.count for notice in notices] == [1] * len(wrong)


def test_the_end_is_believed_when_it_comes(record: Recording) -> None:
    """An end message that overtakes the last ticks ends the recording."""
    said = flight(12)
    messages = record(*said[:15], said[-1])
    assert encode(messages[-1]) == encode(said[-1])


def test_progress_follows_headers(recorder: Recorder) -> None:
    """Tick, begin and newest state follow bundles and messages; old, garbled and absurd ones do not mislead."""
    coordinator, plant = Outbox("coordinator", 0), Outbox("plant", 0)

    def hear(out: Outbox, kind: type[Bundle], tick: int, *parts: Message, cut: int = 0) -> None:
        keys, encoded = tuple(KEYS.end(KEYS.of(part)) for part in parts), tuple(map(encode, parts))
        message = out.stamp(kind, tick=tick, keys=keys, parts=encoded)
        data = encode(message)
        for taken in recorder.gate.accept(KEYS.of(message), data[: len(data) - cut]):
            assert isinstance(taken, Sample)
            recorder.receive(taken)

    hear(coordinator, Relay, 0, runs.tick(0))
    hear(plant, Record, 0, sample(Measurement))
    assert (recorder.tick, recorder.started_s, recorder.plant_state) == (0, None, None)
    hear(coordinator, Relay, 1, runs.tick(1))
    hear(plant, Record, 1, runs.plant_state(RUN, 0), sample(Measurement))
    assert recorder.started_s is not None
    for tick in (0, 10**6):  # past, beyond the end of the run
        hear(coordinator, Relay, tick, runs.tick(tick))
    hear(plant, Record, 2, runs.plant_state(RUN, 1), cut=100)
    hear(plant, Record, 2, replace(runs.plant_state(RUN, 1), plan_ticks=(0,), x=np.zeros(24), u=np.zeros(4)))
    assert recorder.tick == 1
    assert recorder.plant_state is not None
    assert encode(recorder.plant_state) == encode(runs.plant_state(RUN, 0))
    assert recorder.received == 7
    recorder.close()
    assert recorder.error is None


def test_each_notice_is_handed_over_once(recorder: Recorder) -> None:
    """A notice that comes while earlier ones are shown is among them or among the next."""

    def fail() -> None:
        for i in range(1000):
            recorder.note("agent1", str(i), "unknown")

    notes = threading.Thread(target=fail)
    notes.start()
    shown: list[str] = []
    while notes.is_alive():
        shown += recorder.new_notices()
    shown += recorder.new_notices()
    assert shown == [f"fault: agent1 {i}" for i in range(1000)]
    recorder.close()
