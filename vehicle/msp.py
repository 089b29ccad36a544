"""MSP, the protocol of Betaflight, over a serial port or TCP: requests to a flight controller, and its answers.

A frame of version 1 is "$M<" to the flight controller, "$M>" from it or "$M!" where it refuses a request; then the
length of the payload, the command, the payload, and the exclusive or of these three. Whatever is no such
frame is left out and counted.
"""

import os
import socket
import termios
import threading
import tty
from collections.abc import Iterator
from select import select

from transport.protocol.network.mavlink import LinkError

_REQUEST, _ANSWER, _REFUSAL = b"$M<", b"$M>", b"$M!"
_BEFORE = 5  # bytes before the payload
_READ = 4096
_BAUD = termios.B115200


class MspLink:
    """One link: `tcp:HOST:PORT`, or `serial:DEVICE` with 115200 baud.

    A flight controller that is not there, or has gone, is tried again at each `receive`.

    Attributes:
        refused: Number of bytes that belong to no frame, and of frames with a wrong sum.
    """

    def __init__(self, endpoint: str) -> None:
        kind, _, self._address = endpoint.partition(":")
        host, _, port = self._address.rpartition(":")
        is_tcp = kind == "tcp" and host and port.isdecimal()
        if not is_tcp and not (kind == "serial" and self._address):
            expected = "tcp:HOST:PORT, or serial:DEVICE"
            raise LinkError(f"--link: expected {expected}, got {endpoint!r}")
        self._tcp = (host, int(port)) if is_tcp else None
        self._descriptor = -1
        self._socket: socket.socket | None = None
        self._received = bytearray()
        self._sending = threading.Lock()
        self.refused = 0

    def close(self) -> None:
        """Close the link."""
        if self._socket is not None:
            self._socket.close()
        elif self._descriptor >= 0:
            os.close(self._descriptor)
        self._socket = None
        self._descriptor = -1

    def send(self, command: int, payload: bytes = b"") -> None:
        """Send a request; it is lost while the flight controller is not there."""
        frame = framed(_REQUEST, command, payload)
        with self._sending:
            if self._descriptor < 0:
                return
            try:
                os.write(self._descriptor, frame)
            except OSError:
                self.close()

    def receive(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Return command and payload of the answers that have come; none after the timeout."""
        if self._descriptor < 0:
            self._open(timeout_s)
        if self._descriptor < 0 or not select([self._descriptor], [], [], timeout_s)[0]:
            return []
        try:
            data = os.read(self._descriptor, _READ)
        except OSError:
            data = b""
        if not data:
            self.close()
            return []
        self._received += data
        return [(command, payload) for mark, command, payload in self._frames() if mark == _ANSWER]

    def _open(self, timeout_s: float) -> None:
        """Connect, or open the device; leave it for the next time where that fails."""
        self._received.clear()
        try:
            if self._tcp is not None:
                self._socket = socket.create_connection(self._tcp, timeout_s)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._descriptor = self._socket.fileno()
            else:
                self._descriptor = os.open(self._address, os.O_RDWR | os.O_NOCTTY)
                tty.setraw(self._descriptor)
                settings = termios.tcgetattr(self._descriptor)
                settings[4] = settings[5] = _BAUD
                termios.tcsetattr(self._descriptor, termios.TCSANOW, settings)
        except OSError:
            threading.Event().wait(timeout_s)

    def _frames(self) -> Iterator[tuple[bytes, int, bytes]]:
        """Yield the whole frames received, with their marks; keep the beginning of another one."""
        got = self._received
        while True:
            start = got.find(b"$")
            if start < 0:
                self.refused += len(got)
                got.clear()
                return
            self.refused += start
            del got[:start]
            if len(got) < _BEFORE or len(got) < _BEFORE + got[3] + 1:
                return
            mark, command = bytes(got[:3]), got[4]
            frame = bytes(got[: _BEFORE + got[3] + 1])
            payload = frame[_BEFORE:-1]
            if mark not in (_ANSWER, _REFUSAL) or frame != framed(mark, command, payload):
                self.refused += 1
                del got[:1]
                continue
            del got[: len(frame)]
            yield mark, command, payload


def framed(mark: bytes, command: int, payload: bytes) -> bytes:
    """Return the frame of a command."""
    body = bytes([len(payload), command]) + payload
    total = 0
    for byte in body:
        total ^= byte
    return mark + body + bytes([total])
