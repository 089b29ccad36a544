"""The recorder: what it lets into the log, and what it says of the rest."""

from collections import deque
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.logs import HEADER, with_scenario
from tests.support.runs import setup
from transport.flight import recorder as recorder_module
from transport.flight.recorder import Recorder
from transport.log.run_log import read_log
from transport.log.writer import LogWriter
from transport.protocol.admission.gate import Gate
from transport.protocol.network.bus import BusEvent, Place
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.keys import Keys
from transport.protocol.wire.messages import Control, Message, Presence

RUN = setup("controller.horizon=5", runs.ticks(40))
KEYS = Keys(RUN.scenario.name)
PROCESSES = ["coordinator", "plant"]


class ScriptedBus:
    """In the place of the network: hands over, through the gate, what a test has prepared."""

    # None: nothing comes for a long time; a function is called in its turn.
    script: tuple[tuple[str, bytes] | Presence | Callable[[], None] | None, ...] = ()
    arrived_ns = 0

    def __init__(self, _name: str, _place: Place, _digest: str, gate: Gate, **_: object) -> None:
        self._gate, self._left = gate, deque(self.script)
        self.alive = dict.fromkeys(PROCESSES, 0)

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
                self.alive |= {item.name: 0}
                if not item.alive:
                    del self.alive[item.name]
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
        script = [
            (KEYS.of(item), encode(item)) if isinstance(item, Message) else item for item in said
        ]
        gone = [Presence(name, 0, alive=False) for name in reversed(PROCESSES)]
        monkeypatch.setattr(ScriptedBus, "script", (*script, *gone))
        path = tmp_path / "run.mcap"
        writer = LogWriter(path, with_scenario(HEADER, run), period_ns=run.period_ns)
        recorder = Recorder(run, runs.place(KEYS.run), writer, print)
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
    return Recorder(RUN, runs.place(KEYS.run), writer, print)


def flight(ticks: int) -> list[Message]:
    """Return the messages of coordinator and plant in a completed run of some ticks."""
    said: list[Message] = [runs.roster()]
    for k in range(ticks):
        said += [replace(runs.tick(k), sequence=k + 1), runs.plant_state(RUN, k)]
    return [*said, replace(runs.end(ticks - 1), sequence=ticks + 1)]


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
