"""Ends of a node's process, with a bus in place of the network: exit code and last messages."""

import errno
import gc
import io
import json
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from queue import SimpleQueue
from types import FrameType
from typing import Any, NoReturn

import numpy as np
import pytest

from tests.support import runs
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.bus_events_and_clock import (
    Arrival,
    BusEvent,
    BusOptions,
    Departed,
    Interrupted,
    Place,
)
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.node_process import run_node
from transport.protocol.network.parent_and_environment import PARENT_PIPE, ending_signals
from transport.protocol.wire.bundles import Relay
from transport.protocol.wire.codec import decode
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_DIVERGED,
    EXIT_INTERRUPTED,
    EXIT_UNREACHABLE,
)
from transport.protocol.wire.messages import (
    Control,
    Event,
    Message,
    PlantState,
    Rejected,
    VehicleStatus,
)
from transport.protocol.wire.names import COORDINATOR
from transport.protocol.wire.outbox import Outbox

# Timeout on a busy machine for actions of milliseconds, s.
PATIENCE_S = 20.0
OTHERS = ("plant", "agent1")
WHERE = "transport.protocol.network.node_process"


class StubNode:
    """A node without messages of its own that ends with the run."""

    name = COORDINATOR
    incarnation = 0
    publish_ns = 0
    wake_ns: int | None = None
    finished: Control | None = None

    def __init__(self) -> None:
        self.received: list[Event] = []

    def check_moment(self, message: Message) -> None:
        """Accept all messages."""

    def receive(self, event: Event, _now_ns: int) -> Sequence[Message]:
        """End at the end of the run."""
        self.received.append(event)
        if isinstance(event, Control):
            self.finished = event
        return ()

    def poll(self, _now_ns: int) -> Sequence[Message]:
        """Send nothing."""
        return ()


class StubBus:
    """A bus on which only that happens what a test does while the node joins or waits."""

    incarnation = 0

    def __init__(self) -> None:
        self.while_joining: Callable[[], object] = lambda: None
        self.while_waiting: Callable[[], object] = lambda: None
        self.before_wait: Callable[[], None] = lambda: None
        self.inbox: SimpleQueue[BusEvent] = SimpleQueue()
        self.sent: list[Message] = []
        self.timeouts_s: list[float | None] = []
        self.renewed: list[int] = []
        self.left_after: tuple[str, ...] | None = None
        self.has_not_joined = False
        self.is_closed = False

    def open(
        self, _name: str, _place: Place, _digest: str, gate: Gate, options: BusOptions
    ) -> "StubBus":
        """Return this bus as the one of a process."""
        self.gate = gate
        self.options = options
        return self

    def join(self, _expected: Collection[str], _on_wait: object) -> Interrupted | None:
        """Find all processes, unless interrupted."""
        self.while_joining()
        event = None if self.inbox.empty() else self.inbox.get()
        assert event is None or isinstance(event, Interrupted)
        self.has_not_joined = event is not None
        return event

    def next(self, timeout_s: float | None) -> Arrival | None:
        """Return what arrives."""
        if self.has_not_joined:  # what has come until then
            return None if self.inbox.empty() else Arrival(self.inbox.get(), 0)
        self.timeouts_s.append(timeout_s)
        self.while_waiting()
        return Arrival(self.inbox.get(timeout=PATIENCE_S), 0)

    def put(self, _key: str, data: bytes) -> None:
        """Take a message."""
        assert self.left_after is None
        self.sent.append(decode(data))

    def interrupt(self, reason: str) -> None:
        """Interrupt the node."""
        self.inbox.put(Interrupted(reason))

    def renew(self, incarnation: int) -> None:
        """Announce a new incarnation."""
        self.renewed.append(incarnation)

    def refuse(self) -> None:
        """Refuse a message."""
        assert list(self.gate.accept("no key", b"")) == []

    def leave(self, after: Collection[str]) -> None:
        """Leave after others."""
        self.left_after = tuple(after)

    def close(self) -> None:
        """Close."""
        self.is_closed = True


def unhandled(number: int, _: FrameType | None) -> NoReturn:
    """Fail at a signal for which the process has no handler."""
    raise AssertionError(signal.Signals(number).name)


def at_once(code: int) -> NoReturn:
    """Let the end of a process at once be seen."""
    raise SystemExit(code)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[StubBus]:
    """The bus of the process of this test, which outlives the ends of that process."""
    handlers = {number: signal.signal(number, unhandled) for number in ending_signals()}
    monkeypatch.setattr(os, "_exit", at_once)
    one = StubBus()
    monkeypatch.setattr(f"{WHERE}.Bus", one.open)
    monkeypatch.delenv(PARENT_PIPE, raising=False)
    yield one
    for number, handler in handlers.items():
        signal.signal(number, handler)
    gc.enable()  # what is frozen stays so: a search among all that pytest has made takes half a second
    assert one.is_closed


def end_of_run(exit_code: int) -> Control:
    """Return the coordinator's message that the run has ended."""
    return Outbox(COORDINATOR, 0).stamp(
        Control, tick=0, outcome="aborted", reason="of the test", exit_code=exit_code
    )


def run(node: StubNode, **options: Any) -> int:
    """Run a node as its process does; return the exit code."""
    return run_node(node, runs.place("here"), runs.setup().rules, OTHERS, **options)


@pytest.mark.parametrize("exit_code", [0, EXIT_DIVERGED])
def test_a_finished_process_has_the_exit_code_of_the_run(bus: StubBus, exit_code: int) -> None:
    """It leaves after the processes for which it lingers."""
    bus.while_waiting = lambda: bus.inbox.put(end_of_run(exit_code))
    assert run(StubNode(), linger_for=OTHERS) == exit_code
    assert bus.left_after == OTHERS


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("joins", [True, False])
@pytest.mark.parametrize("times", [1, 2])
def test_a_signal_ends_a_process_with_its_last_messages(
    bus: StubBus, number: signal.Signals, joins: bool, times: int
) -> None:
    """While it joins or runs, one or two signals end it in order, with their own exit code."""

    def interrupt() -> None:
        for _ in range(times):
            signal.raise_signal(number)

    if joins:
        bus.while_joining = interrupt
    else:
        bus.while_waiting = interrupt

    reasons: list[str] = []
    last = end_of_run(EXIT_INTERRUPTED)
    node = StubNode()

    def on_interrupt(reason: str) -> Sequence[Message]:
        reasons.append(reason)
        node.finished = last
        return [last]

    assert run(node, on_interrupt=on_interrupt) == EXIT_INTERRUPTED
    assert reasons == [f"interrupted ({number.name})"]
    assert bus.sent == [last]


def test_a_process_that_has_not_joined_knows_what_flies(bus: StubBus) -> None:
    """Before it decides what its signal ends: a coordinator takes in the statuses that came while it joined."""
    node = StubNode()
    vehicle = Outbox("vehicle1", 0).stamp(
        VehicleStatus,
        tick=0,
        uav=1,
        phase="flying",
        problem="",
        armed=True,
        mode="GUIDED",
        battery=0.9,
        healthy=True,
        position=np.zeros(3),
        age_s=0.0,
        plan_tick=-1,
        latency_s=-1.0,
        late_s=0.0,
        roster=1,
        heard_ns=0,
        heard_at_ns=0,
        sent_ns=0,
        start_ns=1,
    )

    def interrupt() -> None:
        signal.raise_signal(signal.SIGTERM)
        bus.inbox.put(vehicle)

    bus.while_joining = interrupt
    assert run(node) == EXIT_INTERRUPTED
    assert node.received == [vehicle]
    assert bus.sent == []


def test_a_signal_may_begin_an_abort(bus: StubBus) -> None:
    """A node that answers a signal with messages, but without an end, goes on to its end."""
    end = end_of_run(EXIT_DIVERGED)
    told = end_of_run(EXIT_INTERRUPTED)  # any message

    def interrupt() -> None:
        bus.while_waiting = lambda: bus.inbox.put(end)
        signal.raise_signal(signal.SIGTERM)

    reasons: list[str] = []

    def on_interrupt(reason: str) -> Sequence[Message]:
        reasons.append(reason)
        assert len(reasons) == 1
        return [told]

    bus.while_waiting = interrupt
    assert run(StubNode(), on_interrupt=on_interrupt) == EXIT_DIVERGED
    assert bus.sent == [told]


def test_a_process_whose_signal_ends_the_run_leaves_in_order(bus: StubBus) -> None:
    """The end that a node makes of an interruption gives the exit code, and others are awaited."""
    bus.while_waiting = lambda: signal.raise_signal(signal.SIGTERM)
    node = StubNode()

    def on_interrupt(_: str) -> Sequence[Message]:
        node.finished = end_of_run(EXIT_DIVERGED)
        return [node.finished]

    assert run(node, on_interrupt=on_interrupt, linger_for=OTHERS) == EXIT_DIVERGED
    assert bus.sent == [node.finished]
    assert bus.left_after == OTHERS


def test_the_third_signal_ends_a_process_at_once(bus: StubBus) -> None:
    """One that does not end in order has the exit code of a signal, and sends nothing more."""

    def interrupt() -> None:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)

    bus.while_waiting = interrupt
    with pytest.raises(SystemExit) as ended:
        run(StubNode(), on_interrupt=lambda _: [end_of_run(0)])
    assert ended.value.code == EXIT_INTERRUPTED
    assert bus.sent == []


def test_a_process_without_its_parent_cannot_reach_the_run(
    bus: StubBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of its input ends it with that exit code, in order or, some time later, at once."""
    reads, writes = os.pipe()
    codes: SimpleQueue[int] = SimpleQueue()
    monkeypatch.setenv(PARENT_PIPE, "1")
    with os.fdopen(reads) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        monkeypatch.setattr(f"{WHERE}.time.sleep", lambda _: None)
        monkeypatch.setattr(os, "_exit", codes.put)
        bus.while_waiting = lambda: os.close(writes)
        assert run(StubNode()) == EXIT_UNREACHABLE
        assert codes.get(timeout=PATIENCE_S) == EXIT_UNREACHABLE
    assert bus.left_after is None


@pytest.mark.parametrize(
    ("wakes_in_s", "least_s", "most_s"), [(5.0, 5.0 - PATIENCE_S / 5.0, 5.0), (-5.0, 0.0, 0.0)]
)
def test_a_process_waits_until_its_node_is_to_be_polled(
    bus: StubBus, wakes_in_s: float, least_s: float, most_s: float
) -> None:
    """The time left is in seconds, and none for a node that is late; without one only events matter."""
    bus.while_waiting = lambda: bus.inbox.put(end_of_run(0))
    node = StubNode()
    node.wake_ns = time.monotonic_ns() + round(wakes_in_s * 1e9)
    assert run(node) == 0
    assert run(StubNode()) == 0
    timeout_s, none = bus.timeouts_s
    assert timeout_s is not None
    assert least_s <= timeout_s <= most_s
    assert none is None


@pytest.mark.parametrize(("do", "number"), [("kill", signal.SIGKILL), ("stop", signal.SIGSTOP)])
def test_a_scripted_fault_strikes_before_its_tick_is_sent(
    bus: StubBus, monkeypatch: pytest.MonkeyPatch, do: str, number: signal.Signals
) -> None:
    """The process kills or stops itself once all earlier messages are sent."""
    at_tick = 20
    rules = runs.setup(f"faults.event=[{{at_s=1.0,do='{do}',target='coordinator'}}]").rules

    class Ticks(StubNode):
        def receive(self, _event: Event, _now_ns: int) -> Sequence[Message]:
            return [runs.tick(at_tick - 1), runs.tick(at_tick)]

    def strike(process: int, signal_number: int) -> NoReturn:
        assert (process, signal_number) == (os.getpid(), number)
        raise SystemExit(0)

    monkeypatch.setattr(os, "kill", strike)
    bus.while_waiting = lambda: bus.inbox.put(runs.plant_state(runs.setup(), at_tick - 1))
    with pytest.raises(SystemExit):
        run_node(Ticks(), runs.place("here"), rules, OTHERS)
    (relay,) = bus.sent
    assert isinstance(relay, Relay)
    assert [decode(part) for part in relay.parts] == [runs.tick(at_tick - 1)]


@pytest.mark.parametrize(
    ("name", "settings", "serves", "patience_s"),
    [
        (COORDINATOR, (), True, 1.0),
        ("plant", (), False, 1.0),
        ("plant", ("clock.mode=realtime",), False, 0.1),
    ],
)
def test_options_of_the_bus_follow_from_role_and_clock(
    bus: StubBus, name: str, settings: tuple[str, ...], serves: bool, patience_s: float
) -> None:
    """The coordinator answers requests; in real time a peer that does not read may delay the others less."""
    bus.while_waiting = lambda: bus.inbox.put(end_of_run(0))
    node = StubNode()
    node.name = name
    assert run_node(node, runs.place("here"), runs.setup(*settings).rules, OTHERS) == 0
    assert (bus.options.serves, bus.options.patience_s) == (serves, patience_s)


def test_refusals_are_told_and_logged(bus: StubBus, capsys: pytest.CaptureFixture[str]) -> None:
    """The first of them at once, those of the last second before the process leaves; the log has all."""

    def refuse_again() -> None:
        bus.refuse()
        bus.inbox.put(end_of_run(0))

    def refuse() -> None:
        bus.while_waiting = refuse_again
        bus.refuse()
        bus.inbox.put(runs.roster())

    bus.while_waiting = refuse
    assert run(StubNode()) == 0
    told = [message for message in bus.sent if isinstance(message, Rejected)]
    assert [(one.offender, one.count) for one in told] == [("no key", 1), ("no key", 1)]
    logged = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    (rejected,) = [entry for entry in logged if entry["event"] == "rejected"]
    assert (rejected["sender"], rejected["count"]) == ("no key", 2)
    assert {(entry["run_id"], entry["role"]) for entry in logged} == {("here", COORDINATOR)}


def test_a_new_incarnation_of_the_node_is_announced(bus: StubBus) -> None:
    """As soon as the node has one, and not before."""

    class Returning(StubNode):
        def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
            self.incarnation = 1
            return super().receive(event, now_ns)

    for node, renewed in ((StubNode(), []), (Returning(), [1])):
        bus.while_waiting = lambda: bus.inbox.put(end_of_run(0))
        assert run(node) == 0
        assert bus.renewed == renewed


LONG_AGO_NS = 10**15


def test_a_node_knows_how_long_its_messages_took(bus: StubBus) -> None:
    """With the bundle that is sent before the next wait; what is for recorders alone it does not receive."""

    class Telling(StubNode):
        def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
            super().receive(event, now_ns)
            return [runs.roster()]

    node = Telling()
    published_ns: list[int] = []

    def wait() -> None:
        published_ns.append(node.publish_ns)
        bus.before_wait()
        published_ns.append(node.publish_ns)
        first = len(published_ns) == 2
        if first:
            bus.inbox.put(Departed("agent1"))
            node.publish_ns = LONG_AGO_NS
        bus.inbox.put(runs.plant_state(runs.setup(), 0) if first else end_of_run(0))

    bus.while_waiting = wait
    assert run(node) == 0
    at_first, settled_ns, _, _, sent_ns, more_ns = published_ns
    assert at_first == 0 < settled_ns
    assert 0 < sent_ns < more_ns < LONG_AGO_NS  # of the newest messages alone
    assert [type(event) for event in node.received] == [PlantState, Control]


def test_garbage_is_collected_between_steps_alone(
    bus: StubBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never by itself, and of young objects after each 256 events with an answer."""
    generations: list[tuple[int, ...]] = []
    monkeypatch.setattr(gc, "collect", lambda *generation: generations.append(generation))

    class Telling(StubNode):
        def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
            super().receive(event, now_ns)
            return [runs.roster()]

    def wait() -> None:
        assert not gc.isenabled()
        for _ in range(512):
            bus.inbox.put(runs.roster())
        bus.while_waiting = lambda: None
        bus.inbox.put(end_of_run(0))

    bus.while_waiting = wait
    assert run(Telling()) == 0
    assert generations == [(), (1,), (1,)]


@pytest.mark.parametrize(
    ("listen", "who"),
    [
        ([], None),
        (["tcp/127.0.0.1:7447"], "process on this host"),
        (["tcp/0.0.0.0:1"], "host with access"),
    ],
)
def test_a_process_says_who_can_read_its_messages(
    bus: StubBus, listen: list[str], who: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without keys any process that reaches an address where it listens can; none where it does not."""
    bus.while_waiting = lambda: bus.inbox.put(end_of_run(0))
    place = Place(run="here", endpoints=Endpoints(listen=listen, connect=[]))
    assert run_node(StubNode(), place, runs.setup().rules, OTHERS) == 0
    logged = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    means = [entry["means"] for entry in logged if entry["event"] == "open"]
    assert means == (
        [] if who is None else [f"any {who} can read and send all messages (docs/access.md)"]
    )


def test_a_process_works_without_its_log(bus: StubBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk costs log lines, not the flight."""

    class Full(io.StringIO):
        def write(self, _text: str) -> NoReturn:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("sys.stderr", Full())
    bus.while_waiting = lambda: bus.inbox.put(end_of_run(0))
    assert run(StubNode()) == 0
