"""The tick that a viewer shows: the newest of an active run, or one of a playback."""


class Playback:
    """The tick to show: of the run that it follows, or of a playback.

    Widgets change it on other threads.
    """

    def __init__(self, period_s: float, *, follows: bool) -> None:
        self._period_s = period_s
        self._tick = 0.0
        self._last = 0  # newest tick that can be shown
        self.speed = 1.0
        self.follows = follows
        self.playing = False

    def advance(self, elapsed_s: float, first: int, last: int) -> int:
        """Return the tick to show now.

        Args:
            elapsed_s: Wall time since the previous call, s.
            first: First tick that can be shown.
            last: Last tick that can be shown.
        """
        self._last = last
        tick = self._tick
        if self.follows:
            tick = float(last)
        elif self.playing:
            tick += elapsed_s * self.speed / self._period_s
            self.playing = tick < last
        self._tick = min(max(tick, float(first)), float(last))
        return int(self._tick)

    def seek(self, tick: int) -> None:
        """Pause at a tick."""
        self._tick = float(tick)
        self.playing = False
        self.follows = False

    def toggle(self) -> None:
        """Pause if playing or following; otherwise play, from the beginning if at the end."""
        self.playing = not (self.playing or self.follows)
        self.follows = False
        if self.playing and self._tick >= self._last:
            self._tick = 0.0  # a log may begin later: `advance` goes on from its first tick

    def follow(self, wanted: bool) -> None:
        """Follow the live run, or pause."""
        self.follows = wanted
        self.playing = False
