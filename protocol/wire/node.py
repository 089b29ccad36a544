"""What a node is: a state machine without I/O. Two runtimes drive the same nodes."""

from collections.abc import Sequence
from typing import Protocol

from protocol.wire.messages import Control, Event, Message
from protocol.wire.rejections import Rejections


class Node(Protocol):
    """A role in a run as a state machine: events and time in, messages out.

    `rejected` counts the messages it refused, by sender and reason, and those that never got as far as to it.

    Times are nanoseconds of any clock that only goes forward; in lockstep nothing in the messages depends
    on them. A node that starts anew by itself has a higher incarnation from then on; whoever runs it tells the
    others. `publish_ns` is for the runtime to fill in: what sending the last messages took.
    """

    name: str
    incarnation: int
    publish_ns: int
    rejected: Rejections

    @property
    def finished(self) -> Control | None:
        """How the run ended for this node, once it has."""

    @property
    def wake_ns(self) -> int | None:
        """When `poll` must be called next at the latest; None while only events matter."""

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in one event and return what to send because of it."""

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Let time pass and return what to send because of it."""
