"""The tick that the viewer shows."""


class Playback:
    """The tick to show; advanced by the drawing thread, changed by widgets on other threads.

    Attributes:
        speed: Playback speed, in multiples of real time.
        follows, playing: Whether the newest tick is shown, or one after the other.
    """

    def __init__(self, period_s: float, *, follows: bool) -> None:
        self._period_s = period_s
        self._tick, self._last = 0.0, 0
        self.speed, self.follows, self.playing = 1.0, follows, False

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """Return the tick to show now, of those that can be shown, given the wall time since the previous call, s."""
        self._last, tick = last, self._tick
        if self.follows:
            tick = float(last)
        elif self.playing:
            tick += elapsed_s * self.speed / self._period_s
            self.playing = tick < last
        self._tick = min(max(tick, float(first)), float(last))
        return int(self._tick)

    def seek(self, tick: int) -> None:
        """Pause at a tick."""
        self._tick, self.playing, self.follows = float(tick), False, False

    def toggle(self) -> None:
        """Pause if playing or following; otherwise play, from the beginning if at the end."""
        self.playing = not (self.playing or self.follows)
        self.follows = False
        if self.playing and self._tick >= self._last:
            self._tick = 0.0

    def follow(self, wanted: bool) -> None:
        """Follow the live run, or pause."""
        self.follows, self.playing = wanted, False
