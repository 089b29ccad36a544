"""Rate limit for refused messages and for requests: their sender is slowed down, and nothing is dropped.

The receiving thread waits before it takes the next message, so the connection fills up and its sender must wait, too.
A process that follows the protocol sends no outdated messages and never waits.
"""

import math
import threading
import time

# Refused messages per second without a wait, and how many may come at once.
RATE_HZ, BURST = 500.0, 500.0

# The same for requests of clients, such as link changes and status.
REQUEST_RATE_HZ, REQUEST_BURST = 100.0, 100.0

# How long the receiving thread waits at a time; others receive meanwhile.
_WAIT_S = 0.02

# More messages than this in so short a time are a flood, which no run causes: they are checked on arrival.
WINDOW, WINDOW_S = 128, 0.016


class RateLimit:
    """Token bucket that detects a flood and slows it down: each refused message takes a token, or waits.

    Args:
        rate_hz: Tokens per second.
        burst: Most tokens, and largest debt.

    Several receiving threads may call it at the same time; a count that is off by one does no harm.
    """

    def __init__(self, rate_hz: float = RATE_HZ, burst: float = BURST) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._came, self._flooded = 0, False
        self._window_s = -math.inf
        self._left = burst
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
        filled = min(self._burst, self._left + self._rate_hz * (now_s - self._filled_s))
        self._left = max(-self._burst, filled - 1.0)  # the debt is bounded: a flood has an end
        self._filled_s = now_s
        if self._left >= 0.0 or not self._waiting.acquire(blocking=False):
            return
        try:
            time.sleep(_WAIT_S)
        finally:
            self._waiting.release()
        waited_s = time.monotonic() - now_s
        self._window_s += waited_s  # a slowed-down sender does not send less
