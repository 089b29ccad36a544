"""The Zenoh bus: one session per process, liveliness in and out, one queue of all that arrives.

Zenoh's callbacks, signal handlers and other threads only add items to the queue. The thread of the node
takes them out: with `join` until all expected processes are up, then with `next`, and at the end with
`leave`. The stage of the process in between is that of its tokens (`protocol.network.presence`: CONNECTED,
ALIVE, READY, RENEWING, LEAVING), and the bus has no state beside it but the order of its items:

    item in the queue            in `join`                        in `next`
    ---------------------------  -------------------------------  ----------------------------------
    message                      kept for `next`                  through the gate, one by one
    token "alive" appears        must fit this process (or        taken in
                                 BusError), then taken in
    token "alive" disappears     taken in                         event: the process is gone
    token "ready" appears        kept; the coordinator's starts   event: the process takes part
                                 the questions who takes part
    note that one has left       kept for `next`                  event, for the recorder
    request for the health       answered                         answered
    another request              kept for `next`, if it serves    event, if it serves
    interruption                 ends the wait                    event
    note of a new incarnation    none: only READY processes       new tokens, and the gate knows them
                                 renew

`leave` reads as `next`, drops all events, and ends with an interruption, with the processes that it waits
for, or after `LINGER_S`. Three orders hold:

    Subscriptions are declared before the token: who sees the token may send at once, and nothing is lost.
    What `join` keeps is older than all in the queue, and `next` gives it first.
    A new incarnation is announced by a note in the queue: behind all that came before it.
"""

import queue
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import zenoh

from transport.protocol.admission.acceptance_and_refusals import Accepted, Gate
from transport.protocol.network.bus_events_and_clock import (
    Arrival,
    BusEvent,
    BusOptions,
    Departed,
    Interrupted,
    Place,
    SteadyClock,
)
from transport.protocol.network.joining import ASK_EVERY_S, Joining
from transport.protocol.network.presence import ANSWER_S, OtherPresences, OwnPresence
from transport.protocol.network.requests_and_answers import Requests
from transport.protocol.network.session import (
    BusError,
    fetch_answer,
    in_bounded_time,
    log_errors,
    open_session,
)
from transport.protocol.wire.key_expressions import RECORDER, Keys
from transport.protocol.wire.messages import Presence, Request
from transport.protocol.wire.names import COORDINATOR, PLANT, VEHICLE, agent_name, role_of

# Time that a process waits at the end of the run for those that leave before it, s: a busy host may
# take seconds to read.
LINGER_S = 10.0


@dataclass(frozen=True, slots=True)
class _Renewal:
    """A new incarnation of this process, to be announced once all that came before is read."""

    incarnation: int


_Item = zenoh.Sample | zenoh.Query | Interrupted | Request | _Renewal


class Bus:
    """Connection of one process to one run.

    Processes with different digests of the scenario refuse each other.

    Attributes:
        before_wait: Called when no message of a bundle is left to be read.
        alive: Incarnations of the processes that are up, by name.
        gate: Checks of the received messages.
    """

    def __init__(
        self, name: str, place: Place, digest: str, gate: Gate, options: BusOptions | None = None
    ) -> None:
        self.name = name
        self.gate = gate
        self.before_wait: Callable[[], None] = lambda: None

        self._place = place
        self._options = options or BusOptions()
        self._keys = Keys(place.run)
        self._clock = SteadyClock()
        self._inbox: queue.SimpleQueue[tuple[int, _Item]] = queue.SimpleQueue()
        # What came for the node before this process had joined: older than all in the inbox.
        self._early: deque[tuple[int, _Item]] = deque()
        # Accepted messages in the bytes that arrived last, and the time of their arrival.
        self._accepted: Iterator[Accepted] = iter(())
        self._arrived_ns = 0
        self._publishers: dict[str, zenoh.Publisher] = {}

        log_errors(to_output=name != RECORDER)
        self._session = open_session(
            place.endpoints, self._options.patience_s, name, self._keys, place.join_timeout_s
        )
        self._own = OwnPresence(
            name,
            place.incarnation,
            digest,
            self._keys,
            self._session.liveliness().declare_token,
        )
        self._others = OtherPresences(name, digest, self._keys, gate)
        self._requests = Requests(name, self._keys, gate, serves=self._options.serves)
        self._declared = self._subscribe()

    @property
    def incarnation(self) -> int:
        """Number of this start of the process, as announced."""
        return self._own.incarnation

    @property
    def alive(self) -> Mapping[str, int]:
        """Incarnations of the processes that are up, by name."""
        return self._others.alive

    def _subscribe(self) -> list[Any]:
        """Declare all that receives.

        Before the token: a process that sees the token may send at once, and nothing is lost.
        """
        # The callback runs on the thread that receives, which must be brief, but saves a second
        # thread.
        arrived: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(
            self._put, indirect=False
        )
        declared: list[Any] = [
            self._session.declare_subscriber(key, arrived)
            for key in self._keys.subscriptions(self.name)
        ]
        requests = self._keys.request(self.name, "*")
        declared.append(self._session.declare_queryable(requests, self._put))
        liveliness = self._session.liveliness()
        for kind in ("alive", "ready"):
            tokens = f"{self._keys.prefix}/{kind}/**"
            declared.append(liveliness.declare_subscriber(tokens, self._put, history=True))
        return declared

    def announce(self) -> None:
        """Show the others that this process is there, before it is ready; once."""
        self._own.announce()

    def join(
        self,
        expected: Collection[str],
        on_wait: Callable[[str], object] = lambda _: None,
        is_starting: Callable[[str], bool] = lambda _: False,
    ) -> Interrupted | None:
        """Announce this process and wait until all expected ones are up, or for an interruption.

        Args:
            expected: Names of the processes.
            on_wait: Told of processes not there yet.
            is_starting: Whether a missing process, by name, is known to be on its way when the time
                is up: the wait then begins anew.

        Returns: The interruption, if one came. Raises: BusError: a process did not appear, runs
            another scenario or protocol, or has this name already.
        """
        self.announce()
        others = set(expected) - {self.name}
        timeout_s = self._place.join_timeout_s
        joining = Joining(others, time.monotonic(), timeout_s, self._options.tell_every_s)

        while True:
            now_s = time.monotonic()
            if self.name != COORDINATOR and joining.should_ask(now_s, self.alive):
                joining.restrict(self._taking_part(expected), now_s + ASK_EVERY_S)
            missing = joining.missing(self.alive)
            if not missing:
                break
            if joining.is_over(now_s) and self._inbox.empty():
                if all([is_starting(name) for name in sorted(missing)]):
                    joining.extend(now_s)
                    continue
                raise self._error_of_missing(missing)
            if joining.should_tell(now_s):
                on_wait(joining.words(missing, now_s))

            try:
                at_ns, item = self._inbox.get(timeout=joining.pause_s(now_s))
            except queue.Empty:
                continue
            if isinstance(item, Interrupted):
                return item
            later = self._take_while_joining(item, joining)
            if later is not None:
                self._early.append((at_ns, later))

        self._own.join()
        return None

    def _take_while_joining(
        self, item: zenoh.Sample | zenoh.Query | Request | _Renewal, joining: Joining
    ) -> zenoh.Sample | Request | _Renewal | None:
        """Take in an item that arrives while this process joins; return it if its node needs it.

        Such are requests, messages, and the tokens of processes that are ready before this one.
        """
        if isinstance(item, zenoh.Query):
            return self._requests.take(item, self.incarnation)
        if not isinstance(item, zenoh.Sample):
            return item
        key = self._keys.end(str(item.key_expr))
        if key.startswith("alive/"):
            if item.kind == zenoh.SampleKind.PUT:
                self._others.check(str(item.key_expr), self.incarnation)
            self._take_token(item)
            return None
        if key.startswith(f"ready/{COORDINATOR}/"):
            joining.is_begun = True
        return item

    def _error_of_missing(self, missing: Collection[str]) -> BusError:
        """Return the error of a process that waits for others in vain."""
        endpoints = self._place.endpoints
        listening = ", ".join(endpoints.listen) or "nothing"
        connecting = ", ".join(endpoints.connect) or "none: others connect to it"
        # Those that have left are named if no other is missing.
        never_seen = set(missing) - self._others.departed
        absent = ", ".join(sorted(never_seen or missing))
        within = f"no sign of {absent} within {self._place.join_timeout_s:g} s"
        return BusError(
            f"{self.name}: {within}; listening on {listening}, connecting to {connecting}"
        )

    def _take_token(self, sample: zenoh.Sample) -> Presence | None:
        """Return the event in a token, if it is one for the node."""
        is_there = sample.kind == zenoh.SampleKind.PUT
        return self._others.take(str(sample.key_expr), is_there=is_there)

    def _taking_part(self, expected: Collection[str]) -> set[str] | None:
        """Return the others that take part in a run that has begun, and its observers.

        None if the run has not begun.
        """
        status = self.ask(COORDINATOR, "status", timeout_s=1.0)
        if status is None or status.get("tick", -1) < 0:
            return None
        vehicles = {name for name in self.alive if role_of(name) == VEHICLE}
        agents = map(agent_name, status["members"])
        team = {COORDINATOR, PLANT, *agents, *vehicles} & set(expected)
        return (team | set(status.get("observers", ()))) - {self.name}

    def renew(self, incarnation: int) -> None:
        """Announce a new incarnation of this process once all is read that has come until now.

        The queue itself announces it, after everything older, and only if the coordinator answers,
        for which this waits (`protocol.network.presence`). Without an answer further calls try again.
        """
        if not self._own.may_renew(incarnation, time.monotonic()):
            return
        if self.ask(COORDINATOR, "status", timeout_s=ANSWER_S) is None:
            self._own.delay_renewal(time.monotonic())
            return
        self._own.renew(incarnation)
        self._put(_Renewal(incarnation))

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

    def next(self, timeout_s: float | None) -> Arrival | None:
        """Return the next event, or None after the timeout; without a timeout wait for ever.

        Refused messages are only counted.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            accepted = next(self._accepted, None)
            if accepted is not None:
                return Arrival(accepted.message, self._arrived_ns, accepted.bundle)

            self.before_wait()
            is_idle = not self._early and self._inbox.empty()
            if is_idle and self._options.gather_s > 0.0:
                time.sleep(self._options.gather_s)
            try:
                left_s = None if deadline is None else max(0.0, deadline - time.monotonic())
                self._arrived_ns, item = self._oldest(left_s)
            except queue.Empty:
                return None
            event = self._unpacked(item)
            if event is not None:
                return Arrival(event, self._arrived_ns)

    def _oldest(self, timeout_s: float | None) -> tuple[int, _Item]:
        """Return the oldest item and the time of its arrival. Raises: queue.Empty: none in time."""
        if self._early:
            return self._early.popleft()
        return self._inbox.get(timeout=timeout_s)

    def leave(self, after: Collection[str] = ()) -> None:
        """Say that the last message was sent, and wait for the recorder and others to leave.

        Closing drops what they have not read.
        """
        self.put(self._keys.left(self.name), b"")
        self._own.leave()
        deadline = time.monotonic() + LINGER_S
        while {RECORDER, *after} & set(self.alive):
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return
            arrival = self.next(left_s)
            if arrival is not None and isinstance(arrival.event, Interrupted):
                return

    def interrupt(self, reason: str) -> None:
        """Wake `next` with an `Interrupted`; safe in a signal handler and from any thread."""
        self._put(Interrupted(reason))

    def close(self) -> None:
        """Undeclare everything and close the session, within bounded time."""
        in_bounded_time(
            *(declared.undeclare for declared in (*self._own.tokens, *self._declared)),
            self._session.close,
        )

    def _put(self, item: _Item) -> None:
        """Queue what arrives, with its time; on any thread."""
        self._inbox.put((self._clock.now_ns(), item))

    def _unpacked(self, item: _Item) -> BusEvent | None:
        """Return the event in an item of the queue.

        None for a query that is answered here, and for messages, which `next` takes one by one.
        """
        # An interruption comes at any time, a request here while this process joined.
        if isinstance(item, Interrupted | Request):
            return item
        if isinstance(item, _Renewal):
            # Before the others see the tokens: they may answer at once.
            self.gate.announce(self.name, item.incarnation)
            self._own.begin_anew(item.incarnation)
            return None
        if isinstance(item, zenoh.Query):
            return self._requests.take(item, self.incarnation)

        key = str(item.key_expr)
        if self._keys.end(key).startswith(("alive/", "ready/")):
            return self._take_token(item)
        name = key.removeprefix(self._keys.left(""))
        if name != key:
            return Departed(name)
        self._accepted = self.gate.accept(key, item.payload.to_bytes())
        return None
