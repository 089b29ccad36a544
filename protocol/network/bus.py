"""The Zenoh bus: one session per process, one inbox, liveliness in and out.

Everything that arrives (messages, tokens, signals) goes through one queue in arrival order and is handled
by the one thread that asks for it; Zenoh's own threads only enqueue.
"""

import json
import queue
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import zenoh

from protocol.admission.admission import Admission
from protocol.admission.rate_limit import RateLimit
from protocol.network.health import Offset, usage
from protocol.network.session import CLOSE_S, BusError, Endpoints, asked, in_bounded_time, log_errors, open_session
from protocol.wire.codec import VERSION, encode
from protocol.wire.keys import WATCHER, Keys
from protocol.wire.messages import Event, Message, MessageError, Presence, Request

# How long messages that are all refused may keep a process from what it has to do at a certain time.
_FLOOD_S = 0.01

# How often a process that joins a run that has begun asks whom it still has to wait for.
_ASK_EVERY_S = 0.5


@dataclass(frozen=True, slots=True)
class Interrupted:
    """Event: a signal, or the parent process is gone."""

    reason: str


BusEvent = Event | Interrupted


@dataclass(frozen=True, slots=True)
class _Oversized:
    """In the place of a sample that is too large to be kept."""

    key_expr: str
    size: int


class Bus:
    """One process's place on the network of one run.

    Args:
        name: Process name: "coordinator", "plant", "agent1", "recorder".
        incarnation: Which start of this process.
        run: Name of the run, part of every key.
        digest: Fingerprint of the scenario; processes with different ones refuse each other.
        endpoints: Where to listen and whom to connect to.
        admission: What it lets in; refuses and counts the rest.
        serves: Whether its node answers requests (`ask`); how it is, every process says.
        patience_s: How long sending may wait for a peer that does not read before the link to it is closed.
        gather_s: How long what comes may wait for more of it: waking up once for many messages costs less.
        reach_s: How long a client looks for its router.

    Attributes:
        arrived_ns: Wall-clock time at which the last event that `next` returned came in, ns since 1970.
        offset: By how much the coordinator's wall clock is ahead of this one, once this process has joined.

    Raises: BusError: the endpoint cannot be listened on, the router not reached, or the keys not used.
    """

    def __init__(
        self,
        *,
        name: str,
        incarnation: int,
        run: str,
        digest: str,
        endpoints: Endpoints,
        admission: Admission,
        serves: bool = False,
        patience_s: float = 1.0,
        gather_s: float = 0.0,
        reach_s: float = 30.0,
    ) -> None:
        self.arrived_ns = 0
        self.offset: Offset | None = None
        self._gather_s, self._serves = gather_s, serves
        self.name, self.incarnation, self._digest = name, incarnation, digest
        self._keys = Keys(run)
        self._endpoints = endpoints
        self._inbox: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()  # with the time of arrival
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._tokens: list[zenoh.LivelinessToken] = []
        self.admission, self._rate_limit = admission, RateLimit()
        log_errors(to_output=name not in ("recorder", WATCHER))
        self._session = open_session(endpoints, patience_s, name, self._keys, reach_s)
        # Subscribers before the token: whoever sees the token may send at once, and nothing is lost.
        self._subscribers = [
            self._session.declare_subscriber(key, _directly(self._arrived)) for key in self._keys.subscriptions(name)
        ]
        # Whoever looks on is not known to be there, so it is not asked either.
        asked = self._keys.request(name, "*")
        self._queryable = None if name == WATCHER else self._session.declare_queryable(asked, self._put)
        self._watch = self._session.liveliness().declare_subscriber(
            f"{self._keys.prefix}/alive/**", self._put, history=True
        )
        self._watch_ready = self._session.liveliness().declare_subscriber(
            f"{self._keys.prefix}/ready/**", self._put, history=True
        )
        self._alive: dict[str, int] = {}  # incarnations of the processes that are up, by name

    def __enter__(self) -> "Bus":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def join(self, expected: Collection[str], timeout_s: float) -> Interrupted | None:
        """Announce this process and wait until it has seen every expected one.

        Args:
            expected: Names of the processes to wait for.
            timeout_s: How long.
        Returns: None when everybody is there, or the interruption that came first.
        Raises: BusError: somebody did not show up, runs another scenario, or runs under this name already.
        """
        self._declare(self._keys.alive(self.name, self.incarnation, self._digest, VERSION))
        deadline = time.monotonic() + timeout_s
        early: list[tuple[int, Any]] = []
        begun = False  # the run: the coordinator has seen everybody once
        asked = self.name == "coordinator"  # it knows
        while (missing := set(expected) - set(self._alive) - {self.name}) or not asked:
            if not missing:
                # Everybody may have been there for long, in a run that has begun; then whoever records it is, too.
                asked, still = True, self._still_expected(expected)
                begun, expected = begun or still is not expected, still
                continue
            left_s = deadline - time.monotonic()
            try:
                at_ns, item = self._inbox.get(timeout=max(0.0, min(left_s, _ASK_EVERY_S) if begun else left_s))
            except queue.Empty:
                if begun and left_s > 0.0:
                    expected = self._still_expected(expected)
                    continue
                called = ", ".join(self._endpoints.connect) or "none: it is called"
                raise BusError(
                    f"{self.name}: no sign of {', '.join(sorted(missing))} within {timeout_s:g} s; "
                    f"listening on {', '.join(self._endpoints.listen) or 'nothing'}, connecting to {called}"
                ) from None
            if isinstance(item, Interrupted):
                return item
            if isinstance(item, zenoh.Query):
                request = self._request(item, at_ns)
                if request is not None:
                    early.append((at_ns, request))
            elif not self._note_alive(item):
                early.append((at_ns, item))
                if self._keys.is_ready(str(item.key_expr), "coordinator"):
                    begun = True
                    expected = self._still_expected(expected)
        if self.name != "coordinator":
            self.offset = Offset.measured(lambda: self.ask("coordinator", "health", timeout_s=1.0))
        self._declare(self._keys.ready(self.name, self.incarnation))
        for stamped in early:
            self._inbox.put(stamped)
        return None

    def renew(self, incarnation: int) -> None:
        """Announce that this process has started anew by itself, ready at once."""
        old, self._tokens = self._tokens, []
        self.incarnation = incarnation
        self.admission.announce(self.name, incarnation)
        self._declare(self._keys.alive(self.name, incarnation, self._digest, VERSION))
        self._declare(self._keys.ready(self.name, incarnation))
        for token in old:
            token.undeclare()  # type: ignore[no-untyped-call]

    def ask(
        self, name: str, what: str, given: Mapping[str, Any] | None = None, timeout_s: float = 5.0
    ) -> Mapping[str, Any] | None:
        """Ask a process for something and wait for its answer, or None if it does not give one in time."""
        return asked(self._session, self._keys.request(name, what), given or {}, timeout_s)

    def publish(self, message: Message) -> None:
        """Send a message to whoever listens; blocks rather than drops when a peer is slow."""
        key = self._keys.of(message)
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        publisher.put(encode(message))

    def next(self, timeout_s: float | None) -> BusEvent | None:
        """The next event, or None after the timeout (None waits for ever). Bad messages are counted, not returned."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self.admission.count_unread()
        while True:
            kept = self.admission.released()
            if kept is not None:
                return kept
            if self._gather_s > 0.0 and self._inbox.empty():
                time.sleep(self._gather_s)
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            try:
                self.arrived_ns, item = self._inbox.get(timeout=left)
            except queue.Empty:
                return None
            event: BusEvent | None
            if isinstance(item, Interrupted):
                event = item
            elif isinstance(item, zenoh.Query):
                event = self._request(item, self.arrived_ns)
            else:
                event = self._event(item)
            if event is not None:
                return event
            if deadline is not None and time.monotonic() > deadline + _FLOOD_S:
                return None

    def wait_gone(self, names: Collection[str]) -> None:
        """Wait, within bounded time, until the named processes have left: what was said last has reached them."""
        deadline = time.monotonic() + CLOSE_S
        while set(names) & set(self._alive) and time.monotonic() < deadline:
            self.next(max(0.0, deadline - time.monotonic()))

    def interrupt(self, reason: str) -> None:
        """Wake `next` with an `Interrupted`; safe in a signal handler and from any thread."""
        self._put(Interrupted(reason))

    def close(self) -> None:
        """Undeclare everything and close the session, within bounded time."""
        in_bounded_time(self._close)

    def _close(self) -> None:
        for token in self._tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
        if self._queryable is not None:
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
        for subscriber in [self._watch, self._watch_ready, *self._subscribers]:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]

    def _declare(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))

    def _still_expected(self, expected: Collection[str]) -> Collection[str]:
        """Whom to wait for: of a run that has begun only those who take part, for the others may be gone for good."""
        status = self.ask("coordinator", "status", timeout_s=1.0)
        if status is None or status.get("tick", -1) < 0:
            return expected
        team = {"coordinator", "plant", *(f"agent{agent}" for agent in status["members"])} & set(expected)
        return team | set(status.get("observers", ()))  # nor may the record miss what this process says first

    def health(self) -> dict[str, Any]:
        """How this process is: what it knows of itself, as plain data (docs/protocol.md)."""
        return {
            "name": self.name,
            "incarnation": self.incarnation,
            "protocol": VERSION,
            "tick": self.admission.tick,
            "refused": self.admission.refused,
            "clock_offset_s": None if self.offset is None else self.offset.ahead_s,
            "clock_uncertainty_s": None if self.offset is None else self.offset.uncertainty_s,
            **usage(),
        }

    def _request(self, query: zenoh.Query, at_ns: int) -> Request | None:
        """A question from the network as an event; how this process is, is answered here."""
        key = str(query.key_expr)
        what = key.removeprefix(self._keys.request(self.name, ""))

        def reply(answer: Mapping[str, Any]) -> None:
            query.reply(key, json.dumps(answer))
            query.drop()  # type: ignore[no-untyped-call]

        try:
            given = json.loads(query.payload.to_string()) if query.payload is not None else {}
            if not isinstance(given, dict) or "/" in what or "*" in what:
                raise MessageError("malformed", "expected a JSON object under the key of one thing")
        except (ValueError, RecursionError, MessageError, zenoh.ZError) as error:
            text = f"not a request ({type(error).__name__})"
            self.admission.refuse(key, MessageError("malformed", text))
            query.reply_err(json.dumps({"error": "expected a JSON object, under the key of what is asked for"}))
            query.drop()  # type: ignore[no-untyped-call]
            return None
        if what == "health":
            reply({**self.health(), "asked_ns": at_ns, "answered_ns": time.time_ns()})
            return None
        if not self._serves:
            reply({"error": f"expected health, the one thing {self.name} can be asked for, got {what[:40]!r}"})
            return None
        return Request(what, given, reply)

    def _arrived(self, sample: zenoh.Sample) -> None:
        """On a thread of Zenoh's, which holds up the one that works: put a sample into the inbox.

        Unless it is too large to wait there; or, where more come than any run has, is over.
        """
        flooded = self._rate_limit.flooded()
        size = len(sample.payload)
        if size > self.admission.max_bytes:
            self._put(_Oversized(str(sample.key_expr), size))
        elif flooded and self.admission.has_passed(str(sample.key_expr), sample.payload.to_bytes()):
            self._rate_limit.hold()
        else:
            self._put(sample)

    def _put(self, item: Any) -> None:
        self._inbox.put((time.time_ns(), item))

    def _event(self, sample: zenoh.Sample | _Oversized | Request) -> Event | None:
        if isinstance(sample, Request):  # came while this process joined
            return sample
        key = str(sample.key_expr)
        if isinstance(sample, _Oversized):
            self.admission.refuse(key, self.admission.oversized(sample.size))
            return None
        if self._keys.is_token(key):
            return self._presence(key, here=sample.kind == zenoh.SampleKind.PUT)
        return self.admission.read(key, sample.payload.to_bytes())

    def _presence(self, key: str, *, here: bool) -> Presence | None:
        """What a token that has appeared or disappeared says about its process."""
        try:
            token = self._keys.token(key)
        except MessageError as error:
            if here:
                self.admission.refuse(key, error)
            return None
        if token.digest is None:
            return Presence(token.name, token.incarnation, alive=True) if here else None
        if token.digest != self._digest or token.version != VERSION:
            return None  # of another scenario: it finds out by itself that it does not belong here
        if here:
            self._alive[token.name] = token.incarnation
            self.admission.announce(token.name, token.incarnation)
            return None
        if self._alive.get(token.name) == token.incarnation:
            del self._alive[token.name]
        return Presence(token.name, token.incarnation, alive=False)

    def _note_alive(self, item: zenoh.Sample | _Oversized) -> bool:
        """Take in one liveliness sample while joining; False for anything else."""
        key = str(item.key_expr)
        if isinstance(item, _Oversized) or not key.startswith(f"{self._keys.prefix}/alive/"):
            return False
        here = item.kind == zenoh.SampleKind.PUT
        try:
            token = self._keys.token(key)
        except MessageError:
            token = None
        if here and token is not None:
            if token.name == self.name and token.incarnation != self.incarnation:
                raise BusError(f"{self.name} is already running in this run (incarnation {token.incarnation})")
            if token.digest is not None and token.version != VERSION:
                raise BusError(
                    f"{token.name} speaks version {token.version} of the protocol, {self.name} version {VERSION}: "
                    f"install the same release on all hosts"
                )
            if token.digest != self._digest:
                raise BusError(
                    f"{token.name} flies another scenario (digest {token.digest}, here {self._digest}): "
                    f"start all from the same file"
                )
        self._presence(key, here=here)
        return True


def _directly(callback: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """A callback on the thread that receives, which has to be short: otherwise each message passes through one more."""
    return zenoh.handlers.Callback(callback, indirect=False)
