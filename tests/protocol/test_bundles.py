"""Bundles: opened by the bus, their messages read as if each had come alone, or refused and named."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from protocol.admission.admission import Admission
from protocol.network.bus import Bus, BusEvent, Interrupted
from protocol.network.endpoints import Endpoints
from protocol.wire.codec import VERSION, decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Answer, Bundle, Message, MessageError, Plan, Record, Relay, StepReport, agent_name
from protocol.wire.rejections import Rejections
from tests.support import logs, runs
from tests.support.runs import ALL, INCARNATION, setup
from tests.support.samples import sample
from tests.support.wire import Sample, without_network

KEYS = Keys("paper")
RUN = setup()


class Process:
    """A bus without a network, and what its process reads; all processes are announced."""

    def __init__(self, name: str) -> None:
        self.rejections = Rejections()
        self.admission = Admission(name, KEYS, RUN, self.rejections, refuses_lone_plans=True)
        endpoints = Endpoints(listen=[], connect=[])
        admission = self.admission
        self.bus = Bus(
            name=name, incarnation=0, run="paper", digest="0", endpoints=endpoints, admission=admission, relayed=True
        )
        for other in ("coordinator", "plant", *map(agent_name, ALL)):
            self.admission.announce(other, INCARNATION if other.startswith("agent") else 0)

    def reads(self, *bundles: tuple[str, bytes] | Message) -> Sequence[BusEvent | None]:
        """Return the events that bundles bring, each under its own key unless it has one here."""
        for bundle in bundles:
            key, data = (KEYS.of(bundle), encode(bundle)) if isinstance(bundle, Message) else bundle
            self.bus._put(Sample(key, data))  # type: ignore[arg-type]
        self.bus.interrupt("over")
        found = []
        while not isinstance(event := self.bus.next(None), Interrupted):
            found.append(event)
        return found

    def refused(self) -> list[tuple[str, str, int]]:
        """Return sender, reason and count of the refusals."""
        return [(entry.sender, entry.reason, entry.count) for entry in self.rejections]


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let buses open sessions without a network."""
    without_network(monkeypatch)


def plan(agent: int, k: int, *, shared: bool = True) -> Plan:
    """Return an agent's plan of tick k."""
    return runs.plan(RUN, agent, k, shared=shared)


def report(agent: int, k: int) -> StepReport:
    """Return an agent's report of tick k."""
    return replace(logs.report(RUN, agent, k), incarnation=INCARNATION, sequence=2 * k + 1)


def packed(messages: Sequence[Message]) -> dict[str, list[str] | list[bytes]]:
    """Return messages as fields of a bundle."""
    return {"keys": [KEYS.end(KEYS.of(m)) for m in messages], "parts": [encode(m) for m in messages]}


def answer(agent: int, *messages: Message, k: int = 0) -> Answer:
    """Return an agent's answer of tick k."""
    return Answer(
        sender=agent_name(agent),
        incarnation=INCARNATION,
        sequence=k,
        tick=k,
        agent=agent,
        **packed(messages),  # type: ignore[arg-type]
    )


def relay(*messages: Message, k: int = 0) -> Relay:
    """Return a relay of the coordinator."""
    return Relay(sender="coordinator", incarnation=0, sequence=k, tick=k, **packed(messages))  # type: ignore[arg-type]


def record(*messages: Message, k: int = 0) -> Record:
    """Return a record of the plant."""
    return Record(sender="plant", incarnation=0, sequence=k, tick=k, **packed(messages))  # type: ignore[arg-type]


def same(events: Sequence[object], messages: Sequence[Message]) -> bool:
    """Return whether events are messages, bit for bit."""
    found = [encode(event) for event in events if isinstance(event, Message)]
    return found == [encode(message) for message in messages] and len(found) == len(events)


def test_keys_that_a_bundle_may_carry() -> None:
    """An answer carries plan and report of its agent, a relay answers and a tick, a record states and measurements."""
    ends = [
        *(
            "plan/2",
            "unshared/2",
            "report/2",
            "plan/1",
            "plan/22",
            "plan",
            "plan/2/2",
            "planet/2",
            "tick",
            "measurement/2",
        ),
        *("plant_state", "roster", "control", "rejected/agent2", "answer/2", "relay", "record", "", "/", "*", "plan/*"),
    ]
    answers = {"plan/2", "unshared/2", "report/2"}
    assert {end for end in ends if answer(2).may_carry(end)} == answers
    assert {end for end in ends if record().may_carry(end)} == {"plant_state", "measurement/2"}
    relayed = {end for end in ends if relay().may_carry(end)}
    assert relayed == {*answers, "tick", "plan/1", "plan/22", "plan", "plan/2/2", "plan/*"}  # not subscribed to
    assert not any(bundle.may_carry(end) for bundle in (answer(2), relay(), record()) for end in ("answer/2", "relay"))


def test_one_key_for_each_message() -> None:
    """A bundle with more keys than messages, or fewer, is refused with both numbers."""
    for keys in (("plan/2",), ("plan/2",) * 3):
        with pytest.raises(MessageError, match=f"parts: expected one for each of {len(keys)} keys, got 2"):
            replace(answer(2, plan(2, 0), report(2, 0)), keys=keys)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("plant", ["plan", "plan", "plan", "tick"]),
        ("agent1", ["plan"]),
        ("agent2", ["plan"]),
        ("agent4", ["plan", "plan"]),
        ("recorder", ["plan", "plan", "plan", "report", "report", "report", "tick"]),
    ],
)
def test_messages_for_others_are_not_read(name: str, expected: list[str]) -> None:
    """A process reads the messages of a relay that it subscribes to, in order, never its own; nothing is refused."""
    plans = [plan(1, 0), plan(2, 0), plan(3, 0, shared=False)]
    process = Process(name)
    events = process.reads(relay(*plans, *[report(a, 0) for a in (1, 2, 3)], runs.tick(1), k=1))
    assert [event.kind for event in events if isinstance(event, Message)] == expected
    assert not any(isinstance(event, Bundle) or getattr(event, "sender", "") == name for event in events)
    assert process.refused() == []


def test_messages_keep_their_bits() -> None:
    """Messages of answers and records equal the ones that were put in, bit for bit."""
    made, told = plan(2, 0), report(2, 0)
    assert same(Process("coordinator").reads(answer(2, made, told)), [made])
    states = [runs.plant_state(RUN, 0), *[runs.measurement(RUN, agent, 1) for agent in ALL]]
    assert same(Process("recorder").reads(record(*states)), states)
    assert same(Process("coordinator").reads(record(*states)), states[:1])


def test_the_bundle_of_an_event() -> None:
    """While a message of a bundle is handled the bus names the bundle; for one that came alone it names none."""
    process, sent = Process("coordinator"), answer(2, plan(2, 0), report(2, 0))
    process.bus._put(Sample(KEYS.of(sent), encode(sent)))  # type: ignore[arg-type]
    alone = replace(plan(3, 0), negotiation=1)
    process.bus._put(Sample(KEYS.of(alone), encode(alone)))  # type: ignore[arg-type]
    assert isinstance(process.bus.next(0.0), Plan)
    assert process.bus.bundle == sent
    assert isinstance(process.bus.next(0.0), Plan)
    assert process.bus.bundle is None


def test_foreign_keys_are_refused_and_named() -> None:
    """A message under a key that its bundle may not carry is refused and named; the others of the bundle are read."""
    process = Process("coordinator")
    assert same(process.reads(answer(2, plan(3, 0), plan(2, 0))), [plan(2, 0)])
    assert process.refused() == [("agent2", "wrong_sender", 1)]
    assert next(iter(process.rejections)).example == "answer of agent2 with a message under the key plan/3"
    recorder = Process("recorder")
    assert same(recorder.reads(relay(runs.end(), runs.roster(), runs.tick(0))), [runs.tick(0)])
    assert same(recorder.reads(record(plan(2, 0), runs.plant_state(RUN, 0))), [runs.plant_state(RUN, 0)])
    assert recorder.refused() == [("coordinator", "wrong_sender", 2), ("plant", "wrong_sender", 1)]


def test_bad_messages_do_not_stop_the_good_ones() -> None:
    """Garbage, another's plan under an agent's key, and a bundle in a bundle are refused; the rest is read."""
    process = Process("recorder")
    good = relay(plan(2, 0))
    bad = [b"", b"hello", encode(plan(2, 0))[:-1], encode(plan(3, 0)), encode(answer(2, plan(2, 0)))]
    mixed = replace(good, keys=("plan/2",) * 6, parts=(*bad, *good.parts))
    assert same(process.reads(mixed), [plan(2, 0)])
    assert sorted(process.refused()) == [
        ("agent2", "wrong_sender", 1),
        ("agent3", "wrong_sender", 1),
        ("plan/2", "malformed", 2),
        ("plan/2", "wrong_version", 1),
    ]


@pytest.mark.parametrize("name", ["coordinator", "agent1"])
def test_replayed_and_renumbered_bundles(name: str) -> None:
    """Each message of a repeated bundle is refused, whatever number the bundle has; the next true ones are read."""
    process = Process(name)

    def sent(k: int) -> Bundle:
        return answer(2, plan(2, k), k=k) if name == "coordinator" else relay(plan(2, k), k=k)

    assert same(process.reads(sent(0)), [plan(2, 0)])
    forged = [sent(0), replace(sent(0), sequence=10**6), replace(sent(0), sequence=1, tick=1), replace(sent(0), tick=9)]
    assert process.reads(*forged) == []
    renumbered = 0 if name == "agent1" else 1  # an answer is refused whole, as its ticks grow
    expected = [("agent2", "replayed", 4 - renumbered), ("agent2", "past", renumbered)]
    assert process.refused() == [entry for entry in expected if entry[2]]
    assert same(process.reads(sent(1), sent(2)), [plan(2, 1), plan(2, 2)])


def test_a_flood_of_answers_is_refused_unread() -> None:
    """Copies of an answer whose plan was accepted are refused on arrival, under any number; the next answer is not."""
    process, sent = Process("coordinator"), [answer(2, plan(2, k), report(2, k), k=k) for k in range(3)]
    assert same(process.reads(*sent[:2]), [plan(2, 0), plan(2, 1)])
    over = [sent[0], sent[1], replace(sent[1], sequence=10**6)]
    assert all(process.admission.has_passed(KEYS.of(bundle), encode(bundle)) for bundle in over)
    assert not process.admission.has_passed(KEYS.of(sent[2]), encode(sent[2]))


@pytest.mark.parametrize("ahead", [1, 5])
def test_a_true_plan_in_a_forged_bundle(ahead: int) -> None:
    """A bundle of a later tick or number around a true plan does not block the bundles of later ticks."""
    for name, bundle in (("coordinator", answer(2, plan(2, 0), k=0)), ("agent1", relay(plan(2, 0), k=0))):
        process = Process(name)
        assert same(process.reads(replace(bundle, tick=ahead, sequence=10**6)), [plan(2, 0)])
        for k in range(1, 4):
            later = answer(2, plan(2, k), k=k) if name == "coordinator" else relay(plan(2, k), k=k)
            assert same(process.reads(later), [plan(2, k)])
        assert process.refused() == []


@pytest.mark.parametrize("parts", [(), (b"?",)], ids=["empty", "garbage"])
def test_forged_bundles_do_not_block_true_ones(parts: tuple[bytes, ...]) -> None:
    """A bundle without a true message takes neither number nor tick of the true one, nor moves the present tick."""
    process = Process("coordinator")
    for k in range(3):
        forged = replace(answer(2, k=k), keys=("plan/2",) * len(parts), parts=parts)
        assert process.reads(forged, replace(forged, tick=k + 1), replace(forged, tick=k + 16, sequence=10**6)) == []
        assert same(process.reads(answer(2, plan(2, k), report(2, k), k=k)), [plan(2, k)])
        assert process.admission.tick == k


def test_bundles_are_checked_as_messages() -> None:
    """A bundle that is garbled, oversized, of the far future, under another's key or from another sender is refused."""
    process, good = Process("coordinator"), answer(2, plan(2, 5), k=5)
    key, data = KEYS.of(good), encode(good)
    assert same(process.reads(good), [plan(2, 5)])
    forged: list[tuple[str, bytes]] = [
        (key, data[:-1]),
        (key, bytes([VERSION]) + b"\x91\xc0"),
        (key, data + bytes(process.admission.max_bytes)),
        (key, encode(replace(good, tick=500))),
        (f"{KEYS.prefix}/answer/3", data),
        (key, encode(replace(good, sender="agent3"))),
        (key, encode(replace(good, agent=3))),
        (key, encode(replace(good, incarnation=0))),
        (f"{KEYS.prefix}/record", encode(replace(record(), sender="agent3"))),
    ]
    assert process.reads(*forged) == []
    assert sorted(process.refused()) == [
        ("agent2", "future", 1),
        ("agent2", "wrong_incarnation", 1),
        ("agent2", "wrong_sender", 2),
        ("agent3", "wrong_sender", 2),
        ("answer/2", "malformed", 2),
        ("answer/2", "oversized", 1),
    ]


def test_a_relay_comes_from_the_coordinator() -> None:
    """A relay in the name of an agent or the plant is refused whole: none of its messages is read."""
    process = Process("agent1")
    for name in ("agent2", "plant"):
        assert process.reads(replace(relay(plan(2, 0)), sender=name)) == []
    assert process.refused() == [("agent2", "wrong_sender", 1), ("plant", "wrong_sender", 1)]


def test_a_bundle_ahead_of_its_token_waits() -> None:
    """A bundle of an incarnation that is not announced yet is opened once it is."""
    process = Process("coordinator")
    newer = replace(plan(2, 0), incarnation=INCARNATION + 1)
    early = replace(answer(2, newer), incarnation=INCARNATION + 1)
    assert process.reads(early) == []
    assert process.admission.kept == 1
    process.admission.announce("agent2", INCARNATION + 1)
    assert same(process.reads(), [newer])


def test_the_version_of_every_message_in_a_bundle() -> None:
    """A message of another protocol version in a bundle is refused, and its version named."""
    process, good = Process("coordinator"), answer(2, plan(2, 0))
    other = bytes([VERSION - 1]) + good.parts[0][1:]
    assert process.reads(replace(good, parts=(other,))) == []
    assert process.refused() == [("plan/2", "wrong_version", 1)]
    assert decode(good.parts[0]).kind == "plan"


def test_every_kind_of_bundle_has_a_sample() -> None:
    """The samples that other tests use are bundles."""
    assert all(isinstance(sample(kind), Bundle) for kind in (Answer, Relay, Record))


def test_a_plan_alone_is_refused() -> None:
    """A plan that comes alone would be counted and never relayed: refused; proposals of a negotiation come alone."""
    process = Process("coordinator")
    proposal = replace(plan(2, 0), negotiation=1)
    assert same(process.reads(plan(3, 0), proposal, answer(3, plan(3, 0))), [proposal, plan(3, 0)])
    assert process.refused() == [("agent3", "wrong_sender", 1)]


def test_the_last_plan_of_an_earlier_start() -> None:
    """A relay brings the last plan of an agent whose next start is announced already; in an answer it is late."""
    process = Process("plant")
    process.admission.announce("agent2", INCARNATION + 1)
    assert same(process.reads(relay(plan(2, 0), runs.tick(1), k=1)), [plan(2, 0), runs.tick(1)])
    coordinator = Process("coordinator")
    coordinator.admission.announce("agent2", INCARNATION + 1)
    assert coordinator.reads(answer(2, plan(2, 0))) == []
    assert coordinator.refused() == [("agent2", "wrong_incarnation", 1)]


def test_answers_of_all_agents_fit_into_a_relay() -> None:
    """An answer has at most a plan and a report, so that padded answers cannot make a relay impossible."""
    padded = ("plan/2", *["report/2"] * 500)
    with pytest.raises(MessageError, match="expected at most a plan and a report, got 501 keys"):
        replace(answer(2), keys=padded, parts=(b"",) * len(padded))
