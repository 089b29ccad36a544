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


def record(address: str, path: str, seconds: float = 60.0, port: int = PORT) -> int:
    """Write a trace and return the number of lost messages."""
    count = max(2, round(seconds / PERIOD_S))
    round_trips_s: dict[int, float] = {}
    sent_s: list[float] = []
    with (
        suppress(KeyboardInterrupt),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened,
    ):
        begin_s = time.monotonic()
        # Answers to the last message are awaited.
        for number in range(count + round(PATIENCE_S / PERIOD_S)):
            if number % round(EVERY_S / PERIOD_S) == 0:
                answers = f"{len(round_trips_s)} of {len(sent_s)} messages answered"
                print(f"{number * PERIOD_S:.0f} of {seconds:g} s: {answers}", file=sys.stderr)
            if number < count:
                sent_s.append(time.monotonic())
                opened.sendto(_NUMBER.pack(number).ljust(MESSAGE_BYTES, b"\0"), (address, port))
            until_s = begin_s + (number + 1) * PERIOD_S
            while (left_s := until_s - time.monotonic()) > 0.0:
                opened.settimeout(left_s)
                try:
                    data, _ = opened.recvfrom(65_535)
                except (TimeoutError, ConnectionRefusedError):
                    continue
                (of,) = _NUMBER.unpack_from(data)
                round_trips_s.setdefault(of, time.monotonic() - sent_s[of])

    # After Ctrl-C answers to the newest messages may be on their way: those are not lost.
    end_s = time.monotonic()
    decided = sum(at_s <= end_s - PATIENCE_S for at_s in sent_s)
    with open(path, "w", encoding="utf-8") as file:  # noqa: PTH123  # the path is a text of the user
        file.write("t_s,delay_s\n")
        for number in range(decided):
            round_trip_s = round_trips_s.get(number)
            delay = "lost" if round_trip_s is None else f"{round_trip_s / 2.0:.6f}"
            file.write(f"{number * PERIOD_S:.3f},{delay}\n")
    return decided - sum(number < decided for number in round_trips_s)


if __name__ == "__main__":
    if sys.argv[1:] == ["answer"]:
        answer()
    elif sys.argv[1:2] == ["record"] and len(sys.argv) in (4, 5):
        lost = record(sys.argv[2], sys.argv[3], *map(float, sys.argv[4:]))
        print(f"{sys.argv[3]}: {lost} messages lost")
    else:
        sys.exit(__doc__)
