"""Times of the stages of a step, for the step report."""

from collections.abc import Callable

from transport.protocol.wire.messages import STAGES

# Stages counted as computation, not waiting or publishing.
COMPUTATION = ("estimate", "linearise", "discretise", "condense", "solve")


class StageTimes:
    """Times of the present step by stage, ns of a steady clock, from its stopwatch."""

    def __init__(self, stopwatch: Callable[[], int]) -> None:
        self._stopwatch = stopwatch
        self._last_ns = stopwatch()  # end of the last stage
        self.ns = dict.fromkeys(STAGES, 0)

    def begin(self, started_ns: int) -> None:
        """Begin a step: the time since the last stage was waiting."""
        self.ns = dict.fromkeys(STAGES, 0)
        self.ns["wait"] = started_ns - self._last_ns
        self._last_ns = started_ns

    def resume(self) -> None:
        """Begin a stage now; the time since the last one counts nowhere."""
        self._last_ns = self._stopwatch()

    def lap(self, stage: str) -> None:
        """Count the time since the end of the last stage as that of a stage."""
        before_ns = self._last_ns
        self._last_ns = self._stopwatch()
        self.ns[stage] += self._last_ns - before_ns

    def conclude(self, publish_ns: int) -> None:
        """Set the time of publishing the last messages, and the total of computation."""
        self.ns["publish"] = publish_ns
        self.ns["total"] = sum(self.ns[stage] for stage in COMPUTATION)
