"""Frames of MSP: whole, in parts, among garbage, over a link that comes and goes."""

import socket
from collections.abc import Iterator

import pytest

from transport.protocol.network.mavlink import LinkError
from transport.vehicle.msp import MspLink, framed

ANSWER, REFUSAL = b"$M>", b"$M!"
# MSP_API_VERSION as Betaflight 4.6 answers it: protocol 0, API 1.47. The sum is 0x03 ^ 0x01 ^ 0x00 ^ 0x01 ^ 0x2F.
VERSION = bytes.fromhex("244d3e03010001" + "2f" + "2c")


@pytest.fixture
def ends() -> Iterator[tuple[MspLink, socket.socket]]:
    """A link, and the other end of it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = MspLink(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        assert link.receive(0.01) == []
        other, _ = server.accept()
        with other:
            yield link, other
    link.close()


def received(link: MspLink, frames: int) -> list[tuple[int, bytes]]:
    """Wait for a number of answers."""
    got: list[tuple[int, bytes]] = []
    for _ in range(100):
        got += link.receive(0.05)
        if len(got) >= frames:
            break
    return got


def test_a_frame_is_that_of_the_protocol() -> None:
    """Length, command, payload and their exclusive or, as Betaflight sends them."""
    assert framed(ANSWER, 1, bytes([0, 1, 0x2F])) == VERSION


def test_frames_arrive_whole_in_parts_and_among_garbage(
    ends: tuple[MspLink, socket.socket],
) -> None:
    """Only answers with the right sum count; a refusal, a broken frame and noise are left out."""
    link, other = ends
    one, two = framed(ANSWER, 102, bytes(18)), framed(ANSWER, 150, b"$M>ab")
    broken = bytearray(one)
    broken[8] ^= 0x10
    other.sendall(b"noise" + one + framed(REFUSAL, 101, b"") + bytes(broken) + two[:4])
    assert received(link, 1) == [(102, bytes(18))]
    other.sendall(two[4:])
    assert received(link, 1) == [(150, b"$M>ab")]
    assert link.refused > 0


def test_requests_arrive(ends: tuple[MspLink, socket.socket]) -> None:
    """A request has the mark to the flight controller."""
    link, other = ends
    link.send(200, b"\xdc\x05")
    assert other.recv(100) == framed(b"$M<", 200, b"\xdc\x05")


def test_a_link_comes_back() -> None:
    """A flight controller that is not there loses what is sent; one that has restarted is heard again."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        link = MspLink(f"tcp:127.0.0.1:{port}")
        link.send(101)
        link.receive(0.01)
        server.accept()[0].close()
        assert link.receive(0.5) == []  # the end of the first connection
        link.receive(0.01)
        other, _ = server.accept()
        other.sendall(VERSION)
        assert received(link, 1) == [(1, VERSION[5:-1])]
        other.close()
    link.close()


@pytest.mark.parametrize("endpoint", ["udp:127.0.0.1:1", "tcp:127.0.0.1", "serial:", "tcp::x"])
def test_other_endpoints_are_refused(endpoint: str) -> None:
    """The error names the option, what is expected and what came."""
    with pytest.raises(LinkError, match="--link: expected tcp:HOST:PORT, or serial:DEVICE, got"):
        MspLink(endpoint)
