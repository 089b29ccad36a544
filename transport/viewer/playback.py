"""Playback state of the viewer: paused, playing, or following a live run."""

import threading
from collections.abc import Mapping

# Playback speeds by label.
SPEEDS: Mapping[str, float] = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}


class Playback:
    """The tick to show; advanced by the drawing thread, changed by widgets on other threads."""

    def __init__(self, period_s: float, *, follows: bool) -> None:
        self._period_s = period_s
        self._lock = threading.Lock()
        self._tick, self._last = 0.0, 0
        self._speed = 1.0
        self.follows, self.playing = follows, False

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """Return the tick to show now, of those that can be shown, given the wall time since the previous call, s."""
        with self._lock:
            self._last = last
            if self.follows:
                self._tick = float(last)
            elif self.playing:
                self._tick += elapsed_s * self._speed / self._period_s
                self.playing = self._tick < last
            self._tick = min(max(self._tick, float(first)), float(last))
            return int(self._tick)

    def seek(self, tick: int) -> None:
        """Pause at a tick."""
        with self._lock:
            self._tick, self.playing, self.follows = float(tick), False, False

    def toggle(self) -> None:
        """Pause if playing or following; otherwise play, from the beginning if at the end."""
        with self._lock:
            self.playing = not (self.playing or self.follows)
            self.follows = False
            if self.playing and self._tick >= self._last:
                self._tick = 0.0

    def follow(self, wanted: bool) -> None:
        """Follow the live run, or pause."""
        with self._lock:
            self.follows, self.playing = wanted, False

    def set_speed(self, speed: float) -> None:
        """Set the playback speed, in multiples of real time."""
        with self._lock:
            self._speed = speed
