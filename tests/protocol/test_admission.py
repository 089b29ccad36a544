"""The gate: what is let in, in which order, from which start of a sender, and what becomes of the rest."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from protocol.admission.admission import Admission
from protocol.wire.codec import MAX_BYTES, VERSION, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import MAX_TEXT, LinkChange, Message, MessageError, Plan, Rejected, StepReport, agent_name
from protocol.wire.rejections import Rejections
from tests.support import runs
from tests.support.runs import EVERYBODY, INCARNATION, setup
from tests.support.samples import sample

KEYS = Keys("paper")
TEAM = {"coordinator": 0, "plant": 0, **{agent_name(agent): INCARNATION for agent in EVERYBODY}}
AHEAD = 16  # ticks of the future that a slow connection may be behind another


class Door:
    """A gate with its counts; everybody is announced."""

    def __init__(self, name: str = "recorder") -> None:
        self.rejections = Rejections()
        self.admission = Admission(name, KEYS, setup(), self.rejections)
        for other, incarnation in TEAM.items():
            self.admission.announce(other, incarnation)

    def lets_in(self, *messages: Message) -> list[bool]:
        """Whether messages are let in, each under its own key."""
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
    """One message of each kind that is said once a tick."""
    return [runs.tick(k), runs.measurement(setup(), 2, k), plan(k), report(k), runs.plant_state(setup(), k)]


def test_a_flight_passes() -> None:
    """Whatever is said in a flight is let in, by each process that hears it, and nothing is counted."""
    door = Door()
    said = [runs.roster(), *[message for k in range(4) for message in each_tick(k)], runs.end(3)]
    assert door.lets_in(*said) == [True] * len(said)
    assert (door.refused(), door.admission.tick) == ([], 3)


@pytest.mark.parametrize("number", range(5))
def test_nothing_is_heard_twice(number: int) -> None:
    """The same message again, and an older one, are replayed whatever has come meanwhile under other keys."""
    door = Door()
    first, second = each_tick(0)[number], each_tick(1)[number]
    others = [message for message in each_tick(1) if message.kind != first.kind]
    assert all(door.lets_in(first, *others))
    assert door.lets_in(first) == [False]
    assert door.lets_in(second, first, second) == [True, False, False]
    assert door.refused() == [(first.sender, "replayed", 3)]


@pytest.mark.parametrize("number", range(5))
def test_a_tick_is_said_once(number: int) -> None:
    """A new number does not make an old tick new."""
    door = Door()
    assert all(door.lets_in(*each_tick(5)))
    message = each_tick(5)[number]
    assert door.lets_in(replace(message, sequence=99)) == [False]
    assert door.lets_in(replace(message, sequence=100, tick=4)) == [False]
    assert door.refused() == [(message.sender, "past", 2)]


@pytest.mark.parametrize("number", range(5))
def test_high_numbers_shut_nobody_out(number: int) -> None:
    """Who repeats somebody's message under a number of his own does not keep what that one says next from being heard.

    Otherwise the run would hang on what he repeats: whatever came with a true number would be of the past.
    """
    door = Door()
    for k in range(4):
        message = each_tick(k)[number]
        copied = replace(message, sequence=10**6 + k)
        assert door.lets_in(*((copied, message) if k % 2 else (message, copied, copied))) == (
            [True, False] if k % 2 else [True, False, False]
        )
    assert door.admission.tick == 3


@pytest.mark.parametrize("number", range(5))
def test_a_number_is_there_once(number: int) -> None:
    """An old message whose tick alone has become another is told by its number."""
    door = Door()
    for k in range(3):
        assert door.lets_in(each_tick(k)[number]) == [True]
    old = each_tick(1)[number]
    later: dict[str, Any] = {"tick": 3, "start_tick": 3} if isinstance(old, Plan) else {"tick": 3}
    assert door.lets_in(replace(old, **later), each_tick(3)[number]) == [False, True]
    assert door.refused() == [(old.sender, "replayed", 1)]


def test_a_change_of_links_under_a_high_number_shuts_no_roster_out() -> None:
    """Rosters and changes of links share a key, not what makes them new."""
    door = Door()
    change = sample(LinkChange, incarnation=0, sequence=10**6, tick=0)
    first, second = (replace(runs.roster(version=version), sequence=version) for version in (1, 2))
    assert door.lets_in(first, change, second, replace(first, sequence=10**7)) == [True, True, True, False]


def test_rosters_grow() -> None:
    """A roster's version grows; several may be of one tick."""
    door = Door()
    rosters = [replace(runs.roster(version=version), sequence=number) for number, version in enumerate((1, 2, 2, 1, 3))]
    assert door.lets_in(*rosters) == [True, True, False, False, True]


def test_negotiation_counts_down() -> None:
    """Plans within a tick count down to 0, which is the tick's answer."""
    door = Door()
    steps = [(3, 2), (3, 1), (3, 1), (3, 2), (3, 0), (3, 1), (4, 2)]
    said = [plan(k, sequence=number, negotiation=left) for number, (k, left) in enumerate(steps)]
    assert door.lets_in(*said) == [True, True, False, False, True, False, True]


def test_order_between_keys_does_not_matter() -> None:
    """Of one sender only the order under one key counts: Zenoh keeps no other."""
    door = Door()
    assert door.lets_in(report(2), plan(0), report(3), plan(1), plan(2)) == [True] * 5


def test_changes_of_links_may_be_told_again() -> None:
    """What is told again for a newcomer has a new number and an old tick."""
    door = Door()
    change = sample(LinkChange, incarnation=0, sequence=3, tick=2)
    assert all(door.lets_in(*each_tick(9)))
    assert door.lets_in(change, replace(change, sequence=8), change) == [True, True, False]


def test_what_the_node_refuses_is_not_heard() -> None:
    """A message its node does not believe does not stand in the way of the real one with its number and tick."""
    door = Door()
    assert door.lets_in(plan(0), plan(1, sequence=10**6)) == [True, True]
    door.rejections.add("agent2", MessageError("outside_limits", "as the node found"))
    assert door.lets_in(plan(1), plan(1)) == [True, False]
    assert door.refused() == [("agent2", "outside_limits", 1), ("agent2", "replayed", 1)]


@pytest.mark.parametrize("ahead", [0, 1, AHEAD, AHEAD + 1, 1000, 2**40])
def test_the_future(ahead: int) -> None:
    """A message may be as far ahead of the others as a connection may be slow, and no further."""
    door = Door()
    assert all(door.lets_in(*each_tick(7)))
    said = runs.end(7 + ahead)
    assert door.lets_in(said) == [ahead <= AHEAD]
    assert door.refused() == ([] if ahead <= AHEAD else [("coordinator", "future", 1)])


def test_a_latecomer_has_no_past() -> None:
    """The first message anybody hears may be of any tick; so may the first one after somebody was out of reach."""
    door = Door()
    assert door.lets_in(runs.tick(400), runs.tick(500)) == [True, False]
    door.admission.announce("coordinator", 0)
    assert door.lets_in(runs.tick(500), runs.tick(700)) == [True, False]


@pytest.mark.parametrize("told_again", [False, True], ids=["roster", "link-changes-first"])
def test_who_starts_anew_has_no_past(told_again: bool) -> None:
    """Thawed after many ticks, a process hears of its end first; then it believes where the others are by now.

    What came between was refused by its node, which took it for the future; that the rest is not stays with the gate.
    """
    door = Door("agent4")
    assert door.lets_in(*(plan(k) for k in range(44))) == [True] * 44
    for k in range(44, 44 + AHEAD):
        assert door.lets_in(plan(k)) == [True]
        door.rejections.add("agent2", MessageError("future", "as the node found"))
    assert door.lets_in(plan(67)) == [False]
    assert door.lets_in(replace(runs.roster(k=43, version=2), sequence=80)) == [True]
    door.admission.announce("agent4", INCARNATION + 1)
    change = sample(LinkChange, incarnation=0, sequence=90, tick=18)
    assert not told_again or door.lets_in(change) == [True]
    assert door.lets_in(replace(runs.roster(k=67, version=3), sequence=100), plan(67), plan(67 + AHEAD + 1)) == [
        True,
        True,
        False,
    ]


def test_an_older_start_is_not_believed() -> None:
    """Once a newer start is announced, nothing counts that an earlier one has said, whatever it is."""
    door = Door()
    assert door.lets_in(plan(0), report(0)) == [True, True]
    door.admission.announce("agent2", INCARNATION + 1)
    assert door.lets_in(plan(1), report(1)) == [False, False]
    newer = [replace(message, incarnation=INCARNATION + 1, sequence=0) for message in (plan(0), report(0))]
    assert door.lets_in(*newer) == [True, True]
    door.admission.announce("agent2", INCARNATION)  # a token that comes late
    assert door.lets_in(plan(1)) == [False]
    assert door.refused() == [("agent2", "wrong_incarnation", 3)]


def test_a_start_that_nobody_announces() -> None:
    """A message ahead of its sender's token waits for it; if it never comes the message is counted in the end."""
    door = Door()
    early = [plan(k, incarnation=INCARNATION + 1) for k in (3, 4)]
    late = plan(5, agent=3, incarnation=INCARNATION + 7)
    assert door.lets_in(early[0], late, early[1], plan(0)) == [False, False, False, True]
    assert (door.admission.kept, door.admission.released(), door.refused()) == (3, None, [])
    door.admission.announce("agent2", INCARNATION + 1)
    found = [door.admission.released(), door.admission.released(), door.admission.released()]
    assert [None if message is None else message.tick for message in found] == [3, 4, None]
    assert door.lets_in(early[1]) == [False]
    door.admission.close()
    assert door.refused() == [("agent2", "replayed", 1), ("agent3", "wrong_incarnation", 1)]


def test_who_waits_may_be_too_late() -> None:
    """A message that has waited is checked like any other when its token is here, and refused if a newer start is."""
    door = Door()
    waiting = plan(3, incarnation=INCARNATION + 1)
    assert door.lets_in(waiting, waiting) == [False, False]
    door.admission.announce("agent2", INCARNATION + 1)
    assert [door.admission.released(), door.admission.released()][1] is None
    assert door.lets_in(replace(waiting, incarnation=INCARNATION + 2)) == [False]
    door.admission.announce("agent2", INCARNATION + 3)
    assert door.admission.released() is None
    assert door.refused() == [("agent2", "replayed", 1), ("agent2", "wrong_incarnation", 1)]


def test_what_waits_is_bounded() -> None:
    """However many claim to be of a start to come, few are kept; the oldest are refused for the newest."""
    door = Door()
    for number in range(3000):
        assert door.lets_in(plan(1, sequence=number, incarnation=2**40)) == [False]
    assert door.admission.kept == 256
    assert door.refused() == [("agent2", "wrong_incarnation", 3000 - 256)]
    door.admission.close()
    assert door.refused() == [("agent2", "wrong_incarnation", 3000)]


def test_who_may_speak() -> None:
    """A stranger, the process itself, and whoever speaks under another's key are refused by name."""
    door = Door("agent1")
    strangers = [replace(plan(0), agent=9, sender="agent9"), plan(0, agent=1), plan(0, sender="agent3")]
    assert door.lets_in(*strangers) == [False] * 3
    assert door.admission.read(f"{KEYS.prefix}/plan/3", encode(plan(0))) is None
    assert door.refused() == [
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
def test_who_is_named(data: bytes, sender: str, reason: str) -> None:
    """A sender is named as it calls itself where that can be read, otherwise by the key it used."""
    door = Door()
    assert door.admission.read(f"{KEYS.prefix}/plan/2", data) is None
    assert door.refused() == [(sender, reason, 1)]


def test_size() -> None:
    """The largest messages of a run pass, and little more: what is larger is refused before it is looked at."""
    run = setup()
    door = Door()
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
    assert all(len(encode(message)) <= door.admission.max_bytes for message in (largest, notice))
    assert door.lets_in(largest, notice) == [True, True]
    assert door.admission.max_bytes < 2 * (len(encode(largest)) + len(encode(notice)))
    assert door.admission.read(KEYS.of(largest), bytes([VERSION]) + b"\x90" * door.admission.max_bytes) is None
    assert door.refused() == [("plan/2", "oversized", 1)]
    text = str(door.admission.oversized(10**9))
    assert text == f"message of 1000000000 bytes, at most {door.admission.max_bytes} in this run"


def test_any_order_of_two_streams() -> None:
    """However the messages of two keys are interleaved, each stream passes whole and once."""
    rng = np.random.default_rng(20240611)
    for _ in range(50):
        streams = [[plan(k) for k in range(12)], [plan(k, agent=3) for k in range(12)]]
        door, passed = Door(), []
        while any(streams):
            stream = streams[int(rng.integers(2))]
            if stream:
                message = stream.pop(0)
                again = [message] * int(rng.integers(1, 3))
                passed += [message for message, let_in in zip(again, door.lets_in(*again), strict=True) if let_in]
        for agent in (2, 3):
            ticks = [message.tick for message in passed if message.agent == agent]
            assert all(after == before + 1 for before, after in pairwise(ticks))
        assert len(passed) == 24
