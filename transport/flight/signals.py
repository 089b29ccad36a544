"""Signals that end a command, by KeyboardInterrupt.

While a run with processes is active they are collected instead.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from transport.protocol.network.parent import ending_signals

# Names of the signals that were raised as KeyboardInterrupt.
_raised: list[str] = []


def raise_interrupts() -> None:
    """Let SIGTERM and SIGHUP end this process like Ctrl-C, by KeyboardInterrupt."""
    for number in ending_signals():
        # Without job control a shell starts commands in the background with SIGINT ignored.
        if number != signal.SIGINT or signal.getsignal(number) is signal.default_int_handler:
            signal.signal(number, _raise)


def check_interrupt() -> None:
    """Raise KeyboardInterrupt if a signal has already been raised.

    Compiled code that calls Python may suppress it.
    """
    if _raised:
        raise KeyboardInterrupt(_raised[0])


def _raise(number: int, _: FrameType | None) -> None:
    _raised.append(signal.Signals(number).name)
    raise KeyboardInterrupt(_raised[-1])


@contextmanager
def collected_signals() -> Iterator[list[str]]:
    """Collect the names of received SIGINT, SIGTERM and SIGHUP instead of ending.

    Other threads than the main one receive none.
    """
    received: list[str] = []

    def note(number: int, _: FrameType | None) -> None:
        received.append(signal.Signals(number).name)

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {number: signal.signal(number, note) for number in ending_signals()}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
