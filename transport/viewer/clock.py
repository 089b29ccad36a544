"""Which instant the viewer shows: played, stopped, moved by hand, or the newest of a run in flight."""

import threading
from collections.abc import Mapping

# Choices of how fast to play.
SPEEDS: Mapping[str, float] = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}


class Clock:
    """The instant that is shown, in ticks; moved by whoever draws and by people, on threads of their own.

    Args:
        period_s: Sampling period, s.
        follows: Whether it starts by following a run in flight.
        playing: Whether it starts by playing.
    """

    def __init__(self, period_s: float, *, follows: bool, playing: bool) -> None:
        self._period_s = period_s
        self._lock = threading.Lock()
        self._at, self._last = 0.0, 0
        self._speed = 1.0
        self.follows, self.playing = follows, playing

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """The tick to show now.

        Args:
            elapsed_s: Wall time since it was asked for last, s.
            first: The earliest tick that can be shown.
            last: The newest.
        """
        with self._lock:
            self._last = last
            if self.follows:
                self._at = float(last)
            elif self.playing:
                self._at += elapsed_s * self._speed / self._period_s
                self.playing = self._at < last
            self._at = min(max(self._at, float(first)), float(last))
            return int(self._at)

    def seek(self, tick: int) -> None:
        """Show a tick, and stay there."""
        with self._lock:
            self._at, self.playing, self.follows = float(tick), False, False

    def toggle(self) -> None:
        """Play what is stopped, from the beginning if it is at its end, and stop what plays."""
        with self._lock:
            self.playing = not (self.playing or self.follows)
            self.follows = False
            if self.playing and self._at >= self._last:
                self._at = 0.0

    def follow(self, wanted: bool) -> None:
        """Follow the run, or stay."""
        with self._lock:
            self.follows, self.playing = wanted, False

    def set_speed(self, speed: float) -> None:
        """How much faster than real time to play."""
        with self._lock:
            self._speed = speed
