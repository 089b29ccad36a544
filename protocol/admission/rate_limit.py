"""Rate limit for messages that are refused: whoever sends too many of them is slowed down, and nothing is dropped.

The thread that receives waits before it takes the next one, so the connection fills up and its sender has to wait too.
Whoever follows the protocol sends nothing that is over by the time it comes, and so never waits.
"""

import math
import threading
import time

# Refused messages per second that cost no more than their reading, and how many may come at once.
RATE_HZ, BURST = 500.0, 500.0

# How long the thread that receives waits at a time; others receive meanwhile.
_WAIT_S = 0.02

# More messages than this in so short a time is more than a process of any run is told as fast as that goes: from then
# on they are looked at as they come.
WINDOW, WINDOW_S = 128, 0.016


class RateLimit:
    """Sees a flood, and slows it down: a token bucket; each refused message takes one, and waits where there is none.

    For the threads that receive: they may call it at the same time. A count that is off by one then does no harm.
    """

    def __init__(self) -> None:
        self._came, self._flooded = 0, False
        self._window_s = -math.inf
        self._left = BURST
        self._filled_s = time.monotonic()
        self._waiting = threading.Lock()

    def flooded(self) -> bool:
        """Count a message that comes in; whether more come than any run has."""
        self._came += 1
        if self._came % WINDOW == 0:
            now_s = time.monotonic()
            self._flooded, self._window_s = now_s - self._window_s < WINDOW_S, now_s
        return self._flooded

    def hold(self) -> None:
        """Take a token; without one wait, unless another thread does: one has to be left that receives."""
        now_s = time.monotonic()
        filled = min(BURST, self._left + RATE_HZ * (now_s - self._filled_s))
        self._left = max(-BURST, filled - 1.0)  # nobody pays for others' floods for ever
        self._filled_s = now_s
        if self._left >= 0.0 or not self._waiting.acquire(blocking=False):
            return
        try:
            time.sleep(_WAIT_S)
        finally:
            self._waiting.release()
        waited_s = time.monotonic() - now_s
        self._window_s += waited_s  # who is slowed down does not send less
