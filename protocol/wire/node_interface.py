"""Interface of a node, a state machine without I/O, and the shape of its messages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from transport.model.arrays import Array
from transport.protocol.wire.messages import Control, Event, Message


@dataclass(frozen=True, slots=True, kw_only=True)
class RunShape:
    """Shape of the messages of a run, from its scenario (`protocol.scenario.setup.run_setup.Setup.shape`)."""

    owned: Mapping[int, tuple[int, ...]]  # ids of the UAVs of each agent, both 1-based
    # Smallest and largest inputs of each agent, (4 owned,), SI.
    limits: Mapping[int, tuple[Array, Array]]
    uavs: int
    ticks: int
    period_s: float
    delay: int  # ticks from a plan to its first input
    negotiation_iterations: int
    # Whether UAVs are described by the measurements of their own sensors, not by states.
    vehicle_sensors: bool
    relayed: bool  # whether plans come in bundles
    # Whether measurements come from the process of each UAV, not from the plant.
    by_vehicles: bool = False
    # Whether targets told to some are followed once all agents have them.
    confirms: bool = False
    sights: int = 0  # obstacles that agents do not know before a UAV is near


class Node(Protocol):
    """A role in a run as a state machine: messages, other events and time in, messages out.

    Times are nanoseconds of a monotonic clock; in lockstep nothing in the messages depends on them.
    """

    name: str
    # A node that starts anew by itself has a higher one from then on, which its runtime announces.
    incarnation: int
    publish_ns: int  # time the runtime took to send the last messages; the runtime sets it

    @property
    def finished(self) -> Control | None:
        """Return the end of the run, once it has ended for this node."""

    @property
    def wake_ns(self) -> int | None:
        """Return the latest time of the next call of `poll`; None while only events matter."""

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for a message of an earlier start or of no use; the last check."""

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Handle one event and return the messages to send. Messages have passed all checks."""

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Advance time and return the messages to send."""
