"""The order of messages of one kind under one key."""

from dataclasses import dataclass

from protocol.wire.header import Header, Place, place_of
from protocol.wire.messages import Message, MessageError


@dataclass(frozen=True, slots=True)
class Newest:
    """The newest message of a kind under a key."""

    sender: str
    incarnation: int
    sequence: int
    place: Place | None


def place_in(message: Message | Header) -> Place | None:
    """Return the place of a message in the order of its kind, or None."""
    return message.place if isinstance(message, Header) else place_of(message)


def check_new(message: Message | Header, place: Place | None, newest: Newest) -> None:
    """Refuse a message that is not newer than the newest of its kind under its key."""
    known = message.sequence <= newest.sequence
    if place is None or newest.place is None:
        if known:
            text = f"{message.kind} number {message.sequence} after number {newest.sequence}"
            raise MessageError("replayed", text, message.sender)
    elif place <= newest.place:
        text = f"{message.kind} {place[0]} after {newest.place[0]}"
        raise MessageError("replayed" if known else "past", text, message.sender)
