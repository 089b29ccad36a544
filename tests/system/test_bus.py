"""The bus with an unknown session on its network.

Its messages are counted and have no other effect.
"""

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
import zenoh

from tests.support import runs
from tests.support.commands import free_base
from tests.support.runs import setup
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.bus import LINGER_S, Bus
from transport.protocol.network.bus_events_and_clock import BusOptions, Departed, Place
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.requests_and_answers import Reach, ask
from transport.protocol.network.session import BusError
from transport.protocol.wire.codec import MAX_BYTES, VERSION, encode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Presence

KEYS = Keys("bus")
DIGEST = "0123456789ab"
# Timeout on a busy machine for actions of milliseconds, s.
PATIENCE_S = 20.0


class Plant:
    """The bus of a plant, or another process, and its counts of refused messages."""

    def __init__(self, port: int, join_timeout_s: float = 1.0, name: str = "plant") -> None:
        self.gate = Gate(name, KEYS, setup().rules.shape)
        self.rejections = self.gate.rejections
        place = Place(
            run=KEYS.run,
            endpoints=Endpoints(listen=[f"tcp/127.0.0.1:{port}"], connect=[]),
            join_timeout_s=join_timeout_s,
        )
        self.bus = Bus(name, place, DIGEST, self.gate, BusOptions(tell_every_s=0.1))

    def counts(self) -> dict[tuple[str, str], int]:
        """Return the numbers of refused messages by sender and reason."""
        return {(entry.sender, entry.reason): entry.count for entry in self.rejections}

    def waits_for(self, condition: Callable[[], bool]) -> bool:
        """Read messages until a condition holds; none of them may be an event."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.bus.next(0.01) is None
            if time.monotonic() > deadline:
                return False
        return True


@contextmanager
def stranger(port: int) -> Iterator[zenoh.Session]:
    """Open a session to a port; it is no process of the run."""
    configuration = {
        "mode": "peer",
        "connect": {
            "endpoints": [f"tcp/127.0.0.1:{port}"],
            "exit_on_failure": True,
            "timeout_ms": 10_000,
        },
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as session:
        yield session


@contextmanager
def connected(join_timeout_s: float = 1.0) -> Iterator[tuple[Plant, zenoh.Session]]:
    """Connect an unknown session to a plant."""
    port = free_base()
    plant = Plant(port, join_timeout_s)
    try:
        with stranger(port) as session:
            key = f"{KEYS.prefix}/tick"
            put = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)

            def connected() -> bool:
                put.put(b"?")
                return plant.rejections.total > 0

            assert plant.waits_for(connected)
            yield plant, session
    finally:
        plant.bus.close()


@pytest.fixture
def network() -> Iterator[tuple[Plant, zenoh.Session]]:
    """A plant and an unknown session that is connected to the plant."""
    with connected() as both:
        yield both


def test_a_stranger_is_counted(network: tuple[Plant, zenoh.Session]) -> None:
    """Garbage, deletions, oversized messages and bad tokens are refused with their reasons."""
    plant, session = network
    block = zenoh.CongestionControl.BLOCK
    session.put(f"{KEYS.prefix}/plan/2", bytes([VERSION]) + b"hello", congestion_control=block)
    session.put(f"{KEYS.prefix}/plan/3", bytes(MAX_BYTES + 1), congestion_control=block)
    session.delete(f"{KEYS.prefix}/control")
    tokens = [
        session.liveliness().declare_token(f"{KEYS.prefix}/{end}")
        for end in ("alive/agent1/soon/x", "ready/agent1", f"alive/agent1/7/{'f' * 12}/{VERSION}")
    ]
    expected = {
        ("plan/2", "malformed"): 1,
        ("plan/3", "oversized"): 1,
        ("control", "malformed"): 1,
        ("alive/agent1/soon/x", "malformed"): 1,
        ("ready/agent1", "malformed"): 1,
    }
    assert plant.waits_for(lambda: expected.items() <= plant.counts().items())
    for token in tokens:
        token.undeclare()  # type: ignore[no-untyped-call]


def test_messages_of_announced_processes_are_accepted(network: tuple[Plant, zenoh.Session]) -> None:
    """A message may overtake its sender's token.

    The end of the token is an event, unless of another scenario.
    """
    plant, session = network
    block = zenoh.CongestionControl.BLOCK
    session.put(f"{KEYS.prefix}/tick", encode(runs.tick(0)), congestion_control=block)
    arrival = plant.bus.next(PATIENCE_S)
    assert arrival is not None
    assert arrival.event == runs.tick(0)
    other = session.liveliness().declare_token(KEYS.alive("coordinator", 0, "another", VERSION))
    token = session.liveliness().declare_token(KEYS.alive("coordinator", 0, DIGEST, VERSION))
    assert plant.waits_for(lambda: "coordinator" in plant.bus.alive)
    other.undeclare()  # type: ignore[no-untyped-call]
    token.undeclare()  # type: ignore[no-untyped-call]
    arrival = plant.bus.next(PATIENCE_S)
    assert arrival is not None
    assert arrival.event == Presence("coordinator", 0, alive=False)


def test_the_recorder_is_told_who_has_sent_its_last_message() -> None:
    """Each process by its name."""
    port = free_base()
    recorder = Plant(port, name="recorder")
    names = ("plant", "agent12")
    told: list[object] = []
    try:
        with stranger(port) as session:
            block = zenoh.CongestionControl.BLOCK
            signs = [
                session.declare_publisher(KEYS.left(name), congestion_control=block)
                for name in names
            ]
            deadline = time.monotonic() + PATIENCE_S
            while len({*told}) < len(names) and time.monotonic() < deadline:
                for sign in signs:
                    sign.put(b"")
                arrival = recorder.bus.next(0.01)
                if arrival is not None:
                    told.append(arrival.event)
    finally:
        recorder.bus.close()
    assert {*told} == {Departed(name) for name in names}


def pass_on(server: socket.socket, port: int, delay_s: float) -> None:
    """Pass on what comes to a server to a port, each piece after a delay, and what comes back at once."""

    def copy(source: socket.socket, target: socket.socket, pause_s: float) -> None:
        with suppress(OSError), source, target:
            while data := source.recv(65_536):
                time.sleep(pause_s)
                target.sendall(data)

    with suppress(OSError):
        while True:
            client, _ = server.accept()
            there = socket.create_connection(("127.0.0.1", port))
            for ends in ((client, there, delay_s), (there, client, 0.0)):
                threading.Thread(target=copy, args=ends, daemon=True).start()


def test_a_process_that_is_slow_is_reached() -> None:
    """Its part of the opening of a connection takes longer than the first attempt of a client."""
    port = free_base()
    plant = Plant(port)
    plant.bus.announce()
    is_over = threading.Event()
    reading = threading.Thread(target=lambda: plant.waits_for(is_over.is_set), daemon=True)
    reading.start()
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            threading.Thread(target=pass_on, args=(server, port, 0.3), daemon=True).start()
            at = f"tcp/127.0.0.1:{server.getsockname()[1]}"
            answer = ask(KEYS.run, Reach(connect=[at]), "plant", "health", {})
            server.shutdown(socket.SHUT_RDWR)
    finally:
        is_over.set()
        reading.join()
        plant.bus.close()
    assert answer["name"] == "plant"


def test_what_comes_early_is_kept(network: tuple[Plant, zenoh.Session]) -> None:
    """A process that is ready, and messages that come, before this one has joined reach its node."""
    plant, session = network
    liveliness = session.liveliness()
    ready = liveliness.declare_token(KEYS.ready("agent1", 0))
    block = zenoh.CongestionControl.BLOCK
    session.put(f"{KEYS.prefix}/tick", encode(runs.tick(0)), congestion_control=block)
    alive = liveliness.declare_token(KEYS.alive("agent1", 0, DIGEST, VERSION))

    assert plant.bus.join(["agent1"]) is None
    arrivals = [plant.bus.next(PATIENCE_S) for _ in range(3)]
    events = [arrival.event for arrival in arrivals if arrival is not None]
    # Tokens and messages have no common order.
    assert Presence("agent1", 0, alive=True) in events
    assert runs.tick(0) in events
    for token in (ready, alive):
        token.undeclare()  # type: ignore[no-untyped-call]


def test_what_comes_early_comes_before_what_came_later(
    network: tuple[Plant, zenoh.Session],
) -> None:
    """A process that was ready, and ended while this one joined, is ready first and then gone."""
    plant, session = network
    liveliness = session.liveliness()
    alive = liveliness.declare_token(KEYS.alive("agent2", 0, DIGEST, VERSION))
    ready = liveliness.declare_token(KEYS.ready("agent2", 0))
    tokens = [ready]

    def others_change(_: str) -> None:
        """Let the awaited process come, and the other one go, before the next item is read."""
        if len(tokens) == 1:
            tokens.append(liveliness.declare_token(KEYS.alive("agent1", 0, DIGEST, VERSION)))
            alive.undeclare()  # type: ignore[no-untyped-call]
            time.sleep(0.5)

    assert plant.bus.join({"agent1"}, others_change) is None
    arrivals = [plant.bus.next(PATIENCE_S) for _ in range(2)]
    assert [None if arrival is None else arrival.event for arrival in arrivals] == [
        Presence("agent2", 0, alive=True),
        Presence("agent2", 0, alive=False),
    ]
    for token in tokens:
        token.undeclare()  # type: ignore[no-untyped-call]


def test_a_process_that_waits_gives_signs_of_life(network: tuple[Plant, zenoh.Session]) -> None:
    """While others are missing, a sentence names them at every interval, until the time is over."""
    said: list[str] = []
    with pytest.raises(BusError, match="no sign of agent1, agent2 within 1 s"):
        network[0].bus.join(["agent1", "agent2"], said.append)
    assert 2 <= len(said) <= 10
    assert all(text.startswith("waiting for agent1, agent2; gives up in ") for text in said)


def test_another_version_is_refused_by_name(network: tuple[Plant, zenoh.Session]) -> None:
    """A process with another version of the protocol is not joined.

    The error names both versions and the remedy.
    """
    plant, session = network
    token = session.liveliness().declare_token(
        f"{KEYS.prefix}/alive/coordinator/0/{DIGEST}/{VERSION + 1}"
    )
    expected = f"coordinator speaks version {VERSION + 1} of the protocol, plant version {VERSION}: install the same"
    with pytest.raises(BusError, match=expected):
        plant.bus.join(["coordinator"])
    token.undeclare()  # type: ignore[no-untyped-call]


def test_a_new_incarnation_is_announced_after_all_that_came_before(
    network: tuple[Plant, zenoh.Session],
) -> None:
    """What a process reads after a long stop may be older than the end of the coordinator.

    Without an answer of the coordinator it announces nothing.
    """
    plant, session = network
    bus = plant.bus
    assert bus.join([]) is None
    joined = bus.next(PATIENCE_S)  # it sees its own token
    assert joined is not None
    assert joined.event == Presence("plant", 0, alive=True)
    bus.renew(1)
    assert bus.next(0.1) is None
    assert bus.incarnation == 0

    coordinator = session.liveliness().declare_token(KEYS.alive("coordinator", 0, DIGEST, VERSION))
    assert plant.waits_for(lambda: "coordinator" in bus.alive)
    key = KEYS.request("coordinator", "status")
    status = session.declare_queryable(key, lambda query: query.reply(key, "{}"))
    coordinator.undeclare()  # type: ignore[no-untyped-call]
    time.sleep(1.5)  # the coordinator is asked again

    bus.renew(1)
    arrival = bus.next(PATIENCE_S)
    assert arrival is not None
    assert arrival.event == Presence("coordinator", 0, alive=False)
    assert bus.incarnation == 0
    own = [bus.next(PATIENCE_S)]
    if own[0] is not None and own[0].event == Presence("plant", 0, alive=False):
        own.append(bus.next(PATIENCE_S))  # tokens of one process come in any order
    assert own[-1] is not None
    assert own[-1].event == Presence("plant", 1, alive=True)
    assert bus.incarnation == 1
    status.undeclare()  # type: ignore[no-untyped-call]


def test_a_wait_begins_anew_while_all_that_are_missing_start() -> None:
    """Each is asked for, as its work since the last question counts; one that does not start ends the wait."""
    timeout_s = 0.2
    plant = Plant(free_base(), timeout_s)
    asked: list[str] = []

    def is_starting(name: str) -> bool:
        asked.append(name)
        return (name == "agent2" or len(asked) <= 2) and len(asked) <= 4

    begun_s = time.monotonic()
    with pytest.raises(BusError, match="no sign of agent1, agent2 within"):
        plant.bus.join({"agent1", "agent2"}, is_starting=is_starting)
    assert time.monotonic() - begun_s >= 2 * timeout_s
    assert asked == ["agent1", "agent2"] * 2
    plant.bus.close()


def test_those_that_were_never_seen_are_named_before_those_that_have_left() -> None:
    """A process that was there, and is gone, is named if no other is missing."""
    with connected(join_timeout_s=0.1) as (plant, session):
        token = session.liveliness().declare_token(KEYS.alive("agent1", 0, DIGEST, VERSION))
        assert plant.waits_for(lambda: "agent1" in plant.bus.alive)
        token.undeclare()  # type: ignore[no-untyped-call]
        assert plant.bus.next(PATIENCE_S) is not None
        for expected, named in ((["agent1", "agent2"], "agent2"), (["agent1"], "agent1")):
            with pytest.raises(BusError, match=f"no sign of {named} within"):
                plant.bus.join(expected)


@pytest.mark.parametrize(
    ("status", "awaited"),
    [
        ({"tick": -1, "members": [2]}, "agent1, vehicle1"),
        ({"tick": 0, "members": [2, 3]}, ""),
        ({"tick": 0, "members": [1, 2]}, "agent1"),
        ({"tick": 7, "members": [2], "observers": ["viewer"]}, "viewer"),
    ],
)
def test_one_that_joins_late_waits_for_those_that_take_part(
    status: dict[str, object], awaited: str
) -> None:
    """Once the run has begun: for agents on the roster that it expects, and for observers."""
    with connected(join_timeout_s=PATIENCE_S) as (plant, session):
        liveliness = session.liveliness()
        tokens = [
            liveliness.declare_token(KEYS.alive(name, 0, DIGEST, VERSION))
            for name in ("coordinator", "agent2")
        ]
        tokens.append(liveliness.declare_token(KEYS.ready("coordinator", 0)))
        key = KEYS.request("coordinator", "status")
        asked: list[str] = []

        def answer(query: zenoh.Query) -> None:
            query.reply(key, json.dumps(status))
            asked.append(key)

        queryable = session.declare_queryable(key, answer)
        said: list[str] = []

        def on_wait(text: str) -> None:
            said.append(text.partition(";")[0])
            if asked and said[-2:] == [f"waiting for {awaited}"] * 2:
                plant.bus.interrupt("as expected")

        end = plant.bus.join(["coordinator", "agent1", "agent2", "vehicle1"], on_wait)
        assert (end is None) is (not awaited)
        queryable.undeclare()  # type: ignore[no-untyped-call]
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize(
    ("leave_first", "waits"),
    [(["agent1"], True), (["recorder"], True), (["agent1", "recorder"], False)],
)
def test_a_process_leaves_after_the_recorder_and_others(
    network: tuple[Plant, zenoh.Session], leave_first: list[str], waits: bool
) -> None:
    """It tells that its last message is sent, and waits for them until it is interrupted."""
    plant, session = network
    told = session.declare_subscriber(KEYS.left("plant"))
    tokens = {
        name: session.liveliness().declare_token(KEYS.alive(name, 0, DIGEST, VERSION))
        for name in ("agent1", "recorder")
    }
    assert plant.waits_for(lambda: tokens.keys() <= plant.bus.alive.keys())
    for name in leave_first:
        tokens.pop(name).undeclare()  # type: ignore[no-untyped-call]
    interrupted: list[float] = []

    def interrupt() -> None:
        interrupted.append(time.monotonic())
        plant.bus.interrupt("of the test")

    timer = threading.Timer(0.3 if waits else PATIENCE_S, interrupt)
    timer.start()
    begun_s = time.monotonic()
    plant.bus.leave(after=["agent1"])
    timer.cancel()
    assert time.monotonic() - begun_s < LINGER_S
    assert bool(interrupted) is waits
    while not (left := told.try_recv()) and time.monotonic() < begun_s + PATIENCE_S:
        time.sleep(0.01)
    assert left is not None
    for token in tokens.values():
        token.undeclare()  # type: ignore[no-untyped-call]
