"""A node as a process: joining, event loop, signals, log lines, exit code."""

import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import closing, suppress
from functools import cache, partial
from types import FrameType

import threadpoolctl

from transport.protocol.admission.acceptance_and_refusals import Gate, Sample
from transport.protocol.network.bus import Bus
from transport.protocol.network.bus_events_and_clock import BusOptions, Departed, Interrupted, Place
from transport.protocol.network.endpoints import first_exposed
from transport.protocol.network.exchange_in_bundles import Exchange, exchange_of
from transport.protocol.network.parent_and_environment import PARENT_PIPE, ending_signals
from transport.protocol.scenario.faults.faults_by_tick import Fault, due
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire import messages as wire
from transport.protocol.wire.bundles import Bundle
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.names import COORDINATOR, VEHICLE, role_of
from transport.protocol.wire.node_interface import Node

_COLLECT_EVERY = 256  # answered events between garbage collections
# How long a peer that does not read may delay the others before the link to it is closed, by clock
# mode.
_PATIENCE_S = {"lockstep": 1.0, "realtime": 0.1}
# Why a process without its parent ends, and how long it may take to do so in an orderly way.
_ORPHANED = "parent is gone"
_ORPHAN_GRACE_S = 5.0
_SIGNALS_OF_PARENT = 2


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
    rules: RunRules,
    expected: Collection[str],
    on_interrupt: Callable[[str], Sequence[wire.Message]] = lambda _: (),
    linger_for: Collection[str] = (),
) -> int:
    """Join the run with the expected processes, drive the node until it is finished, leave.

    `on_interrupt` returns what the node sends when a signal interrupts it; with messages, but without
    an end, it goes on. Processes to `linger_for` leave before this one.

    Returns: The exit code.
    """
    journal = Journal(place.run, node.name)
    keys = Keys(place.run)
    gate = Gate(node.name, keys, rules.shape, node.check_moment)
    options = BusOptions(serves=node.name == COORDINATOR, patience_s=_PATIENCE_S[rules.clock.mode])
    _collect_between_steps_only()

    use_one_thread()

    with closing(Bus(node.name, place, rules.digest, gate, options)) as bus:
        _watch_signals(bus)
        _log_opening(journal, place)
        exchange = exchange_of(rules.shape, node.name, place.incarnation, keys, bus.put)
        interruption = _join(node, bus, exchange, expected, journal)
        if interruption is not None:
            _take_statuses(node, bus)
        while True:
            if interruption is None:
                interruption = _drive(node, bus, exchange, rules.faults)
            if interruption is None or node.finished is not None:
                break

            journal.log("interrupted", reason=interruption.reason)
            told = on_interrupt(interruption.reason)
            for message in told:
                exchange.send(message)
            if not told or node.finished is not None:
                break
            interruption = None  # the signal has begun an abort, and the node goes on to its end
        exchange.flush()
        for notice in gate.notices(bus.incarnation):
            exchange.send(notice)
        _log_rejections(journal, gate)

        end = node.finished
        if end is not None:
            ended = {"outcome": end.outcome, "reason": end.reason, "tick": end.tick}
            journal.log("finished", **ended, cpu_s=time.process_time())
            bus.leave(linger_for)
            return end.exit_code
    # Without an interruption the node has an end, which has been returned above.
    is_orphan = interruption is None or interruption.reason == _ORPHANED
    return EXIT_UNREACHABLE if is_orphan else EXIT_INTERRUPTED


@cache
def use_one_thread() -> None:
    """Limit the libraries of linear algebra to one thread: a run has more processes than a host cores.

    Looking for them takes milliseconds, which processes forked afterwards save.
    """
    threadpoolctl.threadpool_limits(1)


def _collect_between_steps_only() -> None:
    """Switch off automatic garbage collections: one in mid-step is a latency spike.

    Reference counting frees nearly all that the loop makes, and young cycles are collected between
    steps. The collection here costs no time of a tick: this process has not joined yet.
    """
    gc.collect()
    gc.freeze()
    gc.disable()


def _log_opening(journal: Journal, place: Place) -> None:
    """Log where this process listens, and whether others than the run can send messages."""
    endpoints = place.endpoints
    if endpoints.security is None and endpoints.listen:
        who = "host with access" if first_exposed(endpoints.listen) else "process on this host"
        journal.log("open", means=f"any {who} can read and send all messages (docs/access.md)")
    journal.log("listening", cpu_s=time.process_time(), at=", ".join(endpoints.listen))


def _log_rejections(journal: Journal, gate: Gate) -> None:
    """Log the refused messages, a line for each sender and reason."""
    for entry in gate.rejections:
        journal.log(
            "rejected",
            sender=entry.sender,
            reason=entry.reason,
            count=entry.count,
            example=entry.example,
        )


def _join(
    node: Node, bus: Bus, exchange: Exchange, expected: Collection[str], journal: Journal
) -> Interrupted | None:
    """Wait for the other processes; return an interruption, if one ended the wait.

    From then on, bundles are sent before each wait.
    """
    bus.before_wait = partial(_settle, node, exchange)
    interruption = bus.join(expected, lambda text: journal.log("waiting", text=text))
    if interruption is None:
        journal.log("joined", peers=len(expected))
    return interruption


def _take_statuses(node: Node, bus: Bus) -> None:
    """Let a coordinator that was interrupted while it joined know whether a team flies without it."""
    while (arrival := bus.next(0.0)) is not None:
        if isinstance(arrival.event, wire.VehicleStatus):
            node.receive(arrival.event, time.monotonic_ns())


def _drive(node: Node, bus: Bus, exchange: Exchange, faults: Sequence[Fault]) -> Interrupted | None:
    """Feed events and time to a node until it is finished or interrupted.

    Execute its own scripted faults.
    """
    answered = 0
    while node.finished is None:
        arrival = bus.next(_timeout_s(node))
        event = None if arrival is None else arrival.event
        if isinstance(event, Interrupted):
            return event
        if isinstance(event, Departed | Sample):
            continue  # for recorders
        if isinstance(event, wire.Message):
            _fail_if_due(faults, node.name, event, exchange)

        bundle = None if arrival is None else arrival.bundle
        messages = _answer(node, bus, exchange, event, bundle)
        if messages:
            _send(node, messages, exchange, faults)
            answered += 1
            if answered % _COLLECT_EVERY == 0:
                gc.collect(1)
    return None


def _answer(
    node: Node,
    bus: Bus,
    exchange: Exchange,
    event: wire.Event | None,
    bundle: Bundle | None,
) -> Sequence[wire.Message]:
    """Return the messages of a node after an event, or after the time for which it waited.

    A new incarnation is announced, and refusals are told, before they are sent.
    """
    now_ns = time.monotonic_ns()
    if event is None:
        messages = node.poll(now_ns)
    else:
        messages = node.receive(event, now_ns)
        exchange.received(event, bundle)

    if node.incarnation != bus.incarnation:
        bus.renew(node.incarnation)
    for notice in bus.gate.notices(bus.incarnation, now_ns):
        exchange.send(notice)
    return messages


def _settle(node: Node, exchange: Exchange) -> None:
    """Send the bundle that is kept, whose time adds to that of the messages."""
    begun_ns = time.monotonic_ns()
    exchange.settle()
    node.publish_ns += time.monotonic_ns() - begun_ns


def _timeout_s(node: Node) -> float | None:
    """Return the time until a node has to be polled, s; None while only events matter."""
    if node.wake_ns is None:
        return None
    return max(0, node.wake_ns - time.monotonic_ns()) / 1e9


def _send(
    node: Node, messages: Sequence[wire.Message], exchange: Exchange, faults: Sequence[Fault]
) -> None:
    """Send the messages of a node, and measure the time it takes."""
    begun_ns = time.monotonic_ns()
    for message in messages:
        if role_of(message.sender) in (COORDINATOR, VEHICLE):
            _fail_if_due(faults, node.name, message, exchange)
        exchange.send(message)
    node.publish_ns = time.monotonic_ns() - begun_ns


def _fail_if_due(
    faults: Sequence[Fault], name: str, message: wire.Message, exchange: Exchange
) -> None:
    """Kill or stop this process if a scripted fault says so for this message.

    Earlier messages are sent before.
    """
    fault = due(faults, name, message)
    if fault is not None:
        exchange.flush()
        os.kill(os.getpid(), signal.SIGKILL if fault == "kill" else signal.SIGSTOP)


def _watch_signals(bus: Bus) -> None:
    """Turn Ctrl-C, SIGTERM, SIGHUP and the end of the parent into an interruption of the bus."""
    received: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        received.append(number)
        # The parent passes on the first signal and ends this process by a second one: only a user
        # who does not want to wait sends more.
        if len(received) > _SIGNALS_OF_PARENT:
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
