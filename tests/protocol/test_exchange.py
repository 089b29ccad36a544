"""The exchange of each process: what is sent when, and in which bundle."""

import os
import signal

import pytest
from msgspec.structs import replace

from coordinator.node import CoordinatorNode
from plant.node import PlantNode
from protocol.network import process
from protocol.network.process import Exchange, exchange_of
from protocol.scenario.faults import Fault
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Answer, Bundle, Message, Plan, Presence, Relay, StepReport, agent_name
from protocol.wire.node import Outbox
from tests.support import logs, runs
from tests.support.runs import ALL, INCARNATION, SHORT, setup
from tests.support.wire import NodeReceiver, without_network

KEYS = Keys("paper")
RUN = setup()


class Line:
    """The exchange of a process, and what it sends."""

    def __init__(self, name: str, run: Setup = RUN, incarnation: int = 0) -> None:
        self._put: list[tuple[str, bytes]] = []
        self.exchange: Exchange = exchange_of(
            run, name, incarnation, KEYS, lambda key, data: self._put.append((KEYS.end(key), data))
        )

    def sent(self) -> list[str]:
        """Return the keys sent under since the last call, those of bundles with the keys of their messages."""
        return [said(key, data) for key, data in self.taken()]

    def taken(self) -> list[tuple[str, bytes]]:
        """Return keys and bytes sent since the last call."""
        put, self._put = self._put, []
        return put

    def send(self, *messages: Message) -> None:
        """Send messages."""
        for message in messages:
            self.exchange.send(message)

    def receive(self, *bundles: Bundle) -> None:
        """Receive the plans of bundles as accepted."""
        for bundle in bundles:
            for data in bundle.parts:
                if isinstance(message := decode(data), Plan):
                    self.exchange.received(message, bundle)


def said(key: str, data: bytes) -> str:
    """Return a key, for a bundle with tick, number and keys of its messages."""
    message = decode(data)
    if not isinstance(message, Bundle):
        return key
    return f"{key} {message.tick} #{message.sequence}: {' '.join(message.keys)}"


def plan(agent: int, k: int, **changes: int | bool) -> Plan:
    """Return an agent's plan of tick k."""
    return replace(runs.plan(RUN, agent, k), **changes)


def report(agent: int, k: int, incarnation: int = INCARNATION) -> StepReport:
    """Return an agent's report of tick k."""
    return replace(logs.report(RUN, agent, k), incarnation=incarnation, sequence=2 * k + 1)


def answer(agent: int, k: int) -> Answer:
    """Return an agent's answer of tick k, as its process sends it."""
    line = Line(agent_name(agent), incarnation=INCARNATION)
    line.send(plan(agent, k), report(agent, k))
    line.exchange.flush()
    ((_, data),) = line.taken()
    made = decode(data)
    assert isinstance(made, Answer)
    return made


def test_shared_plans_travel_with_the_next_measurements() -> None:
    """The plant passes accepted, shared plans on unchanged, once, with measurements; those are for the record too."""
    keys, plans = ("plan/1", "unshared/2", "plan/3"), (plan(1, 0), plan(2, 0, shared=False), plan(3, 0))
    line, relay = (
        Line("plant"),
        Outbox("coordinator", 0).stamp(Relay, tick=0, keys=keys, parts=tuple(map(encode, plans))),
    )
    line.receive(relay)
    line.exchange.settle()
    assert line.sent() == []
    line.send(*(replace(runs.measurement(RUN, agent, 1), sequence=agent) for agent in (1, 2)))
    line.exchange.settle()
    (key, data), recorded = line.taken()
    assert said(key, data) == "instant 1 #0: plan/1 plan/3 measurement/1 measurement/2"
    assert said(*recorded) == "record 1 #1: measurement/1 measurement/2"
    instant = decode(data)
    assert isinstance(instant, Bundle)
    assert instant.parts[:2] == (relay.parts[0], relay.parts[2])
    line.exchange.settle()
    assert line.sent() == []


def test_answers_are_sent_before_the_end() -> None:
    """The end of a run comes after the answers so far, complete or not."""
    line = Line("coordinator")
    line.send(runs.tick(0))
    line.taken()
    line.receive(answer(2, 0))
    line.send(runs.end())
    assert line.sent() == ["relay 0 #1: plan/2 report/2", "control"]


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let buses open sessions without a network."""
    without_network(monkeypatch)


def coordinator(*settings: str) -> NodeReceiver:
    """Return a coordinator that has opened tick 0."""
    run = setup(SHORT, *settings)
    receiver = NodeReceiver(CoordinatorNode(run), KEYS, run)
    names = ["plant", *map(agent_name, run.agents)]
    for name in names:
        receiver.gate.announce(name, INCARNATION if name.startswith("agent") else 0)
    ready = [Presence(name, 0 if name == "plant" else INCARNATION, alive=True) for name in names]
    sent = [said(KEYS.end(key), data) for event in ready for key, data in receiver.meet(event)]
    assert sent == ["roster", "relay 0 #0: tick"]
    return receiver


def hears(receiver: NodeReceiver, *arrived: tuple[str, bytes] | Message) -> list[str]:
    """Return what a process sends when messages arrive one by one."""
    found = []
    for one in arrived:
        key, data = (KEYS.of(one), encode(one)) if isinstance(one, Message) else one
        found += [said(KEYS.end(end), sent) for end, sent in receiver.hear(key, data)]
    return found


@pytest.mark.usefixtures("no_network")
def test_only_accepted_plans_are_relayed() -> None:
    """An answer whose plan the coordinator refuses is not relayed, nor its report; the true one that follows is."""
    node = coordinator()
    true = answer(2, 0)
    huge = plan(2, 0, sequence=50)
    huge = replace(huge, inputs=huge.inputs + 1e3)
    forged = [replace(true, sequence=7, parts=(encode(huge), true.parts[1])), replace(true, keys=(), parts=())]
    assert hears(node, *forged, answer(1, 0), answer(3, 0), answer(4, 0)) == []
    expected = " ".join(f"plan/{agent} report/{agent}" for agent in ALL)
    assert hears(node, true) == [f"relay 1 #1: {expected} tick"]
    assert [(entry.sender, entry.reason, entry.count) for entry in node.gate.rejections] == [
        ("agent2", "outside_limits", 1),
    ]


@pytest.mark.usefixtures("no_network")
def test_kept_messages_are_sent_before_a_scripted_kill(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages of earlier ticks leave the process before a scripted fault at a message ends it."""
    run = setup(SHORT)
    node = PlantNode(run)
    receiver = NodeReceiver(node, KEYS, run)
    killed: list[list[str]] = []

    def kill(pid: int, number: int) -> None:
        assert (pid, number) == (os.getpid(), signal.SIGKILL)
        killed.append(line.sent())

    monkeypatch.setattr(os, "kill", kill)
    line = Line("plant", run)
    line.send(runs.plant_state(run, 3))
    fault = Fault(tick=4, target="plant", do="kill")
    process._fail_if_due([fault], receiver.node.name, runs.tick(3), line.exchange)
    assert killed == []
    process._fail_if_due([fault], receiver.node.name, runs.tick(4), line.exchange)
    assert killed == [["record 3 #0: plant_state"]]
