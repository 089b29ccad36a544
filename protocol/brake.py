"""Rate limit for messages that are refused: whoever sends too many of them is slowed down, and nothing is dropped.

The thread that receives waits before it takes the next one, so the connection fills up and its sender has to wait too.
Whoever follows the protocol sends nothing that is over by the time it comes, and so never waits.
"""

import threading
import time

# Refused messages per second that cost no more than their reading, and how many may come at once.
RATE_HZ, BURST = 500.0, 500.0

# How long the thread that receives waits at a time; others receive meanwhile.
_WAIT_S = 0.02


class Brake:
    """A token bucket; each refused message takes one, and waits where there is none."""

    def __init__(self) -> None:
        self._left = BURST
        self._filled_s = time.monotonic()
        self._waiting = threading.Lock()

    def hold(self) -> int:
        """Take a token; without one wait, unless another thread does: one has to be left that receives.

        Returns: How long it has waited, ns.
        """
        now_s = time.monotonic()
        filled = min(BURST, self._left + RATE_HZ * (now_s - self._filled_s))
        self._left = max(-BURST, filled - 1.0)  # nobody pays for others' floods for ever
        self._filled_s = now_s
        if self._left >= 0.0 or not self._waiting.acquire(blocking=False):
            return 0
        try:
            time.sleep(_WAIT_S)
        finally:
            self._waiting.release()
        return round(1e9 * (time.monotonic() - now_s))
