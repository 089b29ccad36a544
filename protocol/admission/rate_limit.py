"""Rate limit for refused messages: their sender is slowed down, and no message is dropped.

The receiving thread waits before it takes the next message, so the connection fills up and its sender must wait, too.
A process that follows the protocol sends no outdated messages and never waits.
"""

import math
import threading
import time

# Refused messages per second without a wait, and how many may come at once.
RATE_HZ, BURST = 500.0, 500.0

# How long the receiving thread waits at a time; others receive meanwhile.
_WAIT_S = 0.02

# More messages than this in so short a time are a flood, which no run causes: they are checked on arrival.
WINDOW, WINDOW_S = 128, 0.016


class RateLimit:
    """Token bucket that detects a flood and slows it down: each refused message takes a token, or waits.

    Several receiving threads may call it at the same time; a count that is off by one does no harm.
    """

    def __init__(self) -> None:
        self._came, self._flooded = 0, False
        self._window_s = -math.inf
        self._left = BURST
        self._filled_s = time.monotonic()
        self._waiting = threading.Lock()

    def flooded(self) -> bool:
        """Count an arriving message; return whether more arrive than any run has."""
        self._came += 1
        if self._came % WINDOW == 0:
            now_s = time.monotonic()
            self._flooded, self._window_s = now_s - self._window_s < WINDOW_S, now_s
        return self._flooded

    def hold(self) -> None:
        """Take a token; without one wait, unless another thread waits: one must be left that receives."""
        now_s = time.monotonic()
        filled = min(BURST, self._left + RATE_HZ * (now_s - self._filled_s))
        self._left = max(-BURST, filled - 1.0)  # the debt is bounded: a flood has an end
        self._filled_s = now_s
        if self._left >= 0.0 or not self._waiting.acquire(blocking=False):
            return
        try:
            time.sleep(_WAIT_S)
        finally:
            self._waiting.release()
        waited_s = time.monotonic() - now_s
        self._window_s += waited_s  # a slowed-down sender does not send less
