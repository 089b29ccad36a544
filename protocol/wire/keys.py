"""Key expressions (docs/protocol.md) of messages, from the `Route` of their class, of tokens and of requests."""

import re
from dataclasses import dataclass

from transport.protocol.wire.errors import MessageError, TransportError
from transport.protocol.wire.messages import BUNDLES, KINDS, Message
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    OPERATOR,
    PLANT,
    RECORDER,
    ROUTER,
    WATCHER,
    agent_name,
    role_of,
)

__all__ = [
    "ACTING",
    "OPERATOR",
    "READING",
    "RECORDER",
    "ROUTER",
    "WATCHER",
    "Keys",
    "Token",
    "matches",
]

_TOKEN = re.compile(r"(alive|ready)/([^/]+)/([0-9]{1,15})(?:/([^/]+)/([0-9]{1,5}))?")
_CLASSES = (*KINDS.values(), *BUNDLES.values())

# Requests that any client may send, and those that change the run.
READING, ACTING = ("status", "health"), ("link", "fault", "target")


@dataclass(frozen=True, slots=True)
class Token:
    """Content of a liveliness token; a `ready` token has neither digest nor version."""

    name: str
    incarnation: int  # which start of the process
    digest: str | None = None  # fingerprint of its scenario
    version: int | None = None  # of the protocol it speaks


class Keys:
    """Key expressions of a run, whose name has letters, digits, underscore, dot and dash.

    `prefix` begins all keys.
    """

    def __init__(self, run: str) -> None:
        if not self.allows(run):
            raise TransportError(
                f"run name: expected at most 80 letters, digits, '_', '.', '-', got {run!r}"
            )
        self.run, self.prefix = run, f"transport/{run}"

    @classmethod
    def below(cls, prefix: str) -> "Keys":
        """Return key expressions below a prefix for several runs, `transport/*`.

        Nothing is sent under them.
        """
        keys = cls("any")
        keys.prefix = prefix
        return keys

    @staticmethod
    def allows(run: str) -> bool:
        """Return whether a run can have this name."""
        return re.fullmatch(r"[A-Za-z0-9_.-]{1,80}", run) is not None

    def of(self, message: Message) -> str:
        """Return the key a message travels under."""
        route = message.route
        unshared = route.unshared_key and not getattr(message, "shared", True)
        key = route.unshared_key if unshared else route.key or message.kind
        return (
            f"{self.prefix}/{key}/{getattr(message, route.each)}"
            if route.each
            else f"{self.prefix}/{key}"
        )

    def subscriptions(self, name: str) -> list[str]:
        """Return the key expressions a process subscribes to."""
        role, found = role_of(name), []
        for cls in (cls for cls in _CLASSES if role in cls.route.receivers):
            # An agent receives what other processes send to it, and from the other agents
            # everything they share.
            end = name.removeprefix(AGENT) if role == AGENT and cls.route.sender != AGENT else "*"
            found += self._under(cls, end)[: 1 if role == AGENT else None]
        return [*dict.fromkeys(found), *([self.left("*")] if role == RECORDER else [])]

    def publications(self, name: str) -> list[str]:
        """Return the key expressions a process may publish under; recorder and watchers have none."""
        role, found = role_of(name), []
        if role not in (COORDINATOR, PLANT, AGENT):
            return []
        for cls in (cls for cls in _CLASSES if cls.route.sender in (role, None)):
            end = (
                name
                if cls.route.each == "sender"
                else name.removeprefix(AGENT)
                if role == AGENT
                else "*"
            )
            found += self._under(cls, end)
        return [*dict.fromkeys(found), self.left(name)]

    def _under(self, cls: type[Message], end: str) -> list[str]:
        """Return the key expressions of a kind of message for one end or all, that of unshared ones last."""
        keys = filter(None, (cls.route.key or cls.kind, cls.route.unshared_key))
        return [
            f"{self.prefix}/{key}/{end}" if cls.route.each else f"{self.prefix}/{key}"
            for key in keys
        ]

    def left(self, name: str) -> str:
        """Return the key under which a process says that it has sent its last message.

        `*` for all processes.
        """
        return f"{self.prefix}/left/{name}"

    def alive(self, name: str, incarnation: int, digest: str, version: int) -> str:
        """Return the liveliness token of a process that is up, with scenario digest and protocol version."""
        return f"{self.prefix}/alive/{name}/{incarnation}/{digest}/{version}"

    def ready(self, name: str, incarnation: int) -> str:
        """Return the liveliness token of a process that has seen all the others."""
        return f"{self.prefix}/ready/{name}/{incarnation}"

    def request(self, name: str, what: str) -> str:
        """Return the key of a request to a process; `*` for all of its requests."""
        return f"{self.prefix}/ask/{name}/{what}"

    def token(self, key: str) -> Token:
        """Return the content of a liveliness token from its key.

        Raises: MessageError: it is none of this run.
        """
        found = _TOKEN.fullmatch(self.end(key))
        if found is None or (found[1] == "alive") != (found[4] is not None):
            raise MessageError("malformed", f"expected the key of a token, got {key}")
        return Token(found[2], int(found[3]), found[4], int(found[5]) if found[5] else None)

    def end(self, key: str) -> str:
        """Return a key without the prefix of the run."""
        return key.removeprefix(f"{self.prefix}/")

    def check_sender(self, key: str, message: Message) -> None:
        """Raise MessageError for a message that travels under a key its sender does not own."""
        sender, owner = message.sender, message.route.sender
        if key != self.of(message):
            raise MessageError(
                "wrong_sender", f"{message.kind} of {sender} under the key {key}", sender
            )
        if owner == AGENT:
            owner = agent_name(getattr(message, "agent"))  # noqa: B009 - messages of agents have the field
        if owner not in (None, sender):  # without an owner the key ends with the sender
            raise MessageError(
                "wrong_sender", f"{message.kind} from {sender}, expected it from {owner}", sender
            )


def matches(expression: str, key: str) -> bool:
    """Return whether a key expression of `Keys.subscriptions` covers a key (a trailing `*` is one chunk)."""
    head, _, last = key.rpartition("/")
    return key == expression or (f"{head}/*" == expression and bool(last))
