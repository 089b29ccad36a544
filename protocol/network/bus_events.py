"""Events that a process gets from its bus, its place in the run, and the options of its connection."""

from dataclasses import dataclass
from typing import NamedTuple

from transport.protocol.admission.acceptance_and_refusals import Sample
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.wire.messages import Bundle, Event


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
