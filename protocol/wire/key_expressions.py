"""Key expressions (docs/reference/protocol.md) of messages, tokens and requests.

Those of messages follow from the `Route` of their class.
"""

import re
from dataclasses import dataclass

from transport.protocol.wire.bundles import BUNDLES
from transport.protocol.wire.errors_and_exit_codes import MessageError, TransportError
from transport.protocol.wire.messages import KINDS, Message
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    OPERATOR,
    PLANT,
    RECORDER,
    ROUTER,
    VEHICLE,
    WATCHER,
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
READING = ("status", "health")
ACTING = ("link", "fault", "target", "abort", "release")


@dataclass(frozen=True, slots=True)
class Token:
    """Content of a liveliness token; a `ready` token has neither digest nor version."""

    name: str
    incarnation: int  # which start of the process
    digest: str | None = None  # fingerprint of its scenario
    version: int | None = None  # of the protocol it speaks


class Keys:
    """Key expressions of a run, all of which begin with `prefix`.

    The name of a run has letters, digits, underscore, dot and dash.
    """

    def __init__(self, run: str) -> None:
        if not self.allows(run):
            raise TransportError(
                f"run name: expected at most 80 letters, digits, '_', '.', '-', got {run!r}"
            )
        self.run = run
        self.prefix = f"transport/{run}"

    @classmethod
    def below(cls, prefix: str) -> "Keys":
        """Return key expressions for access rules and routers: nothing is sent there.

        The prefix is that of one run, or `transport/*` for all.
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
        key = route.key or message.kind
        if route.unshared_key and not getattr(message, "shared", True):
            key = route.unshared_key
        if not route.each:
            return f"{self.prefix}/{key}"
        return f"{self.prefix}/{key}/{getattr(message, route.each)}"

    def subscriptions(self, name: str) -> list[str]:
        """Return the key expressions a process subscribes to."""
        role = role_of(name)
        keys: list[str] = []
        for cls in _CLASSES:
            if role not in cls.route.receivers:
                continue
            if role == AGENT:
                # An agent receives messages of other processes that are for it, and from the other
                # agents all that they share.
                end = "*" if cls.route.sender == AGENT else name.removeprefix(AGENT)
                keys.append(self._under(cls, end)[0])
            elif role == VEHICLE and cls.route.sender == AGENT:
                # Of plans it receives those of its own agent, shared or not.
                keys += self._under(cls, name.removeprefix(VEHICLE))
            else:
                keys += self._under(cls, "*")
        if role == RECORDER:
            keys.append(self.left("*"))
        return [*dict.fromkeys(keys)]

    def publications(self, name: str) -> list[str]:
        """Return the keys a process may publish under; recorder and watchers have none."""
        role = role_of(name)
        if role not in (COORDINATOR, PLANT, AGENT, VEHICLE):
            return []
        keys: list[str] = []
        for cls in _CLASSES:
            is_own = cls.route.sender in (role, None) or (role == VEHICLE and cls.route.by_vehicles)
            if not is_own:
                continue
            end = name.removeprefix(role) if role in (AGENT, VEHICLE) else "*"
            if cls.route.each == "sender":
                end = name
            keys += self._under(cls, end)
        return [*dict.fromkeys(keys), self.left(name)]

    def _under(self, cls: type[Message], end: str) -> list[str]:
        """Return the keys of a kind of message for one end or all; that of unshared ones last."""
        keys = filter(None, (cls.route.key or cls.kind, cls.route.unshared_key))
        return [
            f"{self.prefix}/{key}/{end}" if cls.route.each else f"{self.prefix}/{key}"
            for key in keys
        ]

    def left(self, name: str) -> str:
        """Return the key of a process's sign that it has sent its last message; `*` for all."""
        return f"{self.prefix}/left/{name}"

    def alive(self, name: str, incarnation: int, digest: str, version: int) -> str:
        """Return the token of a process that is up, with scenario and protocol version."""
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
        match = _TOKEN.fullmatch(self.end(key))
        if match is None:
            raise MessageError("malformed", f"expected the key of a token, got {key}")
        kind, name, incarnation, digest, version = match.groups()
        if (kind == "alive") != (digest is not None):
            raise MessageError("malformed", f"expected the key of a token, got {key}")
        return Token(name, int(incarnation), digest, int(version) if version else None)

    def end(self, key: str) -> str:
        """Return a key without the prefix of the run."""
        return key.removeprefix(f"{self.prefix}/")

    def check_sender(self, key: str, message: Message) -> None:
        """Raise MessageError for a message that travels under a key its sender does not own."""
        sender = message.sender
        if key != self.of(message):
            text = f"{message.kind} of {sender} under the key {key}"
            raise MessageError("wrong_sender", text, sender)

        owner = self._owner(message)
        if owner not in (None, sender):  # without an owner the key ends with the sender
            text = f"{message.kind} from {sender}, expected it from {owner}"
            raise MessageError("wrong_sender", text, sender)

    @staticmethod
    def _owner(message: Message) -> str | None:
        """Return the process that alone may send a message; None for one of any process."""
        route = message.route
        role = route.sender
        if route.by_vehicles and role_of(message.sender) == VEHICLE:
            role = VEHICLE
        if role in (AGENT, VEHICLE):
            return f"{role}{getattr(message, route.number)}"
        return role


def matches(expression: str, key: str) -> bool:
    """Return whether a key expression of `Keys.subscriptions` covers a key.

    A trailing `*` is one chunk.
    """
    beginning, _, last = key.rpartition("/")
    return key == expression or (f"{beginning}/*" == expression and bool(last))
