"""The gate: size, form, sender, incarnation, order and moment of messages, alone and in bundles; counts of refusals."""

import dataclasses
from typing import Any, TypeVar

import pytest

from tests.support import runs
from tests.support.messages import changed, sample
from tests.support.runs import setup, ticks
from transport.protocol.admission.acceptance_and_refusals import Gate, Sample
from transport.protocol.wire.bundles import Answer, Bundle, Relay
from transport.protocol.wire.codec import MAX_BYTES, decode, encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import (
    LinkChange,
    Message,
    Note,
    Plan,
    Target,
    VehicleStatus,
)
from transport.protocol.wire.outbox import Outbox

RUN = setup("controller.horizon=5", ticks(60))
KEYS = Keys(RUN.scenario.name)
B = TypeVar("B", bound=Bundle)


class Receiver:
    """A gate, and what it lets through."""

    def __init__(self, name: str = "plant", *settings: str, **options: Any) -> None:
        self.run = setup("controller.horizon=5", ticks(60), *settings)
        self.gate = Gate(name, KEYS, self.run.rules.shape, **options)

    def hear(self, message: Message, **changes: Any) -> bool:
        """Return whether a message that comes alone under its own key is accepted."""
        said = changed(message, **changes)
        return len(list(self.gate.accept(KEYS.of(said), encode(said)))) == 1

    def reasons(self) -> list[tuple[str, str]]:
        """Return sender and reason of all refusals, in the order of the first of each."""
        return [(entry.sender, entry.reason) for entry in self.gate.rejections]


def bundle_of(kind: type[B], sender: str, *parts: Message, **fields: Any) -> B:
    """Return a bundle of the first start of its sender that carries messages."""
    ends = [KEYS.end(KEYS.of(part)) for part in parts]
    data = [encode(part) for part in parts]
    return Outbox(sender, 1).stamp(kind, tick=parts[0].tick, keys=ends, parts=data, **fields)


def answer(*parts: Message, agent: int = 2) -> Answer:
    """Return an agent's answer that carries messages."""
    return bundle_of(Answer, f"agent{agent}", *parts, agent=agent)


def plan(k: int, agent: int = 2, **changes: Any) -> Plan:
    """Return a plan of tick k."""
    return changed(runs.plan(RUN, agent, k), **changes)


NEGOTIATED = "controller.negotiation_iterations=3"
DIRECT = ("clock.mode=realtime", "clock.speed=1.0")


def direct(k: int, **changes: Any) -> Plan:
    """Return a plan as in real time, where it comes alone."""
    return plan(k, start_tick=k + 1, **changes)


@pytest.mark.parametrize(
    ("key", "message", "sender", "reason"),
    [
        ("plan/2", b"", "plan/2", "malformed"),
        ("plan/2", encode(plan(0))[:-1], "plan/2", "malformed"),
        ("plan/2", encode(plan(0)) + bytes(MAX_BYTES), "plan/2", "oversized"),
        ("plan/3", encode(direct(0)), "agent2", "wrong_sender"),
        ("plan/2", encode(direct(0, sender="agent3")), "agent3", "wrong_sender"),
        ("tick", encode(changed(runs.tick(0), sender="agent3")), "agent3", "wrong_sender"),
        ("tick", encode(direct(0)), "agent2", "wrong_sender"),
        ("plan/9", encode(changed(direct(0), agent=9, sender="agent9")), "agent9", "unknown_agent"),
        ("plant_state", encode(runs.plant_state(RUN, 0)), "plant", "wrong_sender"),
        ("plan/2", encode(direct(0, uavs=(3,))), "agent2", "wrong_uavs"),
        (
            "plan/2",
            encode(direct(0, inputs=runs.plan(RUN, 2, 0).inputs + 1e3)),
            "agent2",
            "outside_limits",
        ),
        # The header can be read, so the sender is not taken from the key.
        ("plan/3", encode(direct(0, negotiation=-1)), "agent2", "out_of_range"),
    ],
)
def test_each_check_has_its_reason(key: str, message: bytes, sender: str, reason: str) -> None:
    """A bad message is counted once, by sender (or key) and reason, and does not block the true one."""
    receiver = Receiver("plant", *DIRECT)
    assert list(receiver.gate.accept(f"{KEYS.prefix}/{key}", message)) == []
    assert receiver.reasons() == [(sender, reason)]
    assert receiver.hear(direct(0))
    assert receiver.gate.rejections.total == 1


@pytest.mark.parametrize(
    ("first", "again", "reason"),
    [
        (direct(5), {}, "replayed"),
        (direct(5), {"sequence": 99}, "past"),
        (direct(5), {"sequence": 99, "tick": 4, "start_tick": 5}, "past"),
        (direct(5), {"sequence": 99, "shared": False}, "past"),  # under the other key
        (
            direct(5),
            {"sequence": 99, "incarnation": 0, "tick": 6, "start_tick": 7},
            "wrong_incarnation",
        ),
        (direct(5), {"tick": 6, "start_tick": 7}, ""),  # where ticks grow, numbers need not
        (
            direct(5),
            {"sequence": 99, "incarnation": 2, "tick": 6, "start_tick": 7},
            "wrong_incarnation",
        ),
        (runs.tick(5), {}, "replayed"),
        (runs.tick(5), {"sequence": 99, "tick": 6}, ""),
        (runs.roster(), {"sequence": 99}, "past"),
        (runs.roster(), {"sequence": 99, "version": 2}, ""),
        (runs.end(), {}, "replayed"),
        (runs.end(), {"sequence": 99}, ""),
        (sample(LinkChange), {}, "replayed"),
        (sample(LinkChange), {"sequence": 99}, ""),  # repeated for an agent that joins
    ],
)
def test_order(first: Message, again: dict[str, Any], reason: str) -> None:
    """Under each kind and sender, tick, version or number grows; what does not is refused."""
    receiver = Receiver("plant", *DIRECT)
    receiver.gate.announce(first.sender, first.incarnation)
    assert receiver.hear(first)
    assert receiver.hear(first, **again) == (not reason)
    assert [found for _, found in receiver.reasons()] == [reason] * bool(reason)


def test_proposals_have_their_own_order() -> None:
    """A proposal comes alone, and may overtake the plan of the tick before, which is relayed, or its token."""
    receiver = Receiver("agent1", NEGOTIATED)
    last = Outbox("coordinator", 0)

    def relay(plan: Plan) -> bool:
        end, data = KEYS.end(KEYS.of(plan)), encode(plan)
        bundle = last.stamp(Relay, tick=plan.tick, keys=(end,), parts=(data,))
        return len(list(receiver.gate.accept(KEYS.of(bundle), encode(bundle)))) == 1

    assert receiver.hear(plan(0, negotiation=2))
    assert receiver.hear(plan(0, negotiation=1))
    assert not receiver.hear(plan(0, negotiation=2))
    assert receiver.hear(plan(1, negotiation=2))
    assert relay(plan(0))
    assert not receiver.hear(plan(0, negotiation=1))
    assert not receiver.hear(plan(1))  # alone: the coordinator could not relay it
    assert [reason for _, reason in receiver.reasons()] == ["replayed", "wrong_sender"]
    receiver.gate.announce("agent2", 1)
    assert receiver.hear(plan(1, negotiation=2, incarnation=2))
    assert not receiver.hear(plan(2, negotiation=2, incarnation=0))
    assert receiver.reasons()[-1] == ("agent2", "wrong_incarnation")


def test_an_announced_start_ends_the_one_before() -> None:
    """Once the token of a start has arrived, messages of earlier ones are refused.

    Plans in bundles are not: the roster decides on them. The exception is for agents alone.
    """
    receiver = Receiver("coordinator")
    for name, incarnation in (("agent2", 2), ("plant", 1), ("plant", 0)):  # the last token is late
        receiver.gate.announce(name, incarnation)
    said = runs.plant_state(RUN, 0)
    assert not receiver.hear(said)
    assert receiver.hear(said, incarnation=1)
    (accepted,) = receiver.gate.accept(f"{KEYS.prefix}/answer/2", encode(answer(plan(0))))
    assert isinstance(accepted.message, Plan)
    assert isinstance(accepted.bundle, Answer)
    assert receiver.reasons() == [("plant", "wrong_incarnation")]

    plant = Receiver("plant")
    plant.gate.announce("coordinator", 1)
    relay = bundle_of(Relay, "coordinator", runs.tick(0), plan(0))
    accepted_parts = plant.gate.accept(KEYS.of(relay), encode(relay))
    assert [type(each.message) for each in accepted_parts] == [Plan]
    assert plant.reasons() == [("coordinator", "wrong_incarnation")]


@pytest.mark.parametrize("shared", [True, False])
def test_an_answer_carries_messages_of_its_own_agent_only(shared: bool) -> None:
    """The bundle of one agent with a plan of another is counted against the first; a relay may carry it."""
    own, other = plan(0, shared=shared), plan(0, agent=3, shared=shared)
    receiver = Receiver("coordinator")
    forged = answer(other, own, agent=2)
    accepted = list(receiver.gate.accept(KEYS.of(forged), encode(forged)))
    assert [encode(each.message) for each in accepted if isinstance(each.message, Plan)] == [
        encode(own)
    ]
    assert receiver.reasons() == [("agent2", "wrong_sender")]

    plant = Receiver("plant")
    relay = bundle_of(Relay, "coordinator", other, own)
    assert len(list(plant.gate.accept(KEYS.of(relay), encode(relay)))) == 2
    assert plant.reasons() == []


def test_bundles_are_opened() -> None:
    """Each message of a bundle is checked as if it had come alone.

    Those for others are skipped, uncounted.
    """
    receiver = Receiver("agent1")
    good, forged = plan(3), plan(3, agent=3, uavs=(2,))
    own = plan(3, agent=1)
    keys = ["plan/2", "plan/3", "plan/1", "report/2", "tick", "plan/4", "control", "unshared/4"]
    parts = [
        encode(good),
        encode(forged),
        encode(own),
        b"any",
        b"any",
        b"?",
        encode(runs.end()),
        b"any",
    ]
    bundle = Outbox("coordinator", 0).stamp(Relay, tick=3, keys=keys, parts=parts)
    accepted = list(receiver.gate.accept(KEYS.of(bundle), encode(bundle)))
    messages = [each.message for each in accepted if isinstance(each.message, Message)]
    assert [encode(message) for message in messages] == [encode(good)]
    assert [encode(each.bundle) for each in accepted if each.bundle] == [encode(bundle)]
    assert receiver.reasons() == [
        ("agent3", "wrong_uavs"),
        ("plan/4", "wrong_version"),
        ("coordinator", "wrong_sender"),
    ]


def test_the_node_refuses_last() -> None:
    """What it cannot use at the moment has its reason, and may come again: its place is not taken."""
    asked: list[Message] = []

    def check_moment(message: Message) -> None:
        asked.append(message)
        if len(asked) == 1:
            raise MessageError("future", "of no use yet")

    receiver = Receiver("plant", *DIRECT, check_moment=check_moment)
    assert not receiver.hear(direct(0, uavs=(3,)))  # implausible: the node is not asked
    assert not receiver.hear(direct(0))
    assert receiver.hear(direct(0))
    assert [reason for _, reason in receiver.reasons()] == ["wrong_uavs", "future"]
    assert len(asked) == 2


def test_the_tick_is_that_of_the_run() -> None:
    """It is the newest of accepted messages, but for link changes and targets."""
    receiver = Receiver("plant")
    assert receiver.hear(runs.tick(5))
    assert receiver.gate.tick == 5
    for kind in (LinkChange, Target):
        assert receiver.hear(sample(kind), tick=9)
        assert receiver.gate.tick == 5
    assert not receiver.hear(runs.tick(3))
    assert receiver.gate.tick == 5
    assert receiver.hear(runs.tick(6))
    assert receiver.gate.tick == 6


def test_refusals_are_told_once_a_second() -> None:
    """Notices come at most once a second, each with the count since the one before."""
    receiver = Receiver("plant")
    start_ns, second_ns = 7 * 10**9, 10**9

    def told(now_ns: int | None) -> list[tuple[str, str, int]]:
        notices = receiver.gate.notices(1, now_ns)
        return [(notice.offender, notice.reason, notice.count) for notice in notices]

    assert receiver.hear(runs.tick(5))
    assert told(start_ns) == []
    assert not receiver.hear(runs.tick(5))
    assert told(start_ns) == [("coordinator", "replayed", 1)]
    for _ in range(2):
        assert not receiver.hear(runs.tick(5))
        assert told(start_ns + second_ns - 1) == []
    assert told(start_ns + second_ns) == [("coordinator", "replayed", 2)]
    assert told(start_ns + 3 * second_ns) == []
    for _ in range(2):  # without a time there is nothing to wait for
        assert not receiver.hear(runs.tick(5))
        assert told(None) == [("coordinator", "replayed", 1)]


@pytest.mark.parametrize("by_vehicles", [False, True])
def test_measurements_come_from_the_plant_or_from_vehicles(by_vehicles: bool) -> None:
    """Those of the other are refused: a run has one source of them."""
    shape = dataclasses.replace(RUN.rules.shape, by_vehicles=by_vehicles)
    gate = Gate("agent2", KEYS, shape)
    sources = "vehicle2", "plant"
    right, wrong = sources if by_vehicles else sources[::-1]
    measured = runs.measurement(RUN, 2, 3)
    for sender, accepted in ((wrong, 0), (right, 1)):
        said = changed(measured, sender=sender)
        assert len(list(gate.accept(KEYS.of(said), encode(said)))) == accepted
    assert [(entry.sender, entry.reason) for entry in gate.rejections] == [
        (wrong, "wrong_sender" if wrong == "plant" else "unknown_agent")
    ]


@pytest.mark.parametrize(
    ("known", "stranger"),
    [
        (sample(Note, agent=4, sender="agent4"), {"agent": 5, "sender": "agent5"}),
        (
            sample(VehicleStatus, uav=4, sender="vehicle4", changes=()),
            {"uav": 5, "sender": "vehicle5"},
        ),
    ],
)
def test_only_processes_of_the_run_are_heard(known: Message, stranger: dict[str, Any]) -> None:
    """Agents and UAVs that it has; of a run that is not known any number."""
    shape = dataclasses.replace(RUN.rules.shape, by_vehicles=True)
    other = changed(known, **stranger)
    for given, message, accepted in ((shape, known, 1), (shape, other, 0), (None, other, 1)):
        gate = Gate("recorder", KEYS, given)
        assert len(list(gate.accept(KEYS.of(message), encode(message)))) == accepted
        assert [entry.reason for entry in gate.rejections] == ["unknown_agent"] * (1 - accepted)


def test_kinds_that_are_not_read_are_handed_over_as_they_came() -> None:
    """A recorder keeps their bytes, also those that other processes would refuse; it reads the others."""
    gate = Gate("recorder", KEYS, RUN.rules.shape, unread=(Plan.kind,))
    unread, read = encode(plan(0, agent=2, uavs=(3,))), runs.end()
    (kept,) = gate.accept(KEYS.of(plan(0)), unread)
    assert isinstance(kept.message, Sample)
    assert (kept.message.data, kept.message.header.sender) == (unread, "agent2")
    (taken,) = gate.accept(KEYS.of(read), encode(read))
    assert taken.message == read
    assert gate.rejections.total == 0


def test_notices_of_invented_keys_are_valid_messages() -> None:
    """Key and text of a refusal are cut to what a message carries."""
    receiver = Receiver("plant")
    long_key = f"{KEYS.prefix}/plan/{'x' * 5_000}"
    for data in (b"", encode(plan(0))):
        assert list(receiver.gate.accept(long_key, data)) == []
    notices = receiver.gate.notices(3)
    assert [decode(encode(notice)) for notice in notices] == notices
    assert {notice.incarnation for notice in notices} == {3}
    assert [len(notice.offender) for notice in notices] == [80, len("agent2")]


def past(text: str = "over") -> MessageError:
    """Return some refusal."""
    return MessageError("past", text)


def test_invented_keys_share_one_count() -> None:
    """Counts of refusals are limited, whatever a sender invents; no refusal is lost."""
    receiver = Receiver("plant")
    invented = 5_000
    for number in range(invented):
        assert list(receiver.gate.accept(f"{KEYS.prefix}/plan/{number}", b"")) == []
    assert list(receiver.gate.accept(f"{KEYS.prefix}/plan/0", b"")) == []
    first, *_, last = entries = list(receiver.gate.rejections)
    assert len(entries) < invented / 2
    assert (first.sender, first.count) == ("plan/0", 2)
    assert (last.sender, last.reason) == ("others", "malformed")
    assert last.count == invented + 1 - len(entries)
    assert receiver.gate.rejections.total == invented + 1

    notices = receiver.gate.notices(0)
    assert sum(notice.count for notice in notices) == invented + 1
    assert (notices[-1].offender, notices[-1].count) == ("others", last.count)
