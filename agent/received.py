"""Information that an agent has received for the step of a tick."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

from transport.protocol.wire.messages import Measurement, Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Received:
    """Messages and roster of a tick, as the links of the agent have delivered them."""

    measurement: Measurement  # the tick's own
    measurements: Sequence[Measurement]  # that have become usable since the last step, in order
    plans: Sequence[Plan]  # of the others, that have become usable since the last step, in order
    lost: int  # plans that are known since then to be lost on their links
    measurements_lost: int  # the same of measurements
    agents: Set[int]  # on the roster, 1-based
    off: frozenset[int]  # UAVs whose motors are off, 0-based
    released: frozenset[int]  # those of them that are released
    failed_since: int  # tick of the newest failure of a UAV
    ticks_since_start: int  # since this process joined
    started_ns: int  # begin of the step on the stopwatch

    @property
    def tick(self) -> int:
        """The present tick."""
        return self.measurement.tick
