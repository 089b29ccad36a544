"""The log goes on in a second place when its file is removed, cut or full, and loses nothing that can be read."""

import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from protocol.wire.codec import encode
from protocol.wire.messages import Message
from tests.support import runs
from tests.support.logs import HEADER
from tests.support.runs import setup
from transport.flight.memory import simulate
from transport.log.log_file import CHUNK_BYTES
from transport.log.relocating_file import RelocatingFile
from transport.log.run_log import LogWriter, read_log

PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def flight() -> list[Message]:
    """Return the messages of a run, several chunks long."""
    messages: list[Message] = []
    simulate(setup("controller.horizon=5", runs.ticks(40)), record=messages.append)
    assert sum(len(encode(message)) for message in messages) > 2 * CHUNK_BYTES
    return messages


class Place:
    """A log in one folder with a second place in another, and what was said of it."""

    def __init__(self, folder: Path) -> None:
        self.first, self.second = folder / "run" / "run.mcap", folder / "second" / "run.mcap"
        self.said: list[str] = []
        self.first.parent.mkdir()
        self.file = RelocatingFile(self.first, HEADER, self._second, self.said.append)
        self.writer = LogWriter(self.file, HEADER, period_ns=PERIOD_NS)

    def _second(self) -> Path:
        self.second.parent.mkdir()
        return self.second

    def write(self, messages: list[Message]) -> None:
        """Write messages, as if each had arrived at its number."""
        for message in messages:
            self.writer.write(message, message.sequence)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    """Return an open log."""
    return Place(tmp_path)


def bits(path: Path) -> list[bytes]:
    """Return the messages of a log as they were encoded."""
    log = read_log(path)
    assert not log.cut
    return [encode(entry.message) for entry in log.messages]


def _remove_folder(place: Place) -> None:
    place.first.unlink()
    place.first.parent.rmdir()


def _replace(place: Place) -> None:
    other = place.first.with_name("other")
    other.write_bytes(b"other")
    other.replace(place.first)


DAMAGES: dict[str, Callable[[Place], None]] = {
    "removed": lambda place: place.first.unlink(),
    "folder removed": _remove_folder,
    "replaced": _replace,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
@pytest.mark.parametrize("share", [0.0, 0.3, 0.999, 1.0])
def test_the_second_file_is_the_whole_log(
    damage: Callable[[Place], None], share: float, place: Place, flight: list[Message]
) -> None:
    """Whenever the name of the file goes, the second place has every message once and in order, bit for bit."""
    before = round(share * len(flight))
    place.write(flight[:before])
    damage(place)
    place.write(flight[before:])
    place.writer.close()
    assert place.file.path == place.second
    assert bits(place.second) == [encode(message) for message in flight]
    reason = f"{place.first}: cannot write the log (the file was removed)"
    assert place.said == [f"{reason}; recording continues in {place.second}"]


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_cut_file_loses_what_was_cut(share: float, place: Place, flight: list[Message]) -> None:
    """The second place has what is left of the first, and everything from the unfinished chunk on."""
    half = len(flight) // 2
    place.write(flight[:half])
    pending = len(place.file.pending)
    os.truncate(place.first, int(share * place.first.stat().st_size))
    place.write(flight[half:])
    place.writer.close()
    found = bits(place.second)
    said = [encode(message) for message in flight]
    assert pending > 1
    assert set(found) <= set(said)
    assert found[-len(flight[half:]) :] == said[half:]
    assert "the file was cut" in place.said[0]


def test_an_undisturbed_log_stays(place: Place, flight: list[Message]) -> None:
    """Without a failure there is no second place, and the file equals that of a plain writer byte for byte."""
    place.write(flight)
    place.writer.close()
    place.writer.close()
    assert place.file.path == place.first
    assert (place.said, place.second.parent.exists()) == ([], False)
    plain = place.first.with_name("plain.mcap")
    with LogWriter(plain, HEADER, period_ns=PERIOD_NS) as writer:
        for message in flight:
            writer.write(message, message.sequence)
    assert place.first.read_bytes() == plain.read_bytes()


def test_two_full_places(place: Place, flight: list[Message]) -> None:
    """When the second place is full too, messages are dropped without an error; what was written can be read."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (CHUNK_BYTES, limits[1]))
    try:
        place.write(flight)
        place.writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (
        place.file.lost
        == (f"{place.first}: cannot write the log (File too large), nor continue in {place.second} (File too large)")
        or place.file.lost == f"{place.second}: cannot write the log (File too large)"
    )
    assert place.said[-1] == f"{place.file.lost}: the run continues without recording"
    assert place.writer.is_up_to_date
    readable = [encode(entry.message) for entry in read_log(place.first).messages]
    assert readable
    assert readable == [encode(message) for message in flight[: len(readable)]]


def test_no_second_place(tmp_path: Path, flight: list[Message]) -> None:
    """A second place that cannot be made is named with its reason."""

    def nowhere() -> Path:
        raise PermissionError(13, "Permission denied")

    said: list[str] = []
    path = tmp_path / "run.mcap"
    file = RelocatingFile(path, HEADER, nowhere, said.append)
    writer = LogWriter(file, HEADER, period_ns=PERIOD_NS)
    path.unlink()
    for message in flight:
        writer.write(message, 0)
    writer.close()
    assert said == [
        f"{path}: cannot write the log (the file was removed), nor continue in a second place (Permission denied): "
        "the run continues without recording"
    ]
