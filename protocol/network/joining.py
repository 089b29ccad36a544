"""Joining a run: the processes that are up, and those a joining process still waits for."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

from protocol.admission.gate import Gate
from protocol.network.session import BusError
from protocol.wire.codec import VERSION
from protocol.wire.keys import Keys
from protocol.wire.messages import MessageError, Presence
from protocol.wire.names import COORDINATOR, PLANT

# How often a process that joins a run that has begun asks for the processes that still take part.
ASK_EVERY_S = 0.5
# Interval between two signs of life of a process that waits for others, s.
WAITING_S = 5.0


def absent(missing: Collection[str], left: Collection[str]) -> str:
    """Return which of the missing processes gave no sign, or else which have left.

    A process that has left was there and gave up waiting for the others itself: it is not the one to look for.
    """
    silent = sorted(set(missing) - set(left))
    return f"no sign of {', '.join(silent)}" if silent else f"{', '.join(sorted(missing))} came and left"


def waiting_for(missing: Collection[str], left: Collection[str], left_s: float) -> str:
    """Return a sentence about the processes that one waits for, as in `absent`, and the time left, s."""
    names = sorted(set(missing) - set(left)) or sorted(missing)
    return f"waiting for {', '.join(names)}; gives up in {max(0.0, left_s):.0f} s"


class Peers:
    """The processes of a run that are up, by their liveliness tokens.

    The gate learns of each new incarnation of a process, and counts bad tokens.

    Attributes:
        alive: Incarnations of the processes that are up, by name.
        left: Processes that were up, and are not any more.
    """

    def __init__(self, name: str, incarnation: int, digest: str, keys: Keys, gate: Gate) -> None:
        self.alive: dict[str, int] = {}
        self.left: set[str] = set()
        self._name, self._incarnation, self._digest = name, incarnation, digest
        self._keys, self._gate = keys, gate

    def check(self, key: str) -> None:
        """Check the token of another process while this one joins.

        Raises: BusError: the token shows another scenario, protocol version, or a process with this one's name.
        """
        try:
            token = self._keys.token(key)
        except MessageError:
            return  # counted by `note`
        if token.name == self._name and token.incarnation != self._incarnation:
            raise BusError(f"{self._name} is already running in this run (incarnation {token.incarnation})")
        if token.digest is not None and token.version != VERSION:
            raise BusError(
                f"{token.name} speaks version {token.version} of the protocol, {self._name} version {VERSION}: "
                f"install the same release on all hosts"
            )
        if token.digest != self._digest:
            raise BusError(
                f"{token.name} runs another scenario (digest {token.digest}, here {self._digest}): "
                f"start all from the same file"
            )

    def note(self, key: str, *, here: bool) -> Presence | None:
        """Take note of a token that has appeared or disappeared.

        Returns: The event for the node, or None: a process takes part from its "ready" token on, not from "alive" on.
        """
        try:
            token = self._keys.token(key)
        except MessageError as error:
            if here:
                self._gate.refuse(self._keys.end(key), error)
            return None
        if token.digest is None:
            return Presence(token.name, token.incarnation, alive=True) if here else None
        if token.digest != self._digest or token.version != VERSION:
            return None  # a process of another scenario finds out by itself that it does not belong here
        if here:
            self.alive[token.name] = token.incarnation
            self.left.discard(token.name)
            self._gate.announce(token.name, token.incarnation)
            return None
        if self.alive.get(token.name) == token.incarnation:
            del self.alive[token.name]
            self.left.add(token.name)
        return Presence(token.name, token.incarnation, alive=False)


class Expected:
    """The processes that a joining process waits for.

    A run that has begun goes on without processes that are gone for good; the coordinator knows which take part.
    `status` asks it for the status of the run, and returns None without an answer.

    Attributes:
        has_begun: Whether the run has begun: `update` is then to be called every `ASK_EVERY_S`.
    """

    def __init__(self, name: str, expected: Collection[str], status: Callable[[], Mapping[str, Any] | None]) -> None:
        self.has_begun = False
        self._name, self._names, self._status = name, set(expected) - {name}, status
        self._has_asked = name == COORDINATOR  # it needs no answer

    def missing(self, alive: Collection[str]) -> set[str]:
        """Return the processes still to come.

        When all are up, the coordinator is asked once: the run may have begun, and may have observers besides.
        """
        if not self._has_asked and self._names <= set(alive):
            self._has_asked = True
            self.update()
        return self._names - set(alive)

    def update(self) -> None:
        """Ask the coordinator; in a run that has begun wait only for the processes that take part, and observers."""
        status = self._status()
        if status is None or status.get("tick", -1) < 0:
            return
        self.has_begun = True
        # Observers, so that the record misses nothing this process sends.
        team = {COORDINATOR, PLANT, *(f"agent{agent}" for agent in status["members"])} & self._names
        self._names = (team | set(status.get("observers", ()))) - {self._name}
