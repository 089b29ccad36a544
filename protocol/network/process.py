"""A node as a process: its messages, alone or in bundles.

Signals, event loop, log lines, exit code.
"""

import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from contextlib import closing, suppress
from types import FrameType
from typing import Any

import threadpoolctl

from transport.protocol.admission.gate import Gate, Sample
from transport.protocol.network.bus import Bus, Interrupted, Left, Place
from transport.protocol.network.parent import PARENT_PIPE, ending_signals
from transport.protocol.network.security import exposed
from transport.protocol.scenario.faults import Fault, due
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire import messages as wire
from transport.protocol.wire.codec import encode
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE
from transport.protocol.wire.keys import Keys
from transport.protocol.wire.names import AGENT, COORDINATOR, PLANT
from transport.protocol.wire.node import Node, Outbox

Put = Callable[[str, bytes], None]  # sends an encoded message under a key


def exchange_of(setup: Setup, name: str, incarnation: int, keys: Keys, put: Put) -> "Exchange":
    """Return the exchange of a process."""
    kinds = {COORDINATOR: _Coordinator, PLANT: _Plant} if setup.shape.relayed else {}
    return kinds.get(name, _Agent if kinds else Exchange)(name, incarnation, keys, put)


class Exchange:
    """Sends the messages of one process.

    In real time each alone and at once, in lockstep also in bundles.

    The coordinator sends the plans of tick k with tick k + 1: an agent sends one message per tick
    and receives two.
    """

    bundled: tuple[type[wire.Message], ...] = ()  # kinds of messages that are kept for a bundle

    def __init__(self, name: str, incarnation: int, keys: Keys, put: Put) -> None:
        self._keys, self._put = keys, put
        self._out = Outbox(name, incarnation)  # bundles have sequence numbers of their own
        self._kept: list[
            tuple[str, bytes]
        ] = []  # keys without the prefix of the run, encoded messages
        self._tick = 0  # of the newest message kept

    def received(self, event: wire.Event, bundle: wire.Bundle | None) -> None:
        """Note an event that the node has accepted, and the bundle it came in."""

    def send(self, message: wire.Message) -> None:
        """Send a message, or keep it for a bundle; proposals of a negotiation are sent at once."""
        key, data = self._keys.of(message), encode(message)
        if not isinstance(message, self.bundled) or getattr(message, "negotiation", False):
            self._put(key, data)
            return
        if message.incarnation != self._out.incarnation:
            self._out = Outbox(message.sender, message.incarnation)
        self._kept.append((self._keys.end(key), data))
        self._tick = message.tick

    def flush(self) -> None:
        """Send the bundle of the messages kept, whatever it waits for: before a process ends."""

    def settle(self) -> None:
        """Send the bundle if it need not wait any longer.

        When all messages received together are handled.
        """
        self.flush()

    def _send_bundle(
        self, kind: type[wire.Bundle], entries: list[tuple[str, bytes]], **fields: int
    ) -> None:
        """Send messages, as they are kept, in a bundle, if there are any; forget those kept."""
        self._kept = []
        if entries:
            keys, parts = zip(*entries, strict=True)
            bundle = self._out.stamp(kind, tick=self._tick, keys=keys, parts=parts, **fields)
            self._put(self._keys.of(bundle), encode(bundle))


class _Agent(Exchange):
    """Sends plan and report of a tick to the coordinator alone."""

    bundled = (wire.Plan, wire.StepReport)

    def flush(self) -> None:
        self._send_bundle(wire.Answer, self._kept, agent=int(self._out.sender.removeprefix(AGENT)))


class _Plant(Exchange):
    """Sends the agents their measurements with the relayed plans.

    State and measurements to the record afterwards.
    """

    bundled = (wire.Measurement, wire.PlantState, wire.ActualInputs)
    _shared: tuple[
        tuple[str, bytes], ...
    ] = ()  # accepted plans for the agents since the last measurement

    def received(self, event: wire.Event, bundle: wire.Bundle | None) -> None:
        if isinstance(event, wire.Plan) and event.shared and bundle is not None:
            key = self._keys.end(self._keys.of(event))
            self._shared = *self._shared, (key, bundle.parts[bundle.keys.index(key)])

    def flush(self) -> None:
        recorded = self._kept
        if measured := [entry for entry in recorded if entry[0].startswith(wire.Measurement.kind)]:
            self._send_bundle(wire.Instant, [*self._shared, *measured])
            self._shared = ()
        self._send_bundle(wire.Record, recorded)


class _Coordinator(Exchange):
    """Relays the answers of a tick with the next one.

    At once if all are here and no tick follows yet.
    """

    bundled = (wire.Tick,)

    _answers: Mapping[int, wire.Answer] = {}  # accepted answers, by agent
    _awaited: Set[int] = frozenset()  # agents that are to answer the open tick

    def received(self, event: wire.Event, bundle: wire.Bundle | None) -> None:
        if isinstance(event, wire.Plan) and isinstance(bundle, wire.Answer):
            self._awaited -= {event.agent}
            self._answers = {**self._answers, event.agent: bundle}
            self._tick = bundle.tick

    def send(self, message: wire.Message) -> None:
        if isinstance(message, wire.Roster):
            self._awaited &= set(message.agents)
        if isinstance(message, wire.Control):
            self.flush()
        super().send(message)
        if isinstance(message, wire.Tick):
            self._awaited = set(message.members)
            self.flush()

    def flush(self) -> None:
        answers = [answer for _, answer in sorted(self._answers.items())]
        entries = [
            entry for answer in answers for entry in zip(answer.keys, answer.parts, strict=True)
        ]
        self._answers = {}
        self._send_bundle(wire.Relay, [*entries, *self._kept])

    def settle(self) -> None:
        if not self._awaited:
            self.flush()


_COLLECT_EVERY = 256  # handled events between garbage collections
# How long a peer that does not read may delay the others before the link to it is closed, by clock
# mode.
_PATIENCE_S = {"lockstep": 1.0, "realtime": 0.1}
# Why a process without its parent ends, and how long it may take to do so in an orderly way.
_ORPHANED, _ORPHAN_GRACE_S = "parent is gone", 5.0


class Journal:
    """Log events with run, role and key-value context on standard error, as JSON lines."""

    def __init__(self, run: str, role: str) -> None:
        self._whose = {"run_id": run, "role": role}

    def log(self, event: str, **keys: object) -> None:
        """Write one event."""
        line = json.dumps({"time": time.time(), **self._whose, "event": event, **keys})
        with suppress(OSError):  # the disk is full: the process works without its log lines
            sys.stderr.write(line + "\n")
            sys.stderr.flush()


def run_node(
    node: Node,
    place: Place,
    setup: Setup,
    expected: Collection[str],
    on_interrupt: Callable[[str], Any] | None = None,
    linger_for: Collection[str] = (),
) -> int:
    """Join the run with the expected processes, drive the node until it is finished, leave.

    Return the exit code.

    `on_interrupt` returns the node's last messages when a signal ends it; processes to `linger_for`
    leave before it.
    """
    journal, keys = Journal(place.run, node.name), Keys(place.run)
    gate = Gate(node.name, keys, setup.shape, node.check_moment)
    serves, patience_s = node.name == COORDINATOR, _PATIENCE_S[setup.scenario.clock.mode]
    # A garbage collection in mid-step is a latency spike: reference counting frees nearly all that
    # the loop makes, and the rest is collected between steps. Before this process joins, no other
    # waits for it.
    gc.collect()
    gc.freeze()
    gc.disable()
    with (
        threadpoolctl.threadpool_limits(1),
        closing(
            Bus(
                node.name,
                place,
                setup.scenario.digest(),
                gate,
                serves=serves,
                patience_s=patience_s,
            )
        ) as bus,
    ):
        _watch_signals(bus)
        if place.endpoints.security is None and place.endpoints.listen:
            who = "host with access" if exposed(place.endpoints.listen) else "process on this host"
            journal.log("open", means=f"any {who} can read and send all messages (docs/deploy.md)")
        journal.log("listening", cpu_s=time.process_time(), at=", ".join(place.endpoints.listen))
        exchange = exchange_of(setup, node.name, place.incarnation, keys, bus.put)

        def settle() -> None:
            begun_ns = time.monotonic_ns()
            exchange.settle()
            node.publish_ns += time.monotonic_ns() - begun_ns

        bus.before_wait = settle
        interruption = bus.join(expected, lambda text: journal.log("waiting", text=text))
        if interruption is None:
            journal.log("joined", peers=len(expected))
            interruption = _drive(node, bus, exchange, setup.faults)
        if interruption is not None and node.finished is None:
            journal.log("interrupted", reason=interruption.reason)
            for message in on_interrupt(interruption.reason) if on_interrupt else ():
                exchange.send(message)
        exchange.flush()
        for notice in gate.notices(node.incarnation):
            exchange.send(notice)
        for entry in gate.rejections:
            journal.log(
                "rejected",
                sender=entry.sender,
                reason=entry.reason,
                count=entry.count,
                example=entry.example,
            )
        if (end := node.finished) is not None:
            journal.log(
                "finished",
                outcome=end.outcome,
                reason=end.reason,
                tick=end.tick,
                cpu_s=time.process_time(),
            )
            bus.leave(linger_for)
            return end.exit_code
    return (
        EXIT_UNREACHABLE
        if interruption is None or interruption.reason == _ORPHANED
        else EXIT_INTERRUPTED
    )


def _drive(node: Node, bus: Bus, exchange: Exchange, faults: Sequence[Fault]) -> Interrupted | None:
    """Feed events and time to a node until it is finished or interrupted.

    Execute its own scripted faults.
    """
    handled = 0
    while node.finished is None:
        event = bus.next(
            None if node.wake_ns is None else max(0, node.wake_ns - time.monotonic_ns()) / 1e9
        )
        if isinstance(event, Interrupted):
            return event
        if isinstance(event, Left | Sample):
            continue  # for recorders
        if isinstance(event, wire.Message):
            _fail_if_due(faults, node.name, event, exchange)
        now_ns = time.monotonic_ns()
        messages = node.poll(now_ns) if event is None else node.receive(event, now_ns)
        if event is not None:
            exchange.received(event, bus.gate.bundle)
        if node.incarnation != bus.incarnation:
            bus.renew(node.incarnation)
        for notice in bus.gate.notices(node.incarnation, now_ns):
            exchange.send(notice)
        if not messages:
            continue
        publishing_ns = time.monotonic_ns()
        for message in messages:
            if message.sender == COORDINATOR:
                _fail_if_due(faults, node.name, message, exchange)
            exchange.send(message)
        node.publish_ns = time.monotonic_ns() - publishing_ns
        handled += 1
        if handled % _COLLECT_EVERY == 0:
            gc.collect(1)
    return None


def _fail_if_due(
    faults: Sequence[Fault], name: str, message: wire.Message, exchange: Exchange
) -> None:
    """Kill or stop this process if a scripted fault says so for this message.

    Earlier messages are sent before.
    """
    if fault := due(faults, name, message):
        exchange.flush()
        os.kill(os.getpid(), signal.SIGKILL if fault == "kill" else signal.SIGSTOP)


def _watch_signals(bus: Bus) -> None:
    """Turn Ctrl-C, SIGTERM, SIGHUP and the end of the parent into an interruption of the bus."""
    received: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        received.append(number)
        if (
            len(received) > 2
        ):  # the parent of this process passes on the first one, and ends it by the second
            os._exit(EXIT_INTERRUPTED)
        bus.interrupt(f"interrupted ({signal.Signals(number).name})")

    for number in ending_signals():
        signal.signal(number, interrupt)
    if os.environ.get(PARENT_PIPE):
        threading.Thread(target=_watch_parent, args=(bus,), daemon=True).start()


def _watch_parent(bus: Bus) -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    bus.interrupt(_ORPHANED)
    time.sleep(_ORPHAN_GRACE_S)
    os._exit(EXIT_UNREACHABLE)
