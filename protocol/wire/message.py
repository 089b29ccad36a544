"""Base of all messages: frozen, validated at construction, with the route its kind takes through the network."""

from dataclasses import dataclass
from typing import ClassVar

from protocol.wire.fields import Count, Name, checks

# Message classes by kind, in the order of their definition: codec, keys, header, log and exports are built from it.
KINDS: dict[str, type["Message"]] = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Keys, publishers, subscribers and order of a kind of message.

    Attributes:
        sender: Role that publishes it; None for any process.
        receivers: Roles that subscribe to it.
        key: Beginning of its key: the kind, unless it shares the key, and so the order, of another kind.
        each: Field that ends the key, "agent" or "sender"; empty where there is one key for all.
        unshared_key: Beginning of the key if its field `shared` is false; agents do not subscribe to that.
        grows: Field that grows from each message under a key to the next: "sequence", "tick" or one of its own.
        falls: Field that falls while the other stays the same.
    """

    sender: str | None
    receivers: tuple[str, ...]
    key: str = ""
    each: str = ""
    unshared_key: str = ""
    grows: str = "sequence"
    falls: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """Fields of every message. The types of fields are those of `protocol.wire.fields`, or `Literal`.

    Attributes:
        sender: Process name.
        incarnation: Which start of that process, growing with every restart.
        sequence: Number of the message among all its sender sent in this incarnation, from 0.
        tick: The sampling instant it belongs to, from 0.
    """

    kind: ClassVar[str]
    route: ClassVar[Route]

    sender: Name
    incarnation: Count
    sequence: Count
    tick: Count

    def __init_subclass__(cls) -> None:
        KINDS[cls.kind] = cls  # twice, as slots=True makes the class anew: the second one stays

    def __post_init__(self) -> None:
        for field, check in checks(type(self)):
            value = getattr(self, field)
            kept = check(field, value, self)
            if kept is not value:
                object.__setattr__(self, field, kept)
        self._check_relations()

    def _check_relations(self) -> None:
        """Check fields against each other.

        Raises: MessageError: they do not fit.
        """
