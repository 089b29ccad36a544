"""Everything around a node that makes it a process: network, signals, threads, the loop, the exit code."""

import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import threadpoolctl

from protocol.admission.admission import Admission
from protocol.network.bus import Bus, Interrupted
from protocol.network.parent import PARENT_PIPE
from protocol.network.security import Security, SecurityError, exposed
from protocol.network.session import Endpoints
from protocol.scenario.faults import Fault, due
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import Message, agent_name
from protocol.wire.node import Node

DEFAULT_BASE_PORT = 7447

# Between collections of what reference counting does not free.
_COLLECT_EVERY = 256
# How long a peer that does not read may hold up the others before the link to it is closed, by clock mode.
PATIENCE_S = {"lockstep": 1.0, "realtime": 0.1}
ORPHANED = "parent is gone"
# What a process that has lost its parent gives itself to end in an orderly way.
_ORPHAN_GRACE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A process's place in a run.

    Attributes:
        run: Name of the run.
        incarnation: Which start of this process.
        endpoints: Where it listens and whom it calls.
        join_timeout_s: How long it waits for the others.
    """

    run: str
    incarnation: int
    endpoints: Endpoints
    join_timeout_s: float


def mesh(
    names: Sequence[str], host: str, ports: Sequence[int], security: Security | None = None
) -> dict[str, Endpoints]:
    """Endpoints of an explicit mesh: everybody listens on a port and calls those listed before it.

    Args:
        names: Process names in a fixed order: coordinator, plant, agent1, ...
        host: Address to listen on.
        ports: One for each.
        security: Keys, if there are any.
    """
    scheme = "tcp" if security is None else security.scheme
    addresses = [f"{scheme}/{host}:{port}" for port in ports]
    return {
        name: Endpoints(listen=[addresses[i]], connect=addresses[:i], security=security) for i, name in enumerate(names)
    }


def places(
    names: Sequence[str], scenario: Scenario, ports: Sequence[int], *, check: bool = True
) -> dict[str, Endpoints]:
    """Endpoints as a scenario has them: a mesh on its host, or clients of its router, who listen nowhere.

    Args:
        names: Process names, in the mesh's order.
        scenario: Its `network` counts, and who takes part.
        ports: One for each.
        check: Whether all of them are to be started here: then each must have its keys, and listen where it may.
    Raises: SecurityError: keys that one of them cannot use, an endpoint that anybody could reach.
    """
    network, security = scenario.network, security_of(scenario)
    if network.router is None:
        found = mesh(names, network.host, ports, security)
    else:
        client = Endpoints(listen=[], connect=[network.router], mode="client", security=security)
        found = dict.fromkeys(names, client)
    if security is not None and network.router is not None and not network.router.startswith(security.scheme):
        expected = f"expected {security.scheme}/... with the keys in {security.folder}, got {network.router}"
        raise SecurityError(f"network.router: {expected}")
    for name, place in found.items() if check else ():
        if security is not None:
            security.check(name, mode=place.mode)
        refuse_exposed(place, scenario)
    return found


def place_of(
    name: str, scenario: Scenario, listen: Sequence[str] | None = None, connect: Sequence[str] | None = None
) -> Endpoints:
    """Where a process is that is started by itself: as its scenario has it, or where it is told to be.

    Args:
        name: Process name; one that the mesh does not have listens nowhere and calls everybody.
        scenario: Its scenario.
        listen: Endpoints in place of the usual ones.
        connect: The same of those it calls.
    Raises: SecurityError: keys that it cannot use, or an endpoint that anybody could reach.
    """
    usual = default_mesh(scenario)
    if name in usual:
        found = usual[name]
    elif scenario.network.router is not None:
        found = replace(usual["coordinator"])
    else:
        everybody = [endpoint for place in usual.values() for endpoint in place.listen]
        found = Endpoints(listen=[], connect=everybody, security=security_of(scenario))
    if listen is not None or connect is not None:
        listens = found.listen if listen is None else listen
        calls = found.connect if connect is None and listen is None else connect or []
        found = replace(found, listen=listens, connect=calls, mode="peer" if listens else found.mode)
    if found.security is not None:
        found.security.check(name, mode=found.mode)
        wrong = [at for at in (*found.listen, *found.connect) if not at.startswith(f"{found.security.scheme}/")]
        if wrong:
            raise SecurityError(f"network.keys: expected {found.security.scheme}/... with these keys, got {wrong[0]}")
    refuse_exposed(found, scenario)
    return found


def refuse_exposed(place: Endpoints, scenario: Scenario) -> None:
    """Refuse to listen unencrypted where others than this host can connect, unless the scenario says `insecure`.

    Raises: SecurityError: naming the endpoint.
    """
    at = exposed(place.listen)
    if at is not None and not scenario.network.insecure:
        expected = "expected a loopback address, or network.keys, or network.insecure = true to be open to everybody"
        raise SecurityError(f"network.host: {expected}, got {at}")


def security_of(scenario: Scenario) -> Security | None:
    """Keys of this host and who may take part in the run; None without keys."""
    keys = scenario.network.keys
    return None if keys is None else Security(Path(keys).resolve(), (*process_names(scenario), RECORDER))


def process_names(scenario: Scenario) -> list[str]:
    """Names of a run's processes in the order of their ports."""
    return ["coordinator", "plant", *[agent_name(agent + 1) for agent in range(len(scenario.owned))]]


def default_mesh(scenario: Scenario) -> dict[str, Endpoints]:
    """The mesh that processes started by hand agree on without being told: consecutive ports from the base port.

    Raises: SecurityError: keys that cannot be used.
    """
    names = process_names(scenario)
    base = scenario.network.base_port or DEFAULT_BASE_PORT
    return places(names, scenario, range(base, base + len(names)), check=False)


def run_node(
    node: Node,
    place: Place,
    setup: Setup,
    expected: Collection[str],
    on_interrupt: Callable[[str], Any] | None = None,
    linger_for: Collection[str] = (),
) -> int:
    """Join the run, drive the node until it is finished, leave.

    Args:
        node: The state machine.
        place: Where it runs.
        setup: The run.
        expected: Processes to wait for before starting.
        on_interrupt: What the node wants to send when a signal ends it.
        linger_for: Processes to see off before leaving, so that the last messages reach them.
    Returns: Exit code.
    Raises: BusError: the network cannot be used or somebody did not show up.
    """
    journal = Journal(place.run, node.name)
    admission = Admission(node.name, Keys(place.run), setup, node.rejected)
    # A collection in mid-step is a latency spike; reference counting frees what the loop makes, and what little
    # is left is collected where the node has nothing to do. Before it joins nobody waits for it.
    gc.collect()
    gc.freeze()
    gc.disable()
    with (
        threadpoolctl.threadpool_limits(1),
        Bus(
            name=node.name,
            incarnation=place.incarnation,
            run=place.run,
            digest=setup.scenario.digest(),
            endpoints=place.endpoints,
            admission=admission,
            serves=node.name == "coordinator",
            patience_s=PATIENCE_S[setup.scenario.clock.mode],
            reach_s=place.join_timeout_s,
        ) as bus,
    ):
        with_signals(bus)
        open_to_all = exposed(place.endpoints.listen)
        if open_to_all is not None:
            journal.say("insecure", at=open_to_all, means="whoever reaches this address can read and say everything")
        journal.say("listening", cpu_s=time.process_time(), at=", ".join(place.endpoints.listen))
        interruption = bus.join(expected, place.join_timeout_s)
        if interruption is None:
            clock = (
                {}
                if bus.offset is None
                else {
                    "clock_offset_ms": round(1e3 * bus.offset.ahead_s, 3),
                    "clock_uncertainty_ms": round(1e3 * bus.offset.uncertainty_s, 3),
                }
            )
            journal.say("joined", peers=len(expected), **clock)
            interruption = drive(node, bus, setup.faults)
        if interruption is not None and node.finished is None:
            journal.say("interrupted", reason=interruption.reason)
            for message in on_interrupt(interruption.reason) if on_interrupt else ():
                bus.publish(message)
        admission.close()
        for message in admission.remaining_notices(node.incarnation):
            bus.publish(message)
        bus.wait_gone(linger_for)
    for entry in node.rejected:
        journal.say("rejected", sender=entry.sender, reason=entry.reason, count=entry.count, example=entry.example)
    end = node.finished
    if end is None:
        orphaned = interruption is not None and interruption.reason == ORPHANED
        return EXIT_UNREACHABLE if orphaned or interruption is None else EXIT_INTERRUPTED
    journal.say("finished", outcome=end.outcome, reason=end.reason, tick=end.tick, cpu_s=time.process_time())
    return end.exit_code


def drive(node: Node, bus: Bus, faults: Sequence[Fault]) -> Interrupted | None:
    """Feed events and time to a node until it is finished or somebody interrupts.

    Args:
        node: The state machine.
        bus: Its place on the network.
        faults: Scripted ones; those of this process happen here.
    """
    handled = 0
    while node.finished is None:
        wake_ns = node.wake_ns
        timeout_s = None if wake_ns is None else max(0, wake_ns - time.monotonic_ns()) / 1e9
        event = bus.next(timeout_s)
        if isinstance(event, Interrupted):
            return event
        if isinstance(event, Message):
            _fail_if_due(faults, node.name, event)
        now_ns = time.monotonic_ns()
        messages = node.poll(now_ns) if event is None else node.receive(event, now_ns)
        if node.incarnation != bus.incarnation:
            bus.renew(node.incarnation)
        for notice in bus.admission.due_notices(now_ns, node.incarnation):
            bus.publish(notice)
        if not messages:
            continue
        publishing_ns = time.monotonic_ns()
        for message in messages:
            if message.sender == "coordinator":
                _fail_if_due(faults, node.name, message)
            bus.publish(message)
        node.publish_ns = time.monotonic_ns() - publishing_ns
        handled += 1
        if handled % _COLLECT_EVERY == 0:
            gc.collect(1)
    return None


def _fail_if_due(faults: Sequence[Fault], name: str, message: Message) -> None:
    """Do to this process what a script says happens to it on this message."""
    fault = due(faults, name, message)
    if fault is not None:
        os.kill(os.getpid(), signal.SIGKILL if fault == "kill" else signal.SIGSTOP)


def with_signals(bus: Bus) -> None:
    """Turn Ctrl-C, SIGTERM and the end of the parent into an interruption of the bus."""

    def interrupt(number: int, _: FrameType | None) -> None:
        bus.interrupt(f"interrupted ({signal.Signals(number).name})")

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    if os.environ.get(PARENT_PIPE):
        threading.Thread(target=_watch_parent, args=(bus,), daemon=True).start()


def _watch_parent(bus: Bus) -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    bus.interrupt(ORPHANED)
    time.sleep(_ORPHAN_GRACE_S)
    os._exit(EXIT_UNREACHABLE)


class Journal:
    """Log events with key-value context on standard error: JSON lines, or plain text on a terminal.

    Args:
        run: Name of the run, in every line.
        role: Process name, in every line.
    """

    def __init__(self, run: str, role: str) -> None:
        self._run, self._role = run, role

    def say(self, event: str, **keys: object) -> None:
        """Write one event."""
        if sys.stderr.isatty():
            shown = "  ".join(f"{key}={value}" for key, value in keys.items() if value != "")
            line = f"{time.strftime('%H:%M:%S')}  {self._role:<12}{event:<12}{shown}"
        else:
            entry = {"time": time.time(), "run_id": self._run, "role": self._role, "event": event, **keys}
            line = json.dumps(entry, default=str)
        sys.stderr.write(line + "\n")
        sys.stderr.flush()
