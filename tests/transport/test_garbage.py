"""Bad messages in the middle of a flight: dropped, counted, and without any effect on it."""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from protocol.network.endpoints import Endpoints
from protocol.scenario.setup import Setup
from protocol.wire import codec
from protocol.wire.codec import decode, encode
from protocol.wire.errors import MessageError, Reason
from protocol.wire.messages import Bundle, Message, Rejected
from tests.support import runs
from tests.support.garbage import Garbage
from tests.support.logs import HEADER, with_scenario
from tests.support.runs import reproducible, setup
from tests.support.wire import Wire, without_network
from transport.analysis.metrics import summarise
from transport.flight.recorder import Recorder
from transport.log.run_log import read_log
from transport.log.writer import LogWriter

SEED = 20240611

OTHER = ("clock.actuation=next_tick", "controller.prediction=closed_loop")

# A step of 1 ms.
SETTINGS = ("controller.horizon=5", runs.ticks(60))

# Bad messages before each delivery, and their minimum number in total.
PER_DELIVERY, FEWEST = 16, 10_000

# Memory after thousands of messages: the allocator's reserve and a few hundred examples.
LEFT_BEHIND_BYTES, MOST_BYTES = 20_000, 2_000_000


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a recorder without a network."""
    without_network(monkeypatch)
    monkeypatch.setattr(codec, "MAX_BYTES", 300_000)
    return tmp_path


@contextmanager
def recording(run: Setup, path: Path) -> Iterator[Recorder]:
    """Open a recorder that receives its messages from the test."""
    writer = LogWriter(path, with_scenario(HEADER, run), period_ns=run.period_ns)
    recorder = Recorder(run, run.scenario.name, writer, Endpoints(listen=[], connect=[]), 1.0)
    yield recorder
    recorder.close()
    assert recorder.error is None


def said(messages: Iterable[Message]) -> list[bytes]:
    """Return the encoded messages in order, without wall-clock times."""
    return [encode(reproducible(message)) for message in messages]


def recorded(path: Path) -> list[bytes]:
    """Return the encoded messages of a log, without those about rejections."""
    log = read_log(path)
    assert log.cut == ""
    return said(entry.message for entry in log.messages if not isinstance(entry.message, Rejected))


def is_bundle(data: bytes) -> bool:
    """Return whether bytes can be read as a bundle."""
    try:
        return isinstance(decode(data), Bundle)
    except MessageError:
        return False


class Fire:
    """Sends bad messages to every receiver of a run before each delivery to it.

    Attributes:
        shot: Numbers of bad messages by receiver and sort.
        refused: Numbers of refusals by receiver: one for each bad message, up to one for each message of a bundle.
    """

    def __init__(self, run: Setup, seed: int) -> None:
        self.shot: Counter[tuple[str, str]] = Counter()
        self.refused: Counter[str] = Counter()
        self.sources: dict[str, Garbage] = {}
        self._run, self._seed = run, seed

    def __call__(self, wire: Wire, name: str, key: str, data: bytes) -> None:
        """Disturb a receiver; each bad message is refused and counted at once, or in the log."""
        receiver = wire.receivers[name]
        if name not in self.sources:
            rng = np.random.default_rng([self._seed, len(self.sources)])
            self.sources[name] = Garbage(name, wire.keys, self._run, rng)
        self.sources[name].heard(key, data)
        for _ in range(PER_DELIVERY):
            sort, wrong_key, wrong = self.sources[name].next()
            before = receiver.gate.rejections.total
            answers = wire.disturb(name, wrong_key, wrong)
            counted = receiver.gate.rejections.total - before
            assert list(answers) == [], (name, sort, wrong_key, wrong)
            # What the recorder writes as it came is refused by readers of the log.
            uncounted = counted >= 0 and (name == "recorder" or is_bundle(wrong))
            assert counted == 1 or uncounted, (name, sort, counted, wrong_key, wrong)
            self.shot[name, sort] += 1
            self.refused[name] += counted


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(), OTHER], ids=["open loop", "closed loop"])
def test_a_flight_under_fire(folder: Path, settings: tuple[str, ...]) -> None:
    """More than ten thousand bad messages to all receivers change no bit of a run or of its log; each is counted once.

    With relayed plans some are bundles, and others come in bundles: each message of a bundle is counted.
    """
    run = setup(*SETTINGS, *settings)
    with recording(run, folder / "calm.mcap") as witness:
        calm = Wire(run, witness)
        assert calm.simulate().outcome == "completed"
    assert sum(receiver.gate.rejections.total for receiver in calm.receivers.values()) == 0

    fire = Fire(run, SEED)
    with recording(run, folder / "disturbed.mcap") as witness:
        wire = Wire(run, witness, fire)
        assert wire.simulate().outcome == "completed"
        wire.tell_rejected()
    assert said(wire.sent) == said(calm.sent)
    assert recorded(folder / "disturbed.mcap") == recorded(folder / "calm.mcap") != []

    assert fire.shot.total() > FEWEST
    assert set(fire.shot) == {(name, sort) for name in wire.receivers for sort in fire.sources[name].sorts}
    for name, receiver in wire.receivers.items():
        if name == "recorder":
            continue
        entries = list(receiver.gate.rejections)
        assert sum(entry.count for entry in entries) == receiver.gate.rejections.total == fire.refused[name]
    reasons = {entry.reason for receiver in wire.receivers.values() for entry in receiver.gate.rejections}
    assert reasons == set(get_args(Reason))

    summary = summarise(run, read_log(folder / "disturbed.mcap"))
    counts: Counter[str] = Counter()
    for entry in summary["rejections"]:
        counts[entry["by"]] += entry["count"]
    # Readers of the log count what the recorder wrote as it came.
    shot, counted = sum(count for (at, _), count in fire.shot.items() if at == "recorder"), counts.pop("recorder")
    assert counted > 0.5 * shot if run.shape.relayed else counted == shot  # bundles count by their messages
    assert counts == {name: fire.refused[name] for name in wire.receivers if name != "recorder"}
