"""The log: messages read back bit for bit, after any cut or damage, also by other programs."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace

from tests.support import runs
from tests.support.logs import log_of
from transport.log.run_log import (
    LogError,
    LogTail,
    RunLog,
    channel_of,
    read_log,
    setup_in,
    topic_of,
)
from transport.log.writer import CHUNK_BYTES, LogWriter
from transport.protocol.wire.codec import VERSION, encode
from transport.protocol.wire.messages import (
    FaultNote,
    LinkChange,
    Message,
    Plan,
    PlantState,
    Rejected,
    Roster,
    Tick,
)

HEADER = {"run_id": "r1", "scenario": "name = 'x'\n", "versions": "python 3.12", "note": "Ω0"}
RECEIVED_NS = 1_700_000_000_000_000_000


def write(path: Path, messages: Sequence[Message], period_ns: int = 50_000_000) -> Path:
    """Write a finished log of messages received 1 us apart."""
    with closing(LogWriter(path, HEADER, period_ns=period_ns)) as writer:
        for number, message in enumerate(messages):
            writer.write(message, RECEIVED_NS + 1000 * number)
    return path


def bits(messages: Sequence[Message]) -> list[bytes]:
    """Return the messages as encoded for the network."""
    return [encode(message) for message in messages]


def read_bits(log: RunLog) -> list[bytes]:
    """Return the messages of a log as encoded for the network."""
    return bits([entry.message for entry in log.messages])


@pytest.fixture(scope="module")
def flight() -> list[Message]:
    """Every message of 32 ticks of the paper's scenario with a step in the reference."""
    phase = "{name='climb',duration_s=1.6,displacement_m=[0.1,0.0,-0.2]}"
    return runs.recorded(runs.setup(f"maneuver.phase=[{phase}]", "maneuver.profile=step"))


@pytest.fixture(scope="module")
def whole(flight: list[Message], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of the finished log of that run: several chunks."""
    return write(tmp_path_factory.mktemp("log") / "run.mcap", flight).read_bytes()


def test_a_flight_comes_back_bit_for_bit(tmp_path: Path, flight: list[Message]) -> None:
    """A written run reads back in order, bit for bit, with header and arrival times, and as whole."""
    log = read_log(write(tmp_path / "run.mcap", flight))
    assert read_bits(log) == bits(flight)
    assert [entry.received_ns for entry in log.messages] == [
        RECEIVED_NS + 1000 * n for n in range(len(flight))
    ]
    assert log.header == HEADER
    assert log.cut == ""


def test_other_programs_read_it(tmp_path: Path, flight: list[Message]) -> None:
    """The reader of the mcap package finds channels, bytes, scenario time and sequence numbers."""
    path = write(tmp_path / "run.mcap", flight)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        per_agent = {
            f"/{kind}/{agent}"
            for kind in ("measurement", "plan", "report")
            for agent in runs.setup().agents
        }
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == {"/tick", "/roster", "/control", "/plant_state"} | per_agent
        in_file = [entry for _, channel, entry in reader.iter_messages(log_time_order=False)]
        assert [entry.data for entry in in_file] == bits(flight)
        assert [entry.sequence for entry in in_file] == [message.sequence for message in flight]
        assert [entry.log_time for entry in in_file] == [
            message.tick * 50_000_000 for message in flight
        ]
        assert [metadata.name for metadata in reader.iter_metadata()] == ["run"]


def test_a_cut_log_gives_what_is_whole(tmp_path: Path, whole: bytes, flight: list[Message]) -> None:
    """A log cut at any byte reads as a beginning of the run with a notice, and never raises."""
    expected, path = bits(flight), tmp_path / "cut.mcap"
    offsets = {0, 1, 7, 8, 9, 40, len(whole) - 1, len(whole) - 8}
    offsets |= set(np.random.default_rng(1).integers(0, len(whole), 80).tolist())
    counts = []
    for offset in sorted(offsets):
        path.write_bytes(whole[:offset])
        log = read_log(path)
        found = read_bits(log)
        assert found == expected[: len(found)]
        assert log.header in (HEADER, {})
        assert log.cut.startswith("the log is incomplete")
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(flight)


def test_damage_never_invents_a_message(
    tmp_path: Path, whole: bytes, flight: list[Message]
) -> None:
    """With any byte changed, every message read was written, in order, and missing ones are reported."""
    rng, path, expected = np.random.default_rng(2), tmp_path / "damaged.mcap", bits(flight)
    for offset in rng.integers(8, len(whole), 60).tolist():
        data = bytearray(whole)
        data[offset] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        log = read_log(path)
        rest = iter(expected)
        assert all(message in rest for message in read_bits(log))
        assert log.cut or len(log.messages) == len(expected)


def test_a_killed_recorder_loses_a_chunk_at_most(tmp_path: Path, flight: list[Message]) -> None:
    """After SIGKILL in the middle of a run the file lacks at most the unfinished chunk."""
    path, list_path = tmp_path / "run.mcap", tmp_path / "messages"
    list_path.write_bytes(b"".join(len(data).to_bytes(4, "little") + data for data in bits(flight)))
    program = """
import os, signal, sys
from pathlib import Path
from transport.protocol.wire.codec import decode
from transport.log.writer import LogWriter
data, at = Path(sys.argv[2]).read_bytes(), 0
writer = LogWriter(Path(sys.argv[1]), {}, period_ns=50_000_000)
while at < len(data) - 2000:
    size = int.from_bytes(data[at : at + 4], "little")
    writer.write(decode(data[at + 4 : at + 4 + size]), 0)
    at += 4 + size
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = subprocess.run(
        [sys.executable, "-c", program, str(path), str(list_path)],
        cwd=Path(__file__).resolve().parents[3],
        env=os.environ,
        check=False,
        timeout=60,
    )
    assert ended.returncode == -signal.SIGKILL
    log = read_log(path)
    found = read_bits(log)
    assert found == bits(flight)[: len(found)]
    assert log.cut
    lost = flight[len(found) :]
    assert len(found) > len(flight) / 2
    # The writing ended within 2000 bytes of wire format of the end of the flight.
    assert sum(len(encode(message)) for message in lost) < 2 * CHUNK_BYTES


def test_the_end_of_a_run_is_on_disk_at_once(tmp_path: Path, flight: list[Message]) -> None:
    """The outcome of the run can be read before the log is closed."""
    path = tmp_path / "run.mcap"
    writer = LogWriter(path, HEADER, period_ns=50_000_000)
    for message in flight:
        writer.write(message, 0)
    assert read_bits(read_log(path)) == bits(flight)
    writer.close()
    writer.close()


def test_a_chunk_ends_by_its_age_or_with_a_fault(tmp_path: Path) -> None:
    """Live readers wait for a message for little more than 50 ms; a fault is in the file at once."""
    path = tmp_path / "run.mcap"
    readable = []
    fault = FaultNote(
        sender="recorder", incarnation=0, sequence=0, tick=3, target="plant", what="killed",
        origin="person",
    )  # fmt: skip
    ticks = [replace(runs.tick(number), sequence=number) for number in range(4)]
    with closing(LogWriter(path, HEADER, period_ns=50_000_000)) as writer:
        for message, at_ms in zip((*ticks, fault), (0, 49, 51, 90, 91), strict=True):
            writer.write(message, RECEIVED_NS + at_ms * 1_000_000)
            readable.append(len(read_log(path).messages))
    assert readable == [0, 0, 2, 2, 5]


def test_times_in_the_file_are_those_that_a_file_can_have(tmp_path: Path) -> None:
    """Also those of a tick that no run has: before the first, or after the last that 63 bits can hold."""
    ticks = (-1, 0, 2**62)
    path = write(tmp_path / "run.mcap", [replace(tick(), tick=number) for number in ticks])
    with path.open("rb") as stream:
        entries = list(make_reader(stream).iter_messages(log_time_order=False))
    assert [entry.log_time for *_, entry in entries] == [0, 0, 2**63 - 1]


def test_without_horizons_plans_have_their_first_step(
    tmp_path: Path, flight: list[Message]
) -> None:
    """All else is as it was sent; the shape of the sent plans is known."""
    path = write(tmp_path / "run.mcap", flight)
    whole, short = read_log(path), read_log(path, horizons=False)
    assert short.plans_sent == whole.plans_sent
    assert len(short.messages) == len(whole.messages)
    for sent, read in zip(whole.messages, short.messages, strict=True):
        plan = sent.message
        if isinstance(plan, Plan):
            assert len(plan.corrections) > 0 or len(plan.inputs) > 1
            plan = replace(
                plan, inputs=plan.inputs[:1], corrections=plan.corrections[:0], data=plan.data[:0]
            )
        assert encode(read.message) == encode(plan)
        assert read.received_ns == sent.received_ns


def test_the_first_of_a_tick_is_when_it_was_received() -> None:
    """Of several messages of a kind at a tick; other kinds have times of their own."""
    log = log_of([runs.tick(3), runs.tick(3), runs.tick(4), runs.roster(k=3)], [5.0, 6.0, 7.0, 1.0])
    assert log.received_ns(Tick) == {3: 5_000_000, 4: 7_000_000}


def test_other_files_are_refused(tmp_path: Path) -> None:
    """A missing file, another kind of file and another program's MCAP raise a LogError with file and reason."""
    path = tmp_path / "run.mcap"
    with pytest.raises(LogError, match=r"run\.mcap: .*No such file"):
        read_log(path)
    path.write_text("tick,agent\n")
    with pytest.raises(LogError, match=r"run\.mcap: not an MCAP file"):
        read_log(path)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(LogError, match=r"run\.mcap: an MCAP file, but not the log of a run"):
        read_log(path)
    with pytest.raises(LogError, match="cannot write"):
        LogWriter(tmp_path / "nowhere" / "run.mcap", {}, period_ns=1)


def tick() -> Tick:
    """Return a tick message."""
    return runs.tick(3)


HEAD = {"incarnation": 0, "sequence": 0, "tick": 3}


@pytest.mark.parametrize(
    ("message", "channel", "topic"),
    [
        (
            FaultNote(sender="recorder", target="agent1", what="killed", origin="person", **HEAD),
            *("/recorder/fault", "/fault"),
        ),
        (
            Rejected(sender="agent1", offender="agent2", reason="past", count=1, example="", **HEAD),
            *("/rejected/agent1", "/rejected/agent1"),
        ),
        (
            LinkChange(sender="coordinator", number=1, source="", target="", settings="{}", **HEAD),
            *("/roster", "/link"),
        ),
        (runs.plan(runs.setup(), 3, 1), "/plan/3", "/plan/3"),
        (runs.plan(runs.setup(), 3, 1, shared=False), "/unshared/3", "/plan/3"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_messages_of_the_recorder_have_channels_of_their_own(
    message: Message, channel: str, topic: str
) -> None:
    """None of these comes from the network; in exports each kind of message has its own."""
    assert (channel_of(message), topic_of(message)) == (channel, topic)


@pytest.mark.parametrize("scenario", ["", "a = ", f"a = {'[' * 5000}", "name = 'x'"])
def test_a_header_that_is_no_scenario_tells_no_run(scenario: str, tmp_path: Path) -> None:
    """Also one that is nested deeper than any reader goes: messages are read without it."""
    assert setup_in({"scenario": scenario}, tmp_path) is None


def test_a_log_whose_header_is_damaged_is_read(tmp_path: Path, whole: bytes) -> None:
    """It may be that of a run: what can be read is, and the damage is told."""
    data = bytearray(whole)
    key = data.index(b"run_id") - 4  # its length
    data[key : key + 4] = b"\xff" * 4
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    log = read_log(path)
    assert log.header == {}
    assert "damaged parts left out: 1" in log.cut
    assert log.messages


def test_the_newest_entry_is_the_one_of_the_latest_time(tmp_path: Path) -> None:
    """Clocks may be set back in a run."""
    path = tmp_path / "run.mcap"
    with closing(LogWriter(path, HEADER, period_ns=50_000_000)) as writer:
        for number, received_ns in enumerate((5, 9, 7)):
            writer.write(replace(tick(), sequence=number), received_ns)
    tail = LogTail(path)
    assert len(tail.read()) == 3
    assert tail.newest_ns == 9


def test_entries_of_another_version_and_a_missing_index_are_told(
    tmp_path: Path, flight: list[Message]
) -> None:
    """Their number with the first of them, and how far what is readable goes; the messages are read all the same."""
    path = write(tmp_path / "run.mcap", flight[:40])
    whole = path.read_bytes()
    other = f"payload-transport/{VERSION + 1}".encode()
    changed = tmp_path / "changed.mcap"
    with path.open("rb") as stream, changed.open("wb") as file:
        reader = make_reader(stream)
        writer = Writer(file)
        writer.start()
        writer.add_metadata("run", HEADER)
        numbers = {}
        for _, channel, entry in reader.iter_messages(log_time_order=False):
            if channel.topic not in numbers:
                encoding = (
                    other.decode()
                    if channel.topic in ("/roster", "/plant_state")
                    else channel.message_encoding
                )
                numbers[channel.topic] = writer.register_channel(channel.topic, encoding, 0)
            writer.add_message(
                numbers[channel.topic],
                entry.log_time,
                entry.data,
                entry.publish_time,
                entry.sequence,
            )
        writer.finish()  # type: ignore[no-untyped-call]
    log = read_log(changed)
    passed_over = sum(isinstance(message, Roster | PlantState) for message in flight[:40])
    last = max(message.tick for message in flight[:40])
    assert log.cut == (
        f"the log is incomplete ({passed_over} entries are not of this version, the first a channel '/roster' "
        f"with encoding {other.decode()!r}): {40 - passed_over} messages are readable, up to tick {last}"
    )

    path.write_bytes(whole[:-1])
    assert read_log(path).cut == (
        f"the log is incomplete (only its index is missing): 40 messages are readable, up to tick {last}"
    )
    path.write_bytes(whole[:9])
    assert read_log(path).cut == (
        "the log is incomplete (it stops before its end): no messages are readable"
    )
