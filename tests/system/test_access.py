"""Access control: sessions with right, wrong or no keys against a process with keys."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace

from tests.support import attacker, runs
from tests.support.commands import free_base
from tests.support.keyrings import keyring
from tests.support.messages import sample
from tests.support.runs import setup
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.bus import Bus
from transport.protocol.network.bus_events_and_clock import BusOptions, Place
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.security import Security, access_control
from transport.protocol.wire.bundles import BUNDLES
from transport.protocol.wire.codec import VERSION, encode
from transport.protocol.wire.key_expressions import ACTING, OPERATOR, READING, ROUTER, WATCHER, Keys
from transport.protocol.wire.messages import KINDS, Message, Plan
from transport.protocol.wire.names import agent_name, vehicle_name

KEYS = Keys("guarded")
DIGEST = "0123456789ab"
TEAM = ("coordinator", "plant", "agent1", "agent2", "agent3", "agent4", "recorder")
SHOTS = 1000
# A session repeats its own message until it has arrived.
MOST_REPEATED = 5

# Time for actions of milliseconds on a busy machine.
PATIENCE_S = 20.0
# Timeout of a session without the right keys.
REFUSED_S = 1.0


class Guarded:
    """Bus of a process with keys, and its refusals.

    Args:
        name: Process name.
        port: Port to listen on.
    """

    def __init__(self, name: str, port: int) -> None:
        self.at = f"tls/127.0.0.1:{port}"
        self.gate = Gate(name, KEYS, setup().rules.shape)
        security = Security(keyring("one"), TEAM)
        place = Place(
            run=KEYS.run, endpoints=Endpoints(listen=[self.at], connect=[], security=security)
        )
        options = BusOptions(serves=name == "coordinator")
        self.bus = Bus(name, place, DIGEST, self.gate, options)

    def accepted(self, timeout_s: float) -> list[Message]:
        """Return accepted messages until a timeout after the last one."""
        messages: list[Message] = []
        while True:
            arrival = self.bus.next(timeout_s)
            if arrival is None or not isinstance(arrival.event, Message):
                return messages
            messages.append(arrival.event)

    @property
    def reached(self) -> int:
        """Return the number of messages that reached the bus and were refused."""
        return self.gate.rejections.total


@pytest.fixture(scope="module", name="plant")
def guarded_plant() -> Iterator[Guarded]:
    """Run a plant that listens with TLS."""
    plant = Guarded("plant", free_base())
    try:
        yield plant
    finally:
        plant.bus.close()


@contextmanager
def session_of(plant: Guarded, folder: Path, name: str) -> Iterator[zenoh.Session]:
    """Open a session with the certificate of a name."""
    with attacker.session([plant.at], attacker.tls(folder, name)) as session:
        yield session


def reaches(plant: Guarded, session: zenoh.Session, key: str) -> bool:
    """Return whether messages of a session under a key reach the plant."""
    before, deadline = plant.reached, time.monotonic() + PATIENCE_S
    while plant.reached == before and time.monotonic() < deadline:
        attacker.say(session, key, b"?")
        plant.accepted(0.05)
    return plant.reached > before


def test_sessions_without_keys_are_refused(plant: Guarded) -> None:
    """A session without certificate, with one of another authority, or without TLS is refused."""
    one, other = keyring("one"), keyring("other")
    wrong = {
        "none": (plant.at, attacker.tls(None, "", one / "ca.pem")),
        "another's": (plant.at, attacker.tls(other, "agent1", one / "ca.pem")),
        "no TLS": (plant.at.replace("tls/", "tcp/"), None),
    }
    for case, (at, secure) in wrong.items():
        with pytest.raises(zenoh.ZError), attacker.session([at], secure, REFUSED_S):
            pytest.fail(f"{case}: got in")
    with attacker.session([plant.at], attacker.tls(one, "agent1"), PATIENCE_S) as session:
        assert reaches(plant, session, f"{KEYS.prefix}/plan/1")


@pytest.mark.parametrize("impostor", ["agent1", "recorder", WATCHER, OPERATOR])
def test_impostors_are_refused(plant: Guarded, impostor: str) -> None:
    """With another certificate none of 1000 messages and no token of agent 2 or the coordinator is accepted."""
    forged = {f"{KEYS.prefix}/{end}": b"?" for end in ("plan/2", "tick", "control", "relay")}
    with session_of(plant, keyring("one"), impostor) as session:
        if impostor == "agent1":
            # The session is connected: its own messages arrive.
            assert reaches(plant, session, f"{KEYS.prefix}/plan/1")
        else:
            time.sleep(0.3)
        plant.accepted(0.1)
        before = plant.reached
        tokens = [
            session.liveliness().declare_token(KEYS.alive(name, 5, DIGEST, VERSION))
            for name in ("coordinator", "agent2")
        ]
        for key, data in forged.items():
            for _ in range(SHOTS):
                attacker.say(session, key, data)
            session.delete(key)
        if impostor == "agent1":  # all its earlier messages have arrived before this one
            assert reaches(plant, session, f"{KEYS.prefix}/plan/1")
            before += 1
        assert plant.accepted(0.3) == []
        extra = plant.reached - before
        # Its own messages, repeated until one arrived.
        assert 0 <= extra <= (MOST_REPEATED if impostor == "agent1" else 0)
        assert {entry.sender for entry in plant.gate.rejections} <= {"plan/1"}
        assert all(plant.bus.alive.get(name) is None for name in ("coordinator", "agent2"))
        del tokens


def test_the_same_messages_from_the_owner(plant: Guarded) -> None:
    """The same messages are accepted from the owner of the certificate.

    A tick, the end, and a token.
    """
    with session_of(plant, keyring("one"), "coordinator") as session:
        token = session.liveliness().declare_token(KEYS.alive("coordinator", 0, DIGEST, VERSION))
        assert reaches(plant, session, f"{KEYS.prefix}/tick")
        sent = [runs.tick(0), replace(runs.end(), sequence=10)]
        for message in sent:
            attacker.say(session, KEYS.of(message), encode(message))
        assert plant.accepted(1.0) == sent
        token.undeclare()  # type: ignore[no-untyped-call]


def test_rights_to_request() -> None:
    """All key holders may request the health of a process.

    Only an operator may request a change of links.
    """
    port = free_base()
    coordinator = Guarded("coordinator", port)

    def answered(name: str, request: str) -> bool:
        with attacker.session([coordinator.at], attacker.tls(keyring("one"), name)) as session:
            deadline = time.monotonic() + (PATIENCE_S if request == "health" else 1.0)
            while time.monotonic() < deadline:
                handler = session.get(
                    KEYS.request("coordinator", request), payload="{}", timeout=1.0
                )
                arrival = coordinator.bus.next(0.1)
                if arrival is not None:
                    arrival.event.reply({"fine": True})  # type: ignore[union-attr]
                if any(reply.ok is not None for reply in handler):
                    return True
        return False

    try:
        for name in (WATCHER, "agent1"):
            assert answered(name, "health"), name
            assert not answered(name, "link"), name
        assert answered(OPERATOR, "link")
    finally:
        coordinator.bus.close()


def test_rights_of_a_name() -> None:
    """A process answers, and is there, in its own name alone, and reads what it subscribes to.

    Watchers and operators read all and answer nothing; an operator may change the run.
    """
    rules = access_control(TEAM, KEYS.prefix)
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    names = {one["id"]: one["cert_common_names"] for one in rules["subjects"]}
    assert names == {name: [name] for name in (*TEAM, WATCHER, OPERATOR, ROUTER)}

    reading, acting = ({f"ask/*/{what}" for what in some} for some in (READING, ACTING))
    for policy in rules["policies"]:
        (name,) = policy["subjects"]
        if name == ROUTER:
            continue
        may: dict[str, set[str]] = {}
        for rule in (by_id[one] for one in policy["rules"] if one != "out"):
            for kind in rule["messages"]:
                may.setdefault(kind, set()).update(map(KEYS.end, rule["key_exprs"]))

        is_process = name not in (WATCHER, OPERATOR)
        reads = set(map(KEYS.end, KEYS.subscriptions(name))) if is_process else {"**"}
        assert may["declare_subscriber"] == reads
        answers = {f"ask/{name}/*"} if is_process else None
        assert may.get("declare_queryable") == may.get("reply") == answers
        is_there = {f"alive/{name}/**", f"ready/{name}/**"} if is_process else None
        assert may.get("liveliness_token") == is_there
        for sees in ("declare_liveliness_subscriber", "liveliness_query"):
            assert may[sees] == {"alive/**", "ready/**"}
        assert may["query"] == (reading | acting if name == OPERATOR else reading)


def test_rights_to_put() -> None:
    """By the access rules only the owner of a key may put a message on it."""
    vehicles = [vehicle_name(uav) for uav in range(1, 5)]
    rules = access_control([*TEAM, *vehicles], KEYS.prefix)
    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")
    assert all(rule["permission"] == "allow" for rule in rules["rules"])
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    may_put: dict[str, set[str]] = {}
    for policy in rules["policies"]:
        (name,) = policy["subjects"]
        own = [by_id[rule] for rule in policy["rules"] if "ingress" in by_id[rule]["flows"]]
        may_put[name] = {
            key for rule in own if "put" in rule["messages"] for key in rule["key_exprs"]
        }
    assert may_put.pop(ROUTER) == {f"{KEYS.prefix}/**"}
    assert [name for name, keys in may_put.items() if not keys] == ["recorder", WATCHER, OPERATOR]
    for kind in (*KINDS.values(), *BUNDLES.values()):
        message = sample(kind)
        if message.sender == "recorder":
            continue  # only written into the log
        key = KEYS.of(message)
        owners = [
            name
            for name, keys in may_put.items()
            if key in keys or f"{key.rpartition('/')[0]}/*" in keys
        ]
        expected = [message.sender]
        if (
            kind.route.by_vehicles
        ):  # above autopilots the vehicle of the UAV takes the plant's place
            expected.append(vehicle_name(message.agent))
        assert owners == expected, kind
    assert f"{KEYS.prefix}/plan/2" in may_put[agent_name(2)]
    unshared = KEYS.of(sample(Plan, shared=False))
    assert [name for name, keys in may_put.items() if unshared in keys] == [agent_name(2)]
