"""Events that a process gets from its bus, and their times; its place in the run, and its connection."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from transport.protocol.admission.acceptance_and_refusals import Sample
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.wire.bundles import Bundle
from transport.protocol.wire.messages import Event


@dataclass(frozen=True, slots=True)
class Interrupted:
    """Event: a signal, or the parent process is gone."""

    reason: str


@dataclass(frozen=True, slots=True)
class Departed:
    """Event for the recorder: a process has sent its last message, and all have arrived."""

    name: str


BusEvent = Event | Sample | Interrupted | Departed


class Arrival(NamedTuple):
    """An event, its time of arrival (ns since 1970), and the bundle it came in, if any."""

    event: BusEvent
    arrived_ns: int
    bundle: Bundle | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A process's place in a run.

    Attributes:
        incarnation: Number of this start of the process.
        join_timeout_s: Time to wait for the other processes, or of a client for its router, s.
    """

    run: str
    endpoints: Endpoints
    incarnation: int = 0
    join_timeout_s: float = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOptions:
    """Properties of a process's connection.

    Attributes:
        serves: Whether its node answers requests; every process answers for its health.
        patience_s: Time that sending waits for a peer that does not read, before its link is
            closed, s.
        gather_s: Time that an arrival may wait for more, s: one wake-up for many messages costs
            less.
        tell_every_s: Time between two lines of a process that waits for others, s.
    """

    serves: bool = False
    patience_s: float = 1.0
    gather_s: float = 0.0
    tell_every_s: float = 5.0


def wall_offset_ns() -> int:
    """Return the time since 1970 less the steady clock's, ns: what a process adds to its times."""
    return time.time_ns() - time.monotonic_ns()


class SteadyClock:
    """Wall-clock time of its construction, continued by a steady clock.

    A correction of the system's clock during a run moves no time, so differences are durations.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._steady_ns = steady_ns
        self._offset_ns = wall_ns() - steady_ns()

    def now_ns(self) -> int:
        """Return the time, ns since 1970."""
        return self._offset_ns + self._steady_ns()
