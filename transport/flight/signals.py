"""Collection of the signals that end a run in order, while it is active."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from protocol.network.parent import ending_signals


@contextmanager
def collected_signals() -> Iterator[list[str]]:
    """Collect the names of received SIGINT, SIGTERM and SIGHUP instead of ending; only in the main thread."""
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
