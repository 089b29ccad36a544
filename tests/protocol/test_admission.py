"""Admission: accepted messages by order and incarnation, and refused or kept ones."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from protocol.admission.admission import Admission
from protocol.wire.codec import MAX_BYTES, VERSION, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import (
    MAX_TEXT,
    LinkChange,
    Message,
    MessageError,
    Plan,
    Record,
    Rejected,
    Relay,
    StepReport,
    agent_name,
)
from protocol.wire.rejections import Rejections
from tests.support import runs
from tests.support.runs import ALL, INCARNATION, setup
from tests.support.samples import sample

KEYS = Keys("paper")
TEAM = {"coordinator": 0, "plant": 0, **{agent_name(agent): INCARNATION for agent in ALL}}
AHEAD = 16  # ticks of the future that a slow connection may be behind another


class Receiver:
    """The admission of a process with its counts; all processes are announced."""

    def __init__(self, name: str = "recorder", *settings: str) -> None:
        self.rejections = Rejections()
        self.admission = Admission(name, KEYS, setup(*settings), self.rejections)
        for other, incarnation in TEAM.items():
            self.admission.announce(other, incarnation)

    def accepts(self, *messages: Message) -> list[bool]:
        """Whether messages are accepted, each under its own key."""
        return [self.admission.read(KEYS.of(message), encode(message)) is not None for message in messages]

    def refused(self) -> list[tuple[str, str, int]]:
        """Sender, reason, count."""
        return [(entry.sender, entry.reason, entry.count) for entry in self.rejections]


def plan(k: int, agent: int = 2, **changes: Any) -> Plan:
    """An agent's plan of tick k, number 2 k of its sender."""
    return replace(runs.plan(setup(), agent, k), **changes)


def report(k: int) -> Message:
    """An agent's report of tick k."""
    return sample(StepReport, sender="agent2", incarnation=INCARNATION, sequence=2 * k + 1, tick=k)


def each_tick(k: int) -> list[Message]:
    """One message of each kind that is sent once a tick."""
    return [runs.tick(k), runs.measurement(setup(), 2, k), plan(k), report(k), runs.plant_state(setup(), k)]


def test_a_run_passes() -> None:
    """All messages of a run are accepted, and none is counted."""
    receiver = Receiver()
    sent = [runs.roster(), *[message for k in range(4) for message in each_tick(k)], runs.end(3)]
    assert receiver.accepts(*sent) == [True] * len(sent)
    assert (receiver.refused(), receiver.admission.tick) == ([], 3)


@pytest.mark.parametrize("number", range(5))
def test_repeated_messages_are_refused(number: int) -> None:
    """A repeated or older message is refused as replayed, whatever arrived meanwhile under other keys."""
    receiver = Receiver()
    first, second = each_tick(0)[number], each_tick(1)[number]
    others = [message for message in each_tick(1) if message.kind != first.kind]
    assert all(receiver.accepts(first, *others))
    assert receiver.accepts(first) == [False]
    assert receiver.accepts(second, first, second) == [True, False, False]
    assert receiver.refused() == [(first.sender, "replayed", 3)]


@pytest.mark.parametrize("number", range(5))
def test_one_message_of_a_kind_per_tick(number: int) -> None:
    """A new number does not make an old tick new."""
    receiver = Receiver()
    assert all(receiver.accepts(*each_tick(5)))
    message = each_tick(5)[number]
    assert receiver.accepts(replace(message, sequence=99)) == [False]
    assert receiver.accepts(replace(message, sequence=100, tick=4)) == [False]
    assert receiver.refused() == [(message.sender, "past", 2)]


@pytest.mark.parametrize("number", range(5))
def test_forged_high_numbers_do_not_block_true_messages(number: int) -> None:
    """Copies of a message under a higher sequence number do not block the sender's next messages.

    Otherwise all messages with true numbers would be of the past, and the run would depend on the copies.
    """
    receiver = Receiver()
    for k in range(4):
        message = each_tick(k)[number]
        copied = replace(message, sequence=10**6 + k)
        assert receiver.accepts(*((copied, message) if k % 2 else (message, copied, copied))) == (
            [True, False] if k % 2 else [True, False, False]
        )
    assert receiver.admission.tick == 3


@pytest.mark.parametrize("number", range(5))
def test_a_sequence_number_occurs_once(number: int) -> None:
    """An old message whose tick was changed is recognised by its sequence number."""
    receiver = Receiver()
    for k in range(3):
        assert receiver.accepts(each_tick(k)[number]) == [True]
    old = each_tick(1)[number]
    later: dict[str, Any] = {"tick": 3, "start_tick": 3} if isinstance(old, Plan) else {"tick": 3}
    assert receiver.accepts(replace(old, **later), each_tick(3)[number]) == [False, True]
    assert receiver.refused() == [(old.sender, "replayed", 1)]


def test_link_changes_do_not_block_rosters() -> None:
    """Rosters and link changes share a key, but each kind has its own order."""
    receiver = Receiver()
    change = sample(LinkChange, incarnation=0, sequence=10**6, tick=0)
    first, second = (replace(runs.roster(version=version), sequence=version) for version in (1, 2))
    assert receiver.accepts(first, change, second, replace(first, sequence=10**7)) == [True, True, True, False]


def test_rosters_grow() -> None:
    """A roster's version grows; several may be of one tick."""
    receiver = Receiver()
    rosters = [replace(runs.roster(version=version), sequence=number) for number, version in enumerate((1, 2, 2, 1, 3))]
    assert receiver.accepts(*rosters) == [True, True, False, False, True]


def test_negotiation_counts_down() -> None:
    """Plans within a tick count down to 0, which is the tick's answer."""
    receiver = Receiver()
    steps = [(3, 2), (3, 1), (3, 1), (3, 2), (3, 0), (3, 1), (4, 2)]
    plans = [plan(k, sequence=number, negotiation=left) for number, (k, left) in enumerate(steps)]
    assert receiver.accepts(*plans) == [True, True, False, False, True, False, True]


def test_order_between_keys_does_not_matter() -> None:
    """A sender's messages are ordered under one key only: Zenoh keeps no other order."""
    receiver = Receiver()
    assert receiver.accepts(report(2), plan(0), report(3), plan(1), plan(2)) == [True] * 5


def test_link_changes_may_be_repeated() -> None:
    """A link change repeated for a joining agent has a new number and an old tick."""
    receiver = Receiver()
    change = sample(LinkChange, incarnation=0, sequence=3, tick=2)
    assert all(receiver.accepts(*each_tick(9)))
    assert receiver.accepts(change, replace(change, sequence=8), change) == [True, True, False]


def test_messages_that_the_node_refuses_do_not_count() -> None:
    """A forged message that the node refuses does not block the true one with its number and tick."""
    receiver = Receiver()
    assert receiver.accepts(plan(0), plan(1, sequence=10**6)) == [True, True]
    receiver.rejections.add("agent2", MessageError("outside_limits", "as the node found"))
    assert receiver.accepts(plan(1), plan(1)) == [True, False]
    assert receiver.refused() == [("agent2", "outside_limits", 1), ("agent2", "replayed", 1)]


@pytest.mark.parametrize("ahead", [0, 1, AHEAD, AHEAD + 1, 1000, 2**40])
def test_the_future(ahead: int) -> None:
    """A message may be as far ahead of the others as a connection may be slow, and no further."""
    receiver = Receiver()
    assert all(receiver.accepts(*each_tick(7)))
    end = runs.end(7 + ahead)
    assert receiver.accepts(end) == [ahead <= AHEAD]
    assert receiver.refused() == ([] if ahead <= AHEAD else [("coordinator", "future", 1)])


def test_the_first_message_may_be_of_any_tick() -> None:
    """The first message may be of any tick; so may the first one after a process was unreachable."""
    receiver = Receiver()
    assert receiver.accepts(runs.tick(400), runs.tick(500)) == [True, False]
    receiver.admission.announce("coordinator", 0)
    assert receiver.accepts(runs.tick(500), runs.tick(700)) == [True, False]


@pytest.mark.parametrize("repeats_changes", [False, True], ids=["roster", "link-changes-first"])
def test_a_new_incarnation_accepts_the_present_tick(repeats_changes: bool) -> None:
    """A process that was frozen for many ticks is removed from the roster, and then accepts the present tick.

    Its node refused the messages in between as future ones, so admission does not know the present tick either.
    """
    receiver = Receiver("agent4")
    assert receiver.accepts(*(plan(k) for k in range(44))) == [True] * 44
    for k in range(44, 44 + AHEAD):
        assert receiver.accepts(plan(k)) == [True]
        receiver.rejections.add("agent2", MessageError("future", "as the node found"))
    assert receiver.accepts(plan(67)) == [False]
    assert receiver.accepts(replace(runs.roster(k=43, version=2), sequence=80)) == [True]
    receiver.admission.renew(INCARNATION + 1)
    change = sample(LinkChange, incarnation=0, sequence=90, tick=18)
    assert not repeats_changes or receiver.accepts(change) == [True]
    joined = replace(
        runs.roster({**dict.fromkeys((1, 2, 3), INCARNATION), 4: INCARNATION + 1}, k=67, version=3), sequence=100
    )
    assert receiver.accepts(joined, plan(67), plan(67 + AHEAD + 1)) == [True, True, False]


def test_a_returning_process_reads_what_it_missed_in_any_order() -> None:
    """The present measurement may come before the messages of one connection that the process missed.

    The plant's connection and the coordinator's are read each by itself; the plant does not repeat a measurement.
    """
    receiver = Receiver("agent2")
    assert receiver.accepts(*(runs.tick(k) for k in range(44))) == [True] * 44
    others = {1: INCARNATION, 3: INCARNATION, 4: INCARNATION}
    assert receiver.accepts(replace(runs.roster(others, k=44, version=2), sequence=80)) == [True]
    receiver.admission.renew(INCARNATION + 1)
    assert receiver.accepts(runs.tick(44), runs.tick(45)) == [True, True]
    assert receiver.accepts(runs.measurement(setup(), 2, 45 + AHEAD + 1)) == [True]
    assert receiver.accepts(*(runs.tick(k) for k in range(46, 62))) == [True] * 16
    team = {1: INCARNATION, 2: INCARNATION + 1, 3: INCARNATION, 4: INCARNATION}
    joined = replace(runs.roster(team, k=62, version=3), sequence=100)
    assert receiver.accepts(joined, runs.tick(62), runs.tick(62 + AHEAD + 1)) == [True, True, False]


def test_messages_of_an_older_incarnation_are_refused() -> None:
    """Once a newer incarnation is announced, all messages of an earlier one are refused."""
    receiver = Receiver()
    assert receiver.accepts(plan(0), report(0)) == [True, True]
    receiver.admission.announce("agent2", INCARNATION + 1)
    assert receiver.accepts(plan(1), report(1)) == [False, False]
    newer = [replace(message, incarnation=INCARNATION + 1, sequence=0) for message in (plan(0), report(0))]
    assert receiver.accepts(*newer) == [True, True]
    receiver.admission.announce("agent2", INCARNATION)  # a token that comes late
    assert receiver.accepts(plan(1)) == [False]
    assert receiver.refused() == [("agent2", "wrong_incarnation", 3)]


def test_messages_ahead_of_their_token_wait() -> None:
    """A message ahead of its sender's token waits for it; if it never comes the message is counted in the end."""
    receiver = Receiver()
    early = [plan(k, incarnation=INCARNATION + 1) for k in (3, 4)]
    late = plan(5, agent=3, incarnation=INCARNATION + 7)
    assert receiver.accepts(early[0], late, early[1], plan(0)) == [False, False, False, True]
    assert (receiver.admission.kept, receiver.admission.released(), receiver.refused()) == (3, None, [])
    receiver.admission.announce("agent2", INCARNATION + 1)
    found = [receiver.admission.released(), receiver.admission.released(), receiver.admission.released()]
    assert [None if message is None else message.tick for message in found] == [3, 4, None]
    assert receiver.accepts(early[1]) == [False]
    receiver.admission.close()
    assert receiver.refused() == [("agent2", "replayed", 1), ("agent3", "wrong_incarnation", 1)]


def test_a_waiting_message_may_become_outdated() -> None:
    """A waiting message is checked like any other when its token is here: repeated and outdated ones are refused."""
    receiver = Receiver()
    waiting = plan(3, incarnation=INCARNATION + 1)
    assert receiver.accepts(waiting, waiting) == [False, False]
    receiver.admission.announce("agent2", INCARNATION + 1)
    assert [receiver.admission.released(), receiver.admission.released()][1] is None
    assert receiver.accepts(replace(waiting, incarnation=INCARNATION + 2)) == [False]
    receiver.admission.announce("agent2", INCARNATION + 3)
    assert receiver.admission.released() is None
    assert receiver.refused() == [("agent2", "replayed", 1), ("agent2", "wrong_incarnation", 1)]


def test_waiting_messages_are_bounded() -> None:
    """Few messages of unannounced incarnations are kept; the oldest are refused."""
    receiver = Receiver()
    for number in range(3000):
        assert receiver.accepts(plan(1, sequence=number, incarnation=2**40)) == [False]
    assert receiver.admission.kept == 256
    assert receiver.refused() == [("agent2", "wrong_incarnation", 3000 - 256)]
    receiver.admission.close()
    assert receiver.refused() == [("agent2", "wrong_incarnation", 3000)]


def test_senders() -> None:
    """Messages of unknown processes, the process itself, or under another's key are refused and counted by sender."""
    receiver = Receiver("agent1")
    strangers = [replace(plan(0), agent=9, sender="agent9"), plan(0, agent=1), plan(0, sender="agent3")]
    assert receiver.accepts(*strangers) == [False] * 3
    assert receiver.admission.read(f"{KEYS.prefix}/plan/3", encode(plan(0))) is None
    assert receiver.refused() == [
        ("agent9", "unknown_agent", 1),
        ("agent1", "wrong_sender", 1),
        ("agent3", "wrong_sender", 1),
        ("agent2", "wrong_sender", 1),
    ]


@pytest.mark.parametrize(
    ("data", "sender", "reason"),
    [
        (b"", "plan/2", "malformed"),
        (b"hello", "plan/2", "wrong_version"),
        (bytes([VERSION]) + b"\x91\xc0", "plan/2", "malformed"),
        (encode(plan(0))[:-1], "plan/2", "malformed"),
        (bytes([VERSION]) + b"\x91\xa5truce", "plan/2", "unknown_kind"),
        (encode(plan(0)) + bytes(MAX_BYTES), "plan/2", "oversized"),
        (encode(plan(0)).replace(b"agent2", b"agent?"), "plan/2", "out_of_range"),
        (encode(plan(0)).replace(b"solved", b"sold\xc0\xc0"), "plan/2", "malformed"),
        (encode(plan(0)).replace(b"solved", b"salved"), "agent2", "out_of_range"),
    ],
)
def test_the_sender_a_refusal_is_counted_under(data: bytes, sender: str, reason: str) -> None:
    """A refusal is counted under the sender's name if it can be read, otherwise under the key."""
    receiver = Receiver()
    assert receiver.admission.read(f"{KEYS.prefix}/plan/2", data) is None
    assert receiver.refused() == [(sender, reason, 1)]


def test_size() -> None:
    """The largest messages of a run pass; messages much larger are refused unread."""
    run = setup("clock.exchange=direct")
    receiver = Receiver("recorder", "clock.exchange=direct")
    team = tuple(range(1, run.system.N + 1))
    inputs = np.full((run.settings.horizon, 4 * len(team)), 0.1)
    largest = plan(0, uavs=team, uav_states=np.zeros((len(team), 12)), inputs=inputs, corrections=inputs)
    wordy = "\N{SNOWMAN}" * MAX_TEXT
    notice = Rejected(
        sender="agent2",
        incarnation=INCARNATION,
        sequence=0,
        tick=0,
        offender=wordy,
        reason="past",
        count=1,
        example=wordy,
    )
    assert all(len(encode(message)) <= receiver.admission.max_bytes for message in (largest, notice))
    assert receiver.accepts(largest, notice) == [True, True]
    assert receiver.admission.max_bytes < 2 * (len(encode(largest)) + len(encode(notice)))
    assert receiver.admission.read(KEYS.of(largest), bytes([VERSION]) + b"\x90" * receiver.admission.max_bytes) is None
    assert receiver.refused() == [("plan/2", "oversized", 1)]
    text = str(receiver.admission.oversized(10**9))
    assert text == f"message of 1000000000 bytes, at most {receiver.admission.max_bytes} in this run"


@pytest.mark.parametrize("owned", ["[[1],[2],[3],[4]]", "[[1,2],[3,4]]", "[[1,2,3,4]]"])
def test_size_of_bundles(owned: str) -> None:
    """The largest bundles of a run pass; the limit is at most that of as many single messages as a relay carries."""
    own = f"agents.owned={owned}"
    run = setup(own, "clock.exchange=relayed")
    plans = [runs.plan(run, agent, 0) for agent in run.agents]
    answers: list[Message] = [replace(made, corrections=made.inputs) for made in plans]
    answers += [sample(StepReport, sender=agent_name(a), agent=a, solver="\N{SNOWMAN}" * MAX_TEXT) for a in run.agents]
    states: list[Message] = [runs.plant_state(run, 0, "\N{SNOWMAN}" * MAX_TEXT)]
    states += [runs.measurement(run, agent, 1) for agent in run.agents]
    receiver = Receiver("recorder", own, "clock.exchange=relayed")
    for kind, parts in ((Relay, [*answers, runs.tick(1)]), (Record, states)):
        keys, data = [KEYS.end(KEYS.of(part)) for part in parts], [encode(part) for part in parts]
        assert receiver.accepts(sample(kind, incarnation=0, keys=keys, parts=data)) == [True]
    single = Receiver("recorder", own, "clock.exchange=direct").admission.max_bytes
    assert receiver.admission.max_bytes <= (2 * len(run.agents) + 1) * single


def test_any_order_of_two_streams() -> None:
    """In any interleaving of the messages of two keys each stream passes whole and once."""
    rng = np.random.default_rng(20240611)
    for _ in range(50):
        streams = [[plan(k) for k in range(12)], [plan(k, agent=3) for k in range(12)]]
        receiver, passed = Receiver(), []
        while any(streams):
            stream = streams[int(rng.integers(2))]
            if stream:
                message = stream.pop(0)
                again = [message] * int(rng.integers(1, 3))
                passed += [message for message, ok in zip(again, receiver.accepts(*again), strict=True) if ok]
        for agent in (2, 3):
            ticks = [message.tick for message in passed if message.agent == agent]
            assert all(after == before + 1 for before, after in pairwise(ticks))
        assert len(passed) == 24


def test_a_proposal_may_overtake_a_relayed_plan() -> None:
    """The proposal of the next tick comes alone, and may come before the plan of this tick, which is relayed."""
    receiver = Receiver("agent1")
    proposals = [plan(k, sequence=10 * k, negotiation=1) for k in range(3)]
    plans = [plan(k, sequence=10 * k + 1) for k in range(3)]
    sent = [proposals[0], proposals[1], plans[0], proposals[2], plans[1], plans[2]]
    assert receiver.accepts(*sent) == [True] * 6
    assert receiver.accepts(*sent) == [False] * 6
    assert receiver.accepts(replace(proposals[2], negotiation=0, tick=3, start_tick=3)) == [False]  # the same number
    assert receiver.refused() == [("agent2", "replayed", 7)]
