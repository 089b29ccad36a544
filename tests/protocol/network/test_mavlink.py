"""MAVLink over UDP: which packets count, through real sockets."""

import socket
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from transport.protocol.network import mavlink
from transport.protocol.network.mavlink import (
    Endpoint,
    LinkError,
    MavlinkLink,
    Signatures,
    messages,
    read_key,
)

KEY = bytes(range(32))
WAIT_S = 1.0  # for a packet that comes
SHORT_S = 0.05  # for one that does not


def heartbeat() -> Any:
    """A message of an autopilot."""
    m = messages()
    return m.MAVLink_heartbeat_message(m.MAV_TYPE_QUADROTOR, 3, 0, 4, 4, 3)


def packet(
    system: int, key: bytes | None = None, timestamp: int | None = None, component: int = 1
) -> bytes:
    """Bytes of a heartbeat of a system, as a link sends them."""
    sent: list[bytes] = []
    link = object.__new__(MavlinkLink)
    link._mav = messages().MAVLink(None, srcSystem=system, srcComponent=component)
    link._signatures = None if key is None else Signatures(key)
    if link._signatures is not None and timestamp is not None:
        link._signatures._sent = timestamp
    link._is_client, link._peer = True, None

    class Kept:
        def send(self, data: bytes) -> None:
            sent.append(data)

    link._socket = Kept()  # type: ignore[assignment]
    link.send(heartbeat())
    return sent[0]


@pytest.fixture(params=[None, KEY], ids=["open", "signed"])
def key(request: pytest.FixtureRequest) -> Any:
    """Key of the links of a test, or none."""
    return request.param


@pytest.fixture
def listening(key: bytes | None) -> Iterator[tuple[MavlinkLink, int]]:
    """A link to system 2, and its port."""
    link = MavlinkLink(Endpoint(False, "127.0.0.1", 0), (255, 191), 2, key)
    yield link, link._socket.getsockname()[1]
    link.close()


def sent(data: bytes, port: int, link: MavlinkLink, timeout_s: float) -> list[Any]:
    """The messages of a datagram from a new address that count."""
    with socket.socket(type=socket.SOCK_DGRAM) as stranger:
        stranger.sendto(data, ("127.0.0.1", port))
        return link.receive(timeout_s)


def test_both_ways(key: bytes | None, listening: tuple[MavlinkLink, int]) -> None:
    """Two ends with the same key, or without one, hear each other."""
    link, port = listening
    other = MavlinkLink(Endpoint(True, "127.0.0.1", port), (2, 1), 255, key)
    link.send(heartbeat())  # to no one yet
    other.send(heartbeat())
    assert [message.get_type() for message in link.receive(WAIT_S)] == ["HEARTBEAT"]
    link.send(heartbeat())
    assert [message.get_srcSystem() for message in other.receive(WAIT_S)] == [255]
    assert (link.refused, other.refused) == (0, 0)
    other.close()


def test_another_system_or_garbage_counts_for_nothing(
    key: bytes | None, listening: tuple[MavlinkLink, int]
) -> None:
    """Packets of another system, with a bit changed, cut off, or of random bytes are refused."""
    link, port = listening
    good = packet(2, key)
    wrong = bytearray(good)
    wrong[12] ^= 1
    for data in (packet(3, key), bytes(wrong), good[:-1], b"\xfd" * 40, b""):
        assert sent(data, port, link, WAIT_S) == []
    assert link.refused >= 2
    assert len(sent(good, port, link, WAIT_S)) == 1


@pytest.mark.parametrize("key", [None], ids=["open"])
def test_another_address_counts_for_nothing(listening: tuple[MavlinkLink, int]) -> None:
    """While a system is heard, its packets from another address are refused."""
    link, port = listening
    with socket.socket(type=socket.SOCK_DGRAM) as first:
        first.sendto(packet(2), ("127.0.0.1", port))
        assert len(link.receive(WAIT_S)) == 1
        assert sent(packet(2), port, link, WAIT_S) == []
        first.sendto(packet(2), ("127.0.0.1", port))
        assert len(link.receive(WAIT_S)) == 1
    assert link.refused == 1


@pytest.mark.parametrize("key", [None], ids=["open"])
@pytest.mark.parametrize(("silence_s", "counts"), [(4.9, False), (5.0, True)])
def test_a_silent_system_may_come_back_from_another_address(
    listening: tuple[MavlinkLink, int],
    silence_s: float,
    counts: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An autopilot that has restarted, 5 s after its last packet."""
    link, port = listening
    clock_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock_s[0])
    with socket.socket(type=socket.SOCK_DGRAM) as first:
        for _ in range(2):  # the last packet counts, not the first one
            first.sendto(packet(2), ("127.0.0.1", port))
            assert len(link.receive(WAIT_S)) == 1
            clock_s[0] += 4.0
        clock_s[0] += silence_s - 4.0
        assert len(sent(packet(2), port, link, WAIT_S)) == counts


@pytest.mark.parametrize(("other", "heard"), [(2, [2]), (0, [2, 3])])
def test_a_link_hears_one_system_or_any(other: int, heard: list[int]) -> None:
    """All packets of a datagram are read, behind what is none; those of other systems are told."""
    link = MavlinkLink(Endpoint(False, "127.0.0.1", 0), (255, 191), other)
    port = link._socket.getsockname()[1]
    unknown = bytearray(packet(2))
    unknown[7:10] = (
        b"\xfe\xff\xff"  # a kind of message that no dialect has, whose checksum none can check
    )
    data = b"\x01\x02" + packet(2) + bytes(unknown) + packet(3)
    assert [one.get_srcSystem() for one in sent(data, port, link, WAIT_S)] == heard
    assert link.refused == 1 + 2 - len(heard)
    assert link.others == {2, 3} - set(heard)
    with pytest.raises(LinkError, match=f"link: cannot use 127.0.0.1:{port} "):
        MavlinkLink(Endpoint(False, "127.0.0.1", port), (255, 191), other)
    link.close()


@pytest.mark.parametrize("key", [KEY], ids=["signed"])
def test_a_signature_is_needed(listening: tuple[MavlinkLink, int]) -> None:
    """Without a signature, with one of another key, or repeated, a packet changes nothing.

    Also not the timestamp that later packets have to exceed: a forged one from the future must not
    silence the autopilot.
    """
    link, port = listening
    good = packet(2, KEY)
    far_future = packet(2, bytes(32), timestamp=2**47)
    nearly = good[:-1] + bytes([good[-1] ^ 1])
    for data in (packet(2), far_future, nearly):
        assert sent(data, port, link, WAIT_S) == []
    assert len(sent(good, port, link, WAIT_S)) == 1
    assert sent(good, port, link, WAIT_S) == []
    assert link.refused == 4


def test_packets_are_numbered_in_one_byte(
    key: bytes | None, listening: tuple[MavlinkLink, int]
) -> None:
    """Receivers count lost packets by the numbers, which begin anew after 255."""
    link, port = listening
    other = MavlinkLink(Endpoint(True, "127.0.0.1", port), (2, 1), 255, key)
    numbers = []
    for _ in range(258):
        other.send(heartbeat())
        numbers += [message.get_seq() for message in link.receive(WAIT_S)]
    other.close()
    assert numbers == [*range(256), 0, 1]


NOW_S = datetime(2026, 3, 1, tzinfo=UTC).timestamp()
SINCE_2015_S = NOW_S - datetime(2015, 1, 1, tzinfo=UTC).timestamp()


def test_timestamps_of_signatures_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    """They count 10 us since 2015, and by one at least, also while the clock of the host stands.

    All kinds of messages of a stream are in one order: an earlier one that comes later is refused.
    """
    monkeypatch.setattr(time, "time", lambda: NOW_S)
    sender, receiver, later = Signatures(KEY), Signatures(KEY), Signatures(KEY)
    bare = packet(2)
    of_another_kind = bare[:7] + bytes([bare[7] + 1]) + bare[8:]
    signed = [sender.signed(one) for one in (bare, of_another_kind, bare)]
    stamps = [int.from_bytes(one[-12:-6], "little") for one in signed]
    assert stamps == [int(SINCE_2015_S * 1e5) + number for number in range(3)]
    assert all(map(receiver.accept, signed))
    assert not any(map(receiver.accept, signed))  # each counts once
    assert [later.accept(one) for one in reversed(signed)] == [True, False, False]


@pytest.mark.parametrize(("age_s", "counts"), [(59.0, True), (61.0, False)])
def test_the_first_packet_of_a_stream_is_a_minute_old_at_most(
    age_s: float, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorded stream is not taken for a new one; each system, component and link has its own."""
    monkeypatch.setattr(time, "time", lambda: NOW_S)
    streams = [(0, 2, 1), (0, 3, 1), (0, 2, 2), (1, 2, 1)]
    recorded = []
    for link, system, component in streams:
        monkeypatch.setattr(mavlink, "_LINK", bytes([link]))
        recorded.append(Signatures(KEY).signed(packet(system, component=component)))
    monkeypatch.setattr(time, "time", lambda: NOW_S + age_s)
    receiver = Signatures(KEY)
    assert [receiver.accept(one) for one in recorded] == [counts] * len(streams)


def test_addresses_and_keys_are_checked(tmp_path: Path) -> None:
    """A wrong address or key is told in one line, with what was expected."""
    for text in ("tcp:127.0.0.1:5760", "udp::5760", "udp:127.0.0.1:", "udpclient:5760"):
        with pytest.raises(LinkError, match=rf"--link: expected udp:HOST:PORT .*, got '{text}'$"):
            Endpoint.of(text)
    with pytest.raises(LinkError, match="; mavlink-routerd joins a serial port to one"):
        Endpoint.of("serial:/dev/ttyUSB0:57600")
    assert Endpoint.of("udpclient:10.0.0.2:14550") == Endpoint(True, "10.0.0.2", 14550)
    file = tmp_path / "key"
    file.write_text("12ab")
    with pytest.raises(LinkError, match="expected a key of 64 hexadecimal digits"):
        read_key(file)
    file.write_text(KEY.hex() + "\n")
    assert read_key(file) == KEY
