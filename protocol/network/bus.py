"""The Zenoh bus: one session per process, liveliness in and out, and one queue of all that arrives.

The thread that calls `next` handles it; Zenoh's threads only put it in.
"""

import json
import math
import queue
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import psutil
import zenoh

from protocol.admission.gate import Gate, Sample
from protocol.network.endpoints import Endpoints
from protocol.network.session import BusError, fetch_answer, in_bounded_time, log_errors, open_session
from protocol.wire.codec import VERSION, encode
from protocol.wire.errors import MessageError
from protocol.wire.keys import RECORDER, WATCHER, Keys
from protocol.wire.messages import Event, Message, Presence, Request
from protocol.wire.names import COORDINATOR, PLANT, agent_name

# How often a process that joins asks for those that still take part in a run that has begun, and says that it waits, s.
ASK_EVERY_S, WAITING_S = 0.5, 5.0
# How long a process waits at the end of the run for those that leave before it: a busy host may take seconds to read.
LINGER_S = 10.0


@dataclass(frozen=True, slots=True)
class Interrupted:
    """Event: a signal, or the parent process is gone."""

    reason: str


@dataclass(frozen=True, slots=True)
class Left:
    """Event for the recorder: a process has sent its last message, and all it has sent have arrived."""

    name: str


BusEvent = Event | Sample | Interrupted | Left
_Item = zenoh.Sample | zenoh.Query | Interrupted | Request


def usage(process: int | None = None) -> dict[str, float | int | None]:
    """Return memory (bytes), threads, open files and processor time (s) of a process, by default this one, or None."""
    found: tuple[float | int | None, ...] = (None,) * 4
    with suppress(psutil.Error):
        of = psutil.Process(process)
        found = of.memory_info().rss, of.num_threads(), of.num_fds(), sum(of.cpu_times()[:2])
    return dict(zip(("memory_bytes", "threads", "open_files", "cpu_s"), found, strict=True))


class Bus:
    """Connection of one process to one run; processes with different digests of the scenario refuse each other.

    Sending waits `patience_s` for a peer that does not read, then closes the link; a client looks for its router for
    `reach_s`. Raises: BusError: the endpoint cannot be listened on, the router not reached, or the keys not used.
    """

    def __init__(
        self,
        *,
        name: str,
        incarnation: int,
        run: str,
        digest: str,
        endpoints: Endpoints,
        gate: Gate,
        serves: bool = False,  # whether its node answers requests; every process answers for its health
        patience_s: float = 1.0,
        gather_s: float = 0.0,  # how long an arrival may wait for more: one wake-up for many messages costs less
        reach_s: float = 30.0,
    ) -> None:
        self.arrived_ns = 0  # wall-clock time of arrival of the last event that `next` returned, ns since 1970
        self.before_wait: Callable[[], None] = lambda: None  # called when no message of a bundle is left to be read
        self.alive: dict[str, int] = {}  # incarnations of the processes that are up, by name
        self.gate = gate  # has the bundle that the last event came in
        self.name, self.incarnation, self._digest = name, incarnation, digest
        self._keys, self._endpoints = Keys(run), endpoints
        self._gather_s, self._serves = gather_s, serves
        self._left: set[str] = set()  # processes that were up, and are not any more
        self._accepted: Iterator[Message | Sample] = iter(())  # in the bytes that arrived last
        self._inbox: queue.SimpleQueue[tuple[int, _Item]] = queue.SimpleQueue()  # with the time of arrival
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._tokens: list[zenoh.LivelinessToken] = []
        log_errors(to_output=name not in (RECORDER, WATCHER))
        self._session = open_session(endpoints, patience_s, name, self._keys, reach_s)
        # Subscribers before the token: a process that sees the token may send at once, and nothing is lost. Their
        # callback runs on the thread that receives, which must be brief, but saves a second thread.
        arrived: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(self._put, indirect=False)
        self._declared: list[Any] = [
            self._session.declare_subscriber(key, arrived) for key in self._keys.subscriptions(name)
        ]
        if name != WATCHER:  # a watcher has no token, so it is not asked either
            self._declared.append(self._session.declare_queryable(self._keys.request(name, "*"), self._put))
        self._declared += [
            self._session.liveliness().declare_subscriber(f"{self._keys.prefix}/{kind}/**", self._put, history=True)
            for kind in ("alive", "ready")
        ]

    def __enter__(self) -> "Bus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def join(
        self, expected: Collection[str], timeout_s: float, on_wait: Callable[[str], object] = lambda _: None
    ) -> Interrupted | None:
        """Announce this process and wait until all expected ones are up, or for an interruption, which is returned.

        Every `WAITING_S` seconds `on_wait` is called with a sentence about the missing ones.
        Raises: BusError: a process did not appear, runs another scenario or protocol, or has this name already.
        """
        self._declare_token(self._keys.alive(self.name, self.incarnation, self._digest, VERSION))
        deadline, sign_s = time.monotonic() + timeout_s, time.monotonic() + WAITING_S
        awaited = set(expected) - {self.name}
        # When all are up, or the coordinator is ready, which has seen all, it is asked whether the run has begun.
        asks, ask_s = self.name != COORDINATOR, math.inf
        early: list[tuple[int, _Item]] = []
        while True:
            now_s = time.monotonic()
            if now_s >= ask_s or (asks and awaited <= self.alive.keys()):
                asks = False
                awaited, ask_s = self._taking_part(expected) or awaited, now_s + ASK_EVERY_S
            missing = awaited - self.alive.keys()
            if not missing:
                break
            if now_s >= sign_s:
                sign_s += WAITING_S
                on_wait(f"waiting for {', '.join(sorted(missing))}; gives up in {max(0.0, deadline - now_s):.0f} s")
            try:
                at_ns, item = self._inbox.get(timeout=max(0.0, min(deadline, sign_s, ask_s) - now_s))
            except queue.Empty:
                if time.monotonic() < deadline:
                    continue
                listens, calls = (", ".join(at) for at in (self._endpoints.listen, self._endpoints.connect))
                ends = f"listening on {listens or 'nothing'}, connecting to {calls or 'none: others connect to it'}"
                absent = ", ".join(sorted(missing - self._left or missing))
                raise BusError(f"{self.name}: no sign of {absent} within {timeout_s:g} s; {ends}") from None
            if isinstance(item, Interrupted):
                return item
            key = self._keys.end(str(item.key_expr)) if isinstance(item, zenoh.Sample) else ""
            if isinstance(item, zenoh.Query):
                request = self._request(item)
                early += [(at_ns, request)] if request is not None else []
            elif isinstance(item, zenoh.Sample) and key.startswith("alive/"):
                self._note(item, joins=True)
            else:
                early.append((at_ns, item))
                ask_s = 0.0 if key.startswith(f"ready/{COORDINATOR}/") else ask_s
        self._declare_token(self._keys.ready(self.name, self.incarnation))
        for stamped in early:
            self._inbox.put(stamped)
        return None

    def _note(self, sample: zenoh.Sample, *, joins: bool = False) -> Presence | None:
        """Return the event in a token: a process takes part from "ready" on, is gone with "alive". Raises: `join`."""
        key, here = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        try:
            token = self._keys.token(key)
        except MessageError as error:
            if here:
                self.gate.refuse(self._keys.end(key), error)
            return None
        if token.digest is None:
            return Presence(token.name, token.incarnation, alive=True) if here else None
        if joins and here:
            if token.name == self.name and token.incarnation != self.incarnation:
                raise BusError(f"{self.name} is already running in this run (incarnation {token.incarnation})")
            if token.version != VERSION:
                spoken = f"{token.name} speaks version {token.version} of the protocol, {self.name} version {VERSION}"
                raise BusError(f"{spoken}: install the same release on all hosts")
            if token.digest != self._digest:
                raise BusError(f"{token.name} runs another scenario: start all processes from the same file")
        if token.digest != self._digest or token.version != VERSION:
            return None  # a process of another scenario finds out by itself that it does not belong here
        if here:
            self.alive[token.name] = token.incarnation
            self._left.discard(token.name)
            self.gate.announce(token.name, token.incarnation)
            return None
        if self.alive.get(token.name) == token.incarnation:
            del self.alive[token.name]
            self._left.add(token.name)
        return Presence(token.name, token.incarnation, alive=False)

    def _taking_part(self, expected: Collection[str]) -> set[str] | None:
        """Return the others that take part in a run that has begun, and its observers; None if it has not."""
        status = self.ask(COORDINATOR, "status", timeout_s=1.0)
        if status is None or status.get("tick", -1) < 0:
            return None
        team = {COORDINATOR, PLANT, *map(agent_name, status["members"])} & set(expected)
        return (team | set(status.get("observers", ()))) - {self.name}

    def renew(self, incarnation: int) -> None:
        """Announce a new incarnation of this process, which is ready at once."""
        old, self._tokens = self._tokens, []
        self.incarnation = incarnation
        self.gate.announce(self.name, incarnation)
        self._declare_token(self._keys.alive(self.name, incarnation, self._digest, VERSION))
        self._declare_token(self._keys.ready(self.name, incarnation))
        for token in old:
            token.undeclare()  # type: ignore[no-untyped-call]

    def ask(
        self, name: str, what: str, given: Mapping[str, Any] | None = None, timeout_s: float = 5.0
    ) -> Mapping[str, Any] | None:
        """Send a request to a process; return its answer, or None if there is none in time."""
        return fetch_answer(self._session, self._keys.request(name, what), given or {}, timeout_s)

    def publish(self, message: Message) -> None:
        """Send a message to its subscribers."""
        self.put(self._keys.of(message), encode(message))

    def put(self, key: str, data: bytes) -> None:
        """Send an encoded message under its key; block rather than drop it when a peer is slow."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        publisher.put(data)

    def next(self, timeout_s: float | None) -> BusEvent | None:
        """Return the next event, or None after the timeout (None: no timeout). Refused messages are only counted."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            for message in self._accepted:
                return message
            self.before_wait()
            if self._gather_s > 0.0 and self._inbox.empty():
                time.sleep(self._gather_s)
            try:
                left_s = None if deadline is None else max(0.0, deadline - time.monotonic())
                self.arrived_ns, item = self._inbox.get(timeout=left_s)
            except queue.Empty:
                return None
            event = self._event(item)
            if event is not None:
                return event

    def leave(self, after: Collection[str] = ()) -> None:
        """Say that the last message was sent; wait `LINGER_S` at most until the recorder and others have left.

        Closing a session drops what a peer has not read yet.
        """
        self.put(self._keys.left(self.name), b"")
        deadline = time.monotonic() + LINGER_S
        while {RECORDER, *after} & set(self.alive) and time.monotonic() < deadline:
            if isinstance(self.next(max(0.0, deadline - time.monotonic())), Interrupted):
                return

    def interrupt(self, reason: str) -> None:
        """Wake `next` with an `Interrupted`; safe in a signal handler and from any thread."""
        self._put(Interrupted(reason))

    def close(self) -> None:
        """Undeclare everything and close the session, within bounded time."""
        in_bounded_time(self._close)

    def _close(self) -> None:
        for declared in (*self._tokens, *self._declared):
            declared.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]

    def _declare_token(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))

    def _request(self, query: zenoh.Query) -> Request | None:
        """Return a request from the network as an event, or None if it is answered here: bad ones, and health."""
        key = str(query.key_expr)
        what = key.removeprefix(self._keys.request(self.name, ""))

        def reply(answer: Mapping[str, Any]) -> None:
            query.reply(key, json.dumps(answer))
            query.drop()  # type: ignore[no-untyped-call]

        given = None
        with suppress(ValueError, RecursionError, zenoh.ZError):
            given = json.loads(query.payload.to_string()) if query.payload is not None else {}
        if not isinstance(given, dict) or "/" in what or "*" in what:
            self.gate.refuse(self._keys.end(key), MessageError("malformed", "not a request"))
            query.reply_err(json.dumps({"error": "expected a JSON object under the key of one request"}))
            query.drop()  # type: ignore[no-untyped-call]
            return None
        if what == "health":
            seen = {"protocol": VERSION, "tick": self.gate.tick, "refused": self.gate.rejections.total}
            reply({"name": self.name, "incarnation": self.incarnation, **seen, **usage()})
        elif self._serves:
            return Request(what, given, reply)
        else:
            reply({"error": f"what: expected health, the only request that {self.name} answers, got {what[:40]!r}"})
        return None

    def _put(self, item: _Item) -> None:
        self._inbox.put((time.time_ns(), item))

    def _event(self, item: _Item) -> BusEvent | None:
        if isinstance(item, Interrupted | Request):  # a request came while this process joined
            return item
        if isinstance(item, zenoh.Query):
            return self._request(item)
        key = str(item.key_expr)
        if self._keys.end(key).startswith(("alive/", "ready/")):
            return self._note(item)
        name = key.removeprefix(self._keys.left(""))
        if name != key:
            return Left(name)
        self._accepted = self.gate.accept(key, item.payload.to_bytes())
        return None
