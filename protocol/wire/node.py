"""Interface of a node: a state machine without I/O. Two runtimes drive the same nodes."""

from collections.abc import Sequence
from typing import Protocol

from protocol.wire.messages import Control, Event, Message
from protocol.wire.rejections import Rejections


class Node(Protocol):
    """A role in a run as a state machine: events and time in, messages out.

    Times are nanoseconds of a monotonic clock; in lockstep nothing in the messages depends on them. A node that starts
    anew by itself has a higher incarnation from then on, which its runtime announces.

    Attributes:
        publish_ns: Time the runtime took to send the last messages; the runtime sets it.
        rejected: Messages refused by the node and before it, by sender and reason.
    """

    name: str
    incarnation: int
    publish_ns: int
    rejected: Rejections

    @property
    def finished(self) -> Control | None:
        """Return the end of the run, once it has ended for this node."""

    @property
    def wake_ns(self) -> int | None:
        """Return the latest time of the next call of `poll`; None while only events matter."""

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Handle one event and return the messages to send."""

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Advance time and return the messages to send."""
