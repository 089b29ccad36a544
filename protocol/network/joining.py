"""The wait of a process for the others of its run."""

from collections.abc import Collection, Mapping

# Time between two questions of a process that joins for those that still take part in a run that
# has begun, s.
ASK_EVERY_S = 0.5


class Joining:
    """Names of the processes that are awaited, and the times of the wait; a steady clock, s.

    A line says every `tell_every_s` that it waits.

    Attributes:
        is_begun: Whether the coordinator is ready, which has seen all.
    """

    def __init__(
        self, others: Collection[str], now_s: float, timeout_s: float, tell_every_s: float
    ) -> None:
        self._awaited = set(others)
        self._timeout_s = timeout_s
        self._deadline_s = now_s + timeout_s
        self._tell_every_s = tell_every_s
        self._tell_s = now_s + tell_every_s
        self._ask_s = 0.0
        self.is_begun = False

    def missing(self, alive: Mapping[str, int]) -> set[str]:
        """Return the awaited processes that are not up."""
        return self._awaited - alive.keys()

    def should_ask(self, now_s: float, alive: Mapping[str, int]) -> bool:
        """Return whether the coordinator is to be asked who takes part.

        When all are up, or when the coordinator is ready.
        """
        return now_s >= self._ask_s and (self.is_begun or not self.missing(alive))

    def restrict(self, taking_part: set[str] | None, ask_again_s: float) -> None:
        """Wait only for those that take part in a run that has begun; None if it has not."""
        self._awaited = taking_part or self._awaited
        self._ask_s = ask_again_s

    def is_over(self, now_s: float) -> bool:
        """Return whether the time is up."""
        return now_s >= self._deadline_s

    def extend(self, now_s: float) -> None:
        """Wait for the whole time once more."""
        self._deadline_s = now_s + self._timeout_s

    def should_tell(self, now_s: float) -> bool:
        """Return whether a line about the wait is due; the next one is due later."""
        is_due = now_s >= self._tell_s
        if is_due:
            self._tell_s += self._tell_every_s
        return is_due

    def words(self, missing: Collection[str], now_s: float) -> str:
        """Return the line about the wait."""
        left_s = self._deadline_s - now_s
        return f"waiting for {', '.join(sorted(missing))}; gives up in {left_s:.0f} s"

    def pause_s(self, now_s: float) -> float:
        """Return the time until the next of these instants, s."""
        ask_s = self._ask_s if self.is_begun else self._deadline_s
        return max(0.0, min(self._deadline_s, self._tell_s, ask_s) - now_s)
