"""A MAVLink link over UDP: packets of one system, checked one by one, and packets to it.

A packet counts if its checksum is right, if it is of the expected system, from the address that the
system had first, and, with a key, if its signature is right and newer than all before
(MAVLink 2, "Message signing"). Any other packet changes nothing and is counted.
"""

import hashlib
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE, TransportError

os.environ.setdefault("MAVLINK20", "1")

_MAGIC = 0xFD  # MAVLink 2; packets of version 1 are refused
_HEADER = 10
# Places in the header: length of the payload, incompatible flags, system, and component behind it.
_LENGTH_AT, _FLAGS_AT, _SYSTEM_AT = 1, 2, 5
_SYSTEM_AND_COMPONENT = slice(_SYSTEM_AT, _SYSTEM_AT + 2)
_NUMBERS = 256  # of packets, which count in one byte
_CHECKSUM = 2
_SIGNATURE = 13  # link id 1, timestamp 6, hash 6
_LINK = bytes([0])  # id of this link in its signatures
_TIMESTAMP_BYTES = 6
_HASH = 6
_SIGNED = 0x01  # of the incompatible flags
_KEY_BYTES = 32
_EPOCH_S = 1_420_070_400  # 2015-01-01, from which timestamps count in units of 10 us
_UNITS_PER_S = 100_000
# Age at which the first timestamp of a stream is refused, s, as the standard says.
_OLDEST_FIRST_S = 60
_LARGEST_PACKET = 2048
# Silence after which another address may be the system's, s: an autopilot that has restarted.
_FORGETS_S = 5.0


class LinkError(TransportError):
    """A link that cannot be opened; one line."""

    exit_code = EXIT_USAGE


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address of a link: `udp` listens there, `udpclient` sends there."""

    is_client: bool
    host: str
    port: int

    @staticmethod
    def of(text: str, option: str = "--link") -> "Endpoint":
        """Return the address in a text. Raises: LinkError."""
        kind, _, address = text.partition(":")
        host, _, port = address.rpartition(":")
        if kind not in ("udp", "udpclient") or not host or not port.isdecimal():
            expected = "udp:HOST:PORT to listen there, or udpclient:HOST:PORT"
            remedy = "; mavlink-routerd joins a serial port to one" if kind == "serial" else ""
            raise LinkError(f"{option}: expected {expected}, got {text!r}{remedy}")
        return Endpoint(kind == "udpclient", host, int(port))


def read_key(path: Path) -> bytes:
    """Return the key of a link, 32 bytes as 64 hexadecimal digits in a file. Raises: LinkError."""
    text = path.read_text(encoding="ascii", errors="replace").strip()
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != _KEY_BYTES:
        raise LinkError(f"{path}: expected a key of {2 * _KEY_BYTES} hexadecimal digits")
    return key


def messages() -> Any:
    """Return the module of message classes and constants; its import takes half a second."""
    from pymavlink.dialects.v20 import ardupilotmega

    return ardupilotmega


class Signatures:
    """Signatures of the packets of one link, made and checked with its key."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._newest: dict[bytes, int] = {}  # timestamps by link, system and component
        self._sent = 0

    def signed(self, packet: bytes) -> bytes:
        """Return a packet, made with the flag of signed ones, with its signature."""
        self._sent = max(self._sent + 1, _timestamp())
        signed = packet + _LINK + self._sent.to_bytes(_TIMESTAMP_BYTES, "little")
        return signed + self._hash(signed)

    def accept(self, packet: bytes) -> bool:
        """Return whether a signature is right and newer than those before; only then remember it."""
        if self._hash(packet[:-_HASH]) != packet[-_HASH:]:
            return False
        signature = packet[-_SIGNATURE:]
        stream = signature[: len(_LINK)] + packet[_SYSTEM_AND_COMPONENT]
        stamp = int.from_bytes(signature[len(_LINK) : -_HASH], "little")
        oldest = _timestamp() - _OLDEST_FIRST_S * _UNITS_PER_S
        if stamp <= self._newest.get(stream, oldest):
            return False
        self._newest[stream] = stamp
        return True

    def _hash(self, packet: bytes) -> bytes:
        return hashlib.sha256(self._key + packet).digest()[:_HASH]


class MavlinkLink:
    """One end of a link.

    Args:
        endpoint: Where it listens, or whom it sends to.
        own: System and component of this end.
        other: System of the other end; 0 for any.
        key: Signs all packets, and refuses others; None: no packet is signed.

    Attributes:
        refused: Number of packets that did not count.
        others: Systems whose packets did not count, as they are not the other end.
    """

    def __init__(
        self, endpoint: Endpoint, own: tuple[int, int], other: int, key: bytes | None = None
    ) -> None:
        self._other = other
        self._signatures = None if key is None else Signatures(key)
        self._mav = messages().MAVLink(None, srcSystem=own[0], srcComponent=own[1])
        self._peer: Any = None
        self._heard_s = 0.0  # of the peer
        self.refused = 0
        self.others: set[int] = set()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if endpoint.is_client:
                self._socket.connect((endpoint.host, endpoint.port))
            else:
                self._socket.bind((endpoint.host, endpoint.port))
        except OSError as error:
            self._socket.close()
            problem = f"cannot use {endpoint.host}:{endpoint.port} ({error.strerror})"
            raise LinkError(f"link: {problem}") from error
        self._is_client = endpoint.is_client

    def fileno(self) -> int:
        """Return the number of the socket, to wait for packets."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def receive(self, timeout_s: float) -> list[Any]:
        """Return the messages of the next datagram that count; none after the timeout."""
        self._socket.settimeout(timeout_s)
        try:
            data, address = self._socket.recvfrom(_LARGEST_PACKET)
        except (TimeoutError, BlockingIOError, ConnectionRefusedError):
            return []  # a client hears that its peer is not there yet
        found = []
        for packet in _packets(data):
            message = self._checked(packet, address)
            if message is None:
                self.refused += 1
            else:
                found.append(message)
        return found

    def send(self, message: Any) -> None:
        """Send a message; none before the other end is known."""
        if self._peer is None and not self._is_client:
            return
        self._mav.signing.sign_outgoing = False
        if self._signatures is None:
            packet = bytes(message.pack(self._mav))
        else:
            packet = self._signatures.signed(_flagged(message, self._mav))
        self._mav.seq = (self._mav.seq + 1) % _NUMBERS
        try:
            if self._is_client:
                self._socket.send(packet)
            else:
                self._socket.sendto(packet, self._peer)
        except (BlockingIOError, ConnectionRefusedError, OSError):
            return  # like any packet that is lost

    def _checked(self, packet: bytes, address: Any) -> Any:
        """Return the message in a packet, None if it does not count."""
        is_signed = bool(packet[_FLAGS_AT] & _SIGNED)
        system = packet[_SYSTEM_AT]
        if self._other not in (0, system):
            self.others.add(system)
            return None
        now_s = time.monotonic()
        is_stranger = self._peer not in (None, address) and now_s < self._heard_s + _FORGETS_S
        if is_stranger and not self._is_client:
            return None
        try:
            message = self._mav.decode(bytearray(packet))
        except messages().MAVError:
            return None
        if message.get_type().startswith("UNKNOWN"):
            return None
        if self._signatures is not None and not (is_signed and self._signatures.accept(packet)):
            return None
        self._peer, self._heard_s = address, now_s
        return message


def _packets(data: bytes) -> Iterator[bytes]:
    """Yield the packets of version 2 in a datagram; what is cut off is left out."""
    at = 0
    while at + _HEADER + _CHECKSUM <= len(data):
        if data[at] != _MAGIC:
            at += 1
            continue
        signature = _SIGNATURE if data[at + _FLAGS_AT] & _SIGNED else 0
        end = at + _HEADER + data[at + _LENGTH_AT] + _CHECKSUM + signature
        if end > len(data):
            return
        yield data[at:end]
        at = end


def _flagged(message: Any, mav: Any) -> bytes:
    """Return a packet with the flag of signed ones, and the checksum that belongs to it."""
    packet = bytearray(message.pack(mav))
    packet[_FLAGS_AT] |= _SIGNED
    crc = messages().x25crc(bytes(packet[1:-_CHECKSUM]) + bytes([message.crc_extra])).crc
    packet[-_CHECKSUM:] = crc.to_bytes(_CHECKSUM, "little")
    return bytes(packet)


def _timestamp() -> int:
    """Return the present time in the units of signatures."""
    return int((time.time() - _EPOCH_S) * _UNITS_PER_S)
