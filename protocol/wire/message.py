"""Base of all messages: frozen, validated at construction, with the route its kind takes through the network."""

from dataclasses import dataclass
from typing import ClassVar

from protocol.wire.fields import Count, Name, checks

# Message classes by kind, in the order of their definition: codec, keys, header, log and exports are built from it.
KINDS: dict[str, type["Message"]] = {}
# The same for bundles, which carry other messages: nodes and logs never see them (`protocol.wire.bundles`).
BUNDLES: dict[str, type["Message"]] = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Keys, publishers, subscribers and order of a kind of message."""

    sender: str | None  # role that publishes it; None for any process
    receivers: tuple[str, ...]  # roles that subscribe to it
    key: str = ""  # beginning of its key: the kind, unless it shares the key, and so the order, of another kind
    each: str = ""  # field that ends the key, "agent" or "sender"; empty where there is one key for all
    unshared_key: str = ""  # beginning of the key if its field `shared` is false; agents do not subscribe to that
    grows: str = "sequence"  # field that grows under a key: "sequence", "tick" or one of its own
    falls: str = ""  # field that falls while the other stays the same


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """Fields of every message. The types of fields are those of `protocol.wire.fields`, or `Literal`."""

    kind: ClassVar[str]
    route: ClassVar[Route]
    register: ClassVar[dict[str, type["Message"]]] = KINDS

    sender: Name  # process name
    incarnation: Count  # which start of that process, growing with every restart
    sequence: Count  # number of the message among all its sender sent in this incarnation, from 0
    tick: Count  # the sampling instant it belongs to, from 0

    def __init_subclass__(cls) -> None:
        if "kind" in cls.__dict__:
            cls.register[cls.kind] = cls  # twice, as slots=True makes the class anew: the second one stays

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
