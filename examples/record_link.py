"""Record delay and loss of a link between two computers as a trace for `links.trace`.

On one computer:   python record_link.py answer
On the other one:  python record_link.py record ADDRESS FILE [SECONDS]

The delay of a message is half of its round trip; a message without an answer is lost. SECONDS are 60
by default; Ctrl-C ends the recording earlier and writes what there is.
"""

import socket
import struct
import sys
import time
from contextlib import suppress

PORT = 7450
PERIOD_S = 0.05
EVERY_S = 10.0  # between lines of progress
PATIENCE_S = 1.0  # a message without an answer by then is lost
MESSAGE_BYTES = 1500  # of a plan of one UAV over 20 steps
_NUMBER = struct.Struct("<q")


def answer(port: int = PORT, most: int | None = None) -> None:
    """Return every message to its sender, for ever or until there were so many."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("", port))
        answered = 0
        while most is None or answered < most:
            data, sender = opened.recvfrom(65_535)
            opened.sendto(data, sender)
            answered += 1


class RoundTrips:
    """Numbered messages to an address, and the round trips of those that are answered."""

    def __init__(self, opened: socket.socket, address: tuple[str, int]) -> None:
        self._socket = opened
        self._address = address
        self._sent_s: list[float] = []  # by number
        self._took_s: dict[int, float] = {}  # by number of an answered message

    def __str__(self) -> str:
        """Return the progress in words."""
        return f"{len(self._took_s)} of {len(self._sent_s)} messages answered"

    def send(self) -> None:
        """Send the next message."""
        number = len(self._sent_s)
        message = _NUMBER.pack(number).ljust(MESSAGE_BYTES, b"\0")
        self._sent_s.append(time.monotonic())
        self._socket.sendto(message, self._address)

    def receive(self, until_s: float) -> None:
        """Take in answers until a time."""
        while (left_s := until_s - time.monotonic()) > 0.0:
            self._socket.settimeout(left_s)
            try:
                data, _ = self._socket.recvfrom(65_535)
            except (TimeoutError, ConnectionRefusedError):
                continue
            if len(data) != MESSAGE_BYTES:
                continue  # of another program
            (number,) = _NUMBER.unpack_from(data)
            self._took_s.setdefault(number, time.monotonic() - self._sent_s[number])

    def decided(self) -> list[float | None]:
        """Return the round trips in the order sent, s, None for lost messages.

        Answers to the newest messages may be on their way: those are left out.
        """
        latest_s = time.monotonic() - PATIENCE_S
        count = sum(sent_s <= latest_s for sent_s in self._sent_s)
        return [self._took_s.get(number) for number in range(count)]


def record(address: str, path: str, seconds: float = 60.0, port: int = PORT) -> int:
    """Write a trace and return the number of lost messages."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        trips = RoundTrips(opened, (address, port))
        with suppress(KeyboardInterrupt):
            _exchange(trips, seconds)
        took_s = trips.decided()

    with open(path, "w", encoding="utf-8") as file:  # noqa: PTH123  # the path is a text of the user
        file.write("t_s,delay_s\n")
        for number, one_s in enumerate(took_s):
            delay = "lost" if one_s is None else f"{one_s / 2.0:.6f}"
            file.write(f"{number * PERIOD_S:.3f},{delay}\n")
    return took_s.count(None)


def _exchange(trips: RoundTrips, seconds: float) -> None:
    """Send a message each period, and take in the answers, also those to the last one."""
    sent = max(2, round(seconds / PERIOD_S))
    awaited = round(PATIENCE_S / PERIOD_S)
    begun_s = time.monotonic()
    for period in range(sent + awaited):
        if period % round(EVERY_S / PERIOD_S) == 0:
            print(f"{period * PERIOD_S:.0f} of {seconds:g} s: {trips}", file=sys.stderr)
        if period < sent:
            trips.send()
        trips.receive(until_s=begun_s + (period + 1) * PERIOD_S)


if __name__ == "__main__":
    if sys.argv[1:] == ["answer"]:
        answer()
    elif sys.argv[1:2] == ["record"] and len(sys.argv) in (4, 5):
        lost = record(sys.argv[2], sys.argv[3], *map(float, sys.argv[4:]))
        print(f"{sys.argv[3]}: {lost} messages lost")
    else:
        sys.exit(__doc__)
