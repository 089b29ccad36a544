"""The Zenoh bus: one session per process, liveliness in and out, and one queue of all that arrives, read by `next`."""

import json
import queue
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import psutil
import zenoh

from transport.protocol.admission.gate import Gate, Sample
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import (
    BusError,
    fetch_answer,
    in_bounded_time,
    log_errors,
    open_session,
)
from transport.protocol.wire.codec import VERSION
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.keys import RECORDER, Keys
from transport.protocol.wire.messages import Event, Message, Presence, Request
from transport.protocol.wire.names import COORDINATOR, PLANT, agent_name

# How often a process that joins asks for those that still take part in a run that has begun, and
# says that it waits; how long one waits at the end of the run for those that leave before it: a
# busy host may take seconds to read. s.
ASK_EVERY_S, WAITING_S, LINGER_S = 0.5, 5.0, 10.0


@dataclass(frozen=True, slots=True)
class Interrupted:
    """Event: a signal, or the parent process is gone."""

    reason: str


@dataclass(frozen=True, slots=True)
class Left:
    """Event for the recorder.

    A process has sent its last message, and all it has sent have arrived.
    """

    name: str


BusEvent = Event | Sample | Interrupted | Left
_Item = zenoh.Sample | zenoh.Query | Interrupted | Request


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A process's place in a run."""

    run: str
    endpoints: Endpoints
    incarnation: int = 0  # which start of this process
    join_timeout_s: float = (
        30.0  # how long it waits for the other processes, or a client for its router
    )


class Bus:
    """Connection of one process to one run.

    Processes with different digests of the scenario refuse each other.
    """

    def __init__(
        self,
        name: str,
        place: Place,
        digest: str,
        gate: Gate,
        *,
        serves: bool = False,  # whether its node answers requests; every process answers for its health
        patience_s: float = 1.0,  # how long sending waits for a peer that does not read, before its link is closed
        gather_s: float = 0.0,  # how long an arrival may wait for more: one wake-up for many messages costs less
    ) -> None:
        self.arrived_ns = (
            0  # wall-clock time of arrival of the last event that `next` returned, ns since 1970
        )
        self.before_wait: Callable[[], None] = lambda: (
            None
        )  # called when no message of a bundle is left to be read
        self.alive: dict[str, int] = {}  # incarnations of the processes that are up, by name
        self.gate = gate  # has the bundle that the last event came in
        self.name, self.incarnation, self._digest, self._place = (
            name,
            place.incarnation,
            digest,
            place,
        )
        self._keys = Keys(place.run)
        self._gather_s, self._serves = gather_s, serves
        self._left: set[str] = set()  # processes that were up, and are not any more
        self._accepted: Iterator[Message | Sample] = iter(())  # in the bytes that arrived last
        self._inbox: queue.SimpleQueue[tuple[int, _Item]] = (
            queue.SimpleQueue()
        )  # with the time of arrival
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._tokens: list[zenoh.LivelinessToken] = []
        log_errors(to_output=name != RECORDER)
        self._session = open_session(
            place.endpoints, patience_s, name, self._keys, place.join_timeout_s
        )
        # Subscribers before the token: a process that sees the token may send at once, and nothing
        # is lost. Their callback runs on the thread that receives, which must be brief, but saves a
        # second thread.
        arrived: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(
            self._put, indirect=False
        )
        self._declared: list[Any] = [
            self._session.declare_subscriber(key, arrived) for key in self._keys.subscriptions(name)
        ]
        self._declared.append(
            self._session.declare_queryable(self._keys.request(name, "*"), self._put)
        )
        self._declared += [
            self._session.liveliness().declare_subscriber(
                f"{self._keys.prefix}/{kind}/**", self._put, history=True
            )
            for kind in ("alive", "ready")
        ]

    def join(
        self, expected: Collection[str], on_wait: Callable[[str], object] = lambda _: None
    ) -> Interrupted | None:
        """Announce this process and wait until all expected ones are up, or for an interruption, which is returned.

        Raises: BusError: a process did not appear, runs another scenario or protocol, or has this
            name already.
        """
        self._declare_token(self._keys.alive(self.name, self.incarnation, self._digest, VERSION))
        timeout_s, ends = self._place.join_timeout_s, self._place.endpoints
        deadline, sign_s = time.monotonic() + timeout_s, time.monotonic() + WAITING_S
        awaited, is_begun, ask_s = set(expected) - {self.name}, False, 0.0
        early: list[tuple[int, _Item]] = []
        while True:
            now_s, missing = time.monotonic(), awaited - self.alive.keys()
            # When all are up, or the coordinator is ready, which has seen all, it is asked who
            # takes part.
            if self.name != COORDINATOR and now_s >= ask_s and (is_begun or not missing):
                awaited, ask_s = self._taking_part(expected) or awaited, now_s + ASK_EVERY_S
                missing = awaited - self.alive.keys()
            if not missing:
                break
            if now_s >= deadline and self._inbox.empty():
                at = (
                    ", ".join(ends.listen) or "nothing",
                    ", ".join(ends.connect) or "none: others connect to it",
                )
                absent = ", ".join(sorted(missing - self._left or missing))
                text = f"{self.name}: no sign of {absent} within {timeout_s:g} s"
                raise BusError(f"{text}; listening on {at[0]}, connecting to {at[1]}")
            if now_s >= sign_s:
                sign_s += WAITING_S
                on_wait(
                    f"waiting for {', '.join(sorted(missing))}; gives up in {deadline - now_s:.0f} s"
                )
            until_s = min(deadline, sign_s, ask_s if is_begun else deadline)
            try:
                at_ns, item = self._inbox.get(timeout=max(0.0, until_s - now_s))
            except queue.Empty:
                continue
            if isinstance(item, Interrupted):
                return item
            key = self._keys.end(str(item.key_expr)) if isinstance(item, zenoh.Sample) else ""
            is_begun |= key.startswith(f"ready/{COORDINATOR}/")
            if isinstance(item, zenoh.Sample) and key.startswith("alive/"):
                self._note(item, joins=True)
            elif request := self._request(item) if isinstance(item, zenoh.Query) else item:
                early.append((at_ns, request))
        self._declare_token(self._keys.ready(self.name, self.incarnation))
        for stamped in early:
            self._inbox.put(stamped)
        return None

    def _note(self, sample: zenoh.Sample, *, joins: bool = False) -> Presence | None:
        """Return the event in a token.

        A process takes part from "ready" on, is gone with "alive". Raises: `join`.
        """
        key, here = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        try:
            token = self._keys.token(key)
        except MessageError as error:
            if here:
                self.gate.rejections.add(self._keys.end(key), error)
            return None
        if token.digest is None:
            return Presence(token.name, token.incarnation, alive=True) if here else None
        if joins and here:
            if token.name == self.name and token.incarnation != self.incarnation:
                raise BusError(
                    f"{self.name} is already running in this run (incarnation {token.incarnation})"
                )
            if token.version != VERSION:
                spoken = f"{token.name} speaks version {token.version} of the protocol, {self.name} version {VERSION}"
                raise BusError(f"{spoken}: install the same release on all hosts")
            if token.digest != self._digest:
                raise BusError(
                    f"{token.name} runs another scenario: start all processes from the same file"
                )
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
        """Return the others that take part in a run that has begun, and its observers.

        None if it has not.
        """
        status = self.ask(COORDINATOR, "status", timeout_s=1.0)
        if status is None or status.get("tick", -1) < 0:
            return None
        team = {COORDINATOR, PLANT, *map(agent_name, status["members"])} & set(expected)
        return (team | set(status.get("observers", ()))) - {self.name}

    def renew(self, incarnation: int) -> None:
        """Announce a new incarnation of this process, which is ready at once."""
        old, self._tokens, self.incarnation = self._tokens, [], incarnation
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

    def put(self, key: str, data: bytes) -> None:
        """Send an encoded message under its key; block rather than drop it when a peer is slow."""
        if key not in self._publishers:
            self._publishers[key] = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        self._publishers[key].put(data)

    def next(self, timeout_s: float | None) -> BusEvent | None:
        """Return the next event, or None after the timeout (None.

        No timeout). Refused messages are only counted.
        """
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
            if (event := self._event(item)) is not None:
                return event

    def leave(self, after: Collection[str] = ()) -> None:
        """Say that the last message was sent.

        Wait for the recorder and others: closing drops what is not read yet.
        """
        self.put(self._keys.left(self.name), b"")
        deadline = time.monotonic() + LINGER_S
        while {RECORDER, *after} & set(self.alive) and (
            left_s := deadline - time.monotonic()
        ) > 0.0:
            if isinstance(self.next(left_s), Interrupted):
                return

    def interrupt(self, reason: str) -> None:
        """Wake `next` with an `Interrupted`; safe in a signal handler and from any thread."""
        self._put(Interrupted(reason))

    def close(self) -> None:
        """Undeclare everything and close the session, within bounded time."""
        in_bounded_time(
            *(declared.undeclare for declared in (*self._tokens, *self._declared)),
            self._session.close,
        )

    def _declare_token(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))

    def _request(self, query: zenoh.Query) -> Request | None:
        """Return a request from the network as an event, or None if it is answered here.

        Bad ones, and health.
        """
        key = str(query.key_expr)
        what = key.removeprefix(self._keys.request(self.name, ""))

        def reply(answer: Mapping[str, Any]) -> None:
            query.reply(key, json.dumps(answer))
            query.drop()  # type: ignore[no-untyped-call]

        given = None
        with suppress(ValueError, RecursionError, zenoh.ZError):
            given = json.loads(query.payload.to_string() if query.payload else "{}")
        if not isinstance(given, dict) or "/" in what or "*" in what:
            self.gate.rejections.add(
                self._keys.end(key), MessageError("malformed", "not a request")
            )
            reply({"error": "expected a JSON object under the key of one request"})
        elif what == "health":
            own = psutil.Process()
            known = {"name": self.name, "incarnation": self.incarnation, "protocol": VERSION}
            known |= {"tick": self.gate.tick, "refused": self.gate.rejections.total}
            used = {
                "memory_bytes": own.memory_info().rss,
                "threads": own.num_threads(),
                "open_files": own.num_fds(),
            }
            reply({**known, **used, "cpu_s": time.process_time()})
        elif self._serves:
            return Request(what, given, reply)
        else:
            reply(
                {
                    "error": f"what: expected health, the only request that {self.name} answers, got {what[:40]!r}"
                }
            )
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
