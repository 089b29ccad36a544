"""Presence of a process in its run, and of the others, as liveliness tokens show them.

A process shows itself by two tokens: "alive", with the digest of its scenario and the version of its
protocol, once it can receive; "ready" once all that it waits for are alive. Both name its incarnation.
A process that takes part has one of these stages, which this file alone changes:

    CONNECTED  it receives, and no other knows of it
    ALIVE      the others know of it; what comes for its node is kept until it is ready
    READY      it takes part: the node has all that comes
    RENEWING   likewise, and its queue has a note to begin a new incarnation behind all that came before
    LEAVING    its last message is sent; it reads only until those that it waits for are gone

A process that was stopped for long reads messages of connections that have closed since, a roster
without it, and then that the coordinator is gone. Announced between the two, a new incarnation
would join the run and leave at once. Hence RENEWING, which begins only with a coordinator that answers.

The other processes are absent, alive, or have left; a "ready" token changes nothing here, but is an
event for the node. Tokens of different processes come in any order, and those of one process may as
well: the end of an old incarnation is not that of a newer one.
"""

from collections.abc import Callable, Collection, Mapping
from enum import Enum
from typing import Any

from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.session import BusError
from transport.protocol.wire.codec import VERSION
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import Keys, Token
from transport.protocol.wire.messages import Presence

# Time in which the coordinator answers a process that is about to return, and after which it is asked
# again, s.
ANSWER_S = 1.0


class Stage(Enum):
    """Stage of a process in its run."""

    CONNECTED = "connected"
    ALIVE = "alive"
    READY = "ready"
    RENEWING = "about to begin a new incarnation"
    LEAVING = "leaving"


class PresenceStep(Enum):
    """Step of a process from one stage to another."""

    ANNOUNCE = "announce"
    JOIN = "join"
    RENEW = "renew"
    BEGIN_ANEW = "begin a new incarnation"
    LEAVE = "leave"


# Next stage by stage and step. A pair that is not here is a defect of the caller.
STAGES: Mapping[Stage, Mapping[PresenceStep, Stage]] = {
    # One that fails before it has joined leaves as well.
    Stage.CONNECTED: {PresenceStep.ANNOUNCE: Stage.ALIVE, PresenceStep.LEAVE: Stage.LEAVING},
    Stage.ALIVE: {
        PresenceStep.ANNOUNCE: Stage.ALIVE,
        PresenceStep.JOIN: Stage.READY,
        PresenceStep.LEAVE: Stage.LEAVING,
    },
    Stage.READY: {PresenceStep.RENEW: Stage.RENEWING, PresenceStep.LEAVE: Stage.LEAVING},
    Stage.RENEWING: {
        # Removed from the roster once more before the first note was read.
        PresenceStep.RENEW: Stage.RENEWING,
        PresenceStep.BEGIN_ANEW: Stage.READY,
        PresenceStep.LEAVE: Stage.LEAVING,
    },
    # A note that is still in the queue: nothing begins any more.
    Stage.LEAVING: {PresenceStep.BEGIN_ANEW: Stage.LEAVING},
}


class OwnPresence:
    """Tokens of this process.

    `declare` shows a token to the others and returns it.

    Attributes:
        incarnation: Number of this start of the process, as announced.
    """

    def __init__(
        self, name: str, incarnation: int, digest: str, keys: Keys, declare: Callable[[str], Any]
    ) -> None:
        self.incarnation = incarnation
        self._name = name
        self._digest = digest
        self._keys = keys
        self._declare = declare
        self._stage = Stage.CONNECTED
        self._tokens: list[Any] = []
        self._newest = incarnation  # announced or noted in the queue
        self._asks_again_s = 0.0  # time before which the coordinator is not asked again

    @property
    def stage(self) -> Stage:
        """Stage in the run."""
        return self._stage

    @property
    def tokens(self) -> Collection[Any]:
        """Tokens that the others see."""
        return tuple(self._tokens)

    def announce(self) -> None:
        """Show the others that this process is there; once."""
        if self._stage is Stage.CONNECTED:
            self._show("alive")
        self._go(PresenceStep.ANNOUNCE)

    def join(self) -> None:
        """Show the others that this process takes part."""
        self._go(PresenceStep.JOIN)
        self._show("ready")

    def may_renew(self, incarnation: int, now_s: float) -> bool:
        """Return whether the coordinator is to be asked for a new incarnation now."""
        return incarnation != self._newest and now_s >= self._asks_again_s

    def delay_renewal(self, now_s: float) -> None:
        """Ask later: without an answer, seldom enough that this process goes on reading."""
        self._asks_again_s = now_s + ANSWER_S

    def renew(self, incarnation: int) -> None:
        """Note that the queue has a note of a new incarnation."""
        self._go(PresenceStep.RENEW)
        self._newest = incarnation

    def begin_anew(self, incarnation: int) -> None:
        """Replace the tokens by those of a new incarnation, ready at once, unless this process leaves.

        Of several notes only the newest counts.
        """
        if incarnation != self._newest:
            return
        self._go(PresenceStep.BEGIN_ANEW)
        if self._stage is Stage.LEAVING:
            return
        old = self._tokens
        self._tokens = []
        self.incarnation = incarnation
        self._show("alive")
        self._show("ready")
        for token in old:
            token.undeclare()

    def leave(self) -> None:
        """Note that the last message is sent."""
        self._go(PresenceStep.LEAVE)

    def _show(self, kind: str) -> None:
        if kind == "alive":
            key = self._keys.alive(self._name, self.incarnation, self._digest, VERSION)
        else:
            key = self._keys.ready(self._name, self.incarnation)
        self._tokens.append(self._declare(key))

    def _go(self, step: PresenceStep) -> None:
        following = STAGES[self._stage].get(step)
        if following is None:
            raise RuntimeError(f"{self._name} cannot {step.value} while it is {self._stage.value}")
        self._stage = following


class OtherPresences:
    """The processes that are up, as their tokens say.

    Attributes:
        alive: Incarnations of the processes that are up, by name; of this scenario and protocol.
        departed: Processes that were up, and are not any more.
    """

    def __init__(self, name: str, digest: str, keys: Keys, gate: Gate) -> None:
        self.alive: dict[str, int] = {}
        self.departed: set[str] = set()
        self._name = name
        self._digest = digest
        self._keys = keys
        self._gate = gate

    def take(self, key: str, *, is_there: bool) -> Presence | None:
        """Take in a token that appears or disappears; return the event for the node.

        A process takes part from "ready" on, and is gone with "alive".
        """
        token = self._token(key, is_there=is_there)
        if token is None:
            return None
        if token.digest is None:  # a "ready" token
            return Presence(token.name, token.incarnation, alive=True) if is_there else None
        if token.digest != self._digest or token.version != VERSION:
            return None  # it finds out by itself that it does not belong here
        if is_there:
            self.alive[token.name] = token.incarnation
            self.departed.discard(token.name)
            self._gate.announce(token.name, token.incarnation)
            return None
        if self.alive.get(token.name) == token.incarnation:
            del self.alive[token.name]
            self.departed.add(token.name)
        return Presence(token.name, token.incarnation, alive=False)

    def check(self, key: str, incarnation: int) -> None:
        """Refuse to join beside a process that does not fit this one, in its incarnation.

        Raises: BusError: it has the same name, or runs another scenario or protocol.
        """
        try:
            token = self._keys.token(key)
        except MessageError:
            return
        if token.digest is None:
            return
        if token.name == self._name and token.incarnation != incarnation:
            raise BusError(
                f"{self._name} is already running in this run (incarnation {token.incarnation})"
            )
        if token.version != VERSION:
            versions = f"version {token.version} of the protocol, {self._name} version {VERSION}"
            remedy = "install the same release on all hosts"
            raise BusError(f"{token.name} speaks {versions}: {remedy}")
        if token.digest != self._digest:
            remedy = "start all processes from the same file"
            raise BusError(f"{token.name} runs another scenario: {remedy}")

    def _token(self, key: str, *, is_there: bool) -> Token | None:
        """Return what a key says; a malformed one that appears is counted."""
        try:
            return self._keys.token(key)
        except MessageError as error:
            if is_there:
                self._gate.rejections.add(self._keys.end(key), error)
            return None
