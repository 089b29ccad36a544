"""Heads of messages, what is refused by them alone, and the brake for who sends too many of those."""

import time
from contextlib import suppress
from dataclasses import replace

import msgpack
import pytest

from protocol.admission import rate_limit as rate_limit
from protocol.admission.admission import Admission
from protocol.admission.rate_limit import BURST, WINDOW, WINDOW_S, RateLimit
from protocol.network.health import Offset, offset, usage
from protocol.wire.codec import VERSION, encode
from protocol.wire.header import Header, header_of, place_of
from protocol.wire.keys import Keys
from protocol.wire.messages import KINDS, LinkChange, MessageError, Plan
from protocol.wire.rejections import Rejections
from tests.support import runs
from tests.support.garbage import VALUES
from tests.support.runs import setup
from tests.support.samples import sample

KEYS = Keys("head")


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
def test_heads_are_those_of_the_messages(kind: type) -> None:
    """What the head says is what the message says, of every kind."""
    message = sample(kind)
    expected = Header(
        message.kind, message.sender, message.incarnation, message.sequence, message.tick, place_of(message)
    )
    assert header_of(encode(message)) == expected


def test_what_is_no_head() -> None:
    """Nothing, another version and no msgpack are refused; what needs more than the head to judge is left alone."""
    for data, reason in (
        (b"", "malformed"),
        (b"\xffabc", "wrong_version"),
        (bytes([VERSION, 0x95, 0xC1]), "malformed"),
        (bytes([VERSION, 0x95, 0xDD, 0x05, 0xF5, 0xE1, 0x00]), "malformed"),  # a list of 10^8 that does not come
    ):
        with pytest.raises(MessageError) as caught:
            header_of(data)
        assert caught.value.reason == reason
    whole = encode(sample(Plan))
    for cut in range(1, 40):
        assert header_of(whole[:cut]) in (None, header_of(whole))
    for value in VALUES:
        for place in range(5):
            values = ["plan", "agent1", 0, 1, 2, 3]
            values[place] = value
            with suppress(MessageError):
                header_of(bytes([VERSION]) + msgpack.packb(values))


class Door:
    """The plant's gate with agent 1's plan of tick 5 behind it."""

    def __init__(self) -> None:
        self.rejections = Rejections()
        self.admission = Admission("plant", KEYS, setup(), self.rejections)
        self.admission.announce("agent1", 1)
        self.plan = runs.plan(setup(), 1, 5)
        self.key = KEYS.of(self.plan)
        assert self.hears(self.plan)
        assert self.admission.released() is None  # it has been heard

    def hears(self, plan: Plan) -> bool:
        """Whether a plan is let in."""
        heard = self.admission.read(self.key, encode(plan))
        return heard is not None and encode(heard) == encode(plan)


def test_only_what_is_over_has_passed() -> None:
    """A replay, and a tick that has been said: counted unread. The next tick, another start, another sender: read."""
    door = Door()
    over = [door.plan, replace(door.plan, sequence=99), replace(door.plan, sequence=98, tick=4, start_tick=4)]
    for message in [*over, over[0]]:
        assert door.admission.has_passed(door.key, encode(message))
    news = [
        runs.plan(setup(), 1, 6),
        replace(door.plan, incarnation=2),
        replace(door.plan, sender="agent2", agent=1),
    ]
    for message in news:
        assert not door.admission.has_passed(door.key, encode(message))
    assert not door.admission.has_passed(KEYS.of(runs.plan(setup(), 2, 5)), encode(runs.plan(setup(), 2, 5)))
    assert door.rejections.total == 0  # the thread that reads counts
    door.admission.count_unread()
    assert {(entry.sender, entry.reason): entry.count for entry in door.rejections} == {
        ("agent1", "replayed"): 2,
        ("agent1", "past"): 2,
    }
    assert door.hears(news[0])


def test_what_has_passed_would_be_refused() -> None:
    """Whatever is refused unread, reading refuses as well, now and after all that may come in between."""
    for between in ((), (6,), (6, 7)):
        for sequence in (0, 10, 11, 99):
            for tick, negotiation in ((4, 0), (5, 0), (5, 1), (6, 0), (6, 1)):
                door = Door()
                message = replace(door.plan, sequence=sequence, tick=tick, start_tick=tick, negotiation=negotiation)
                passed = door.admission.has_passed(door.key, encode(message))
                for k in between:
                    assert door.hears(runs.plan(setup(), 1, k))
                if passed:
                    assert not door.hears(message)
                else:
                    assert door.hears(message) == (not between and sequence != door.plan.sequence)


def test_rosters_and_changes_of_links_do_not_count_for_each_other() -> None:
    """Under the key they share a roster has passed by its version, a change of links by its number."""
    admission = Admission("plant", KEYS, setup(), Rejections())
    admission.announce("coordinator", 0)
    first, second = (replace(runs.roster(version=version), sequence=version) for version in (1, 2))
    change = sample(LinkChange, incarnation=0, sequence=5, tick=0)
    key = KEYS.of(first)
    for message in (replace(first, sequence=10**6), change):
        assert admission.read(key, encode(message)) is not None
        assert admission.released() is None
    assert [admission.has_passed(key, encode(message)) for message in (first, second)] == [True, False]
    assert admission.has_passed(key, encode(change))
    assert not admission.has_passed(key, encode(replace(change, sequence=6)))
    for message in (second, replace(change, sequence=6)):
        assert admission.read(key, encode(message)) is not None
    assert admission.has_passed(key, encode(replace(second, sequence=10**6)))


def test_one_negotiation_is_not_another() -> None:
    """Within a tick agents exchange several plans: the second of them is not the first said again."""
    run = setup("controller.negotiation_iterations=2")
    admission = Admission("plant", KEYS, run, Rejections())
    admission.announce("agent1", 1)
    first = replace(runs.plan(run, 1, 5), negotiation=1)
    assert admission.read(KEYS.of(first), encode(first)) is not None
    assert admission.released() is None
    assert admission.has_passed(KEYS.of(first), encode(first))
    assert not admission.has_passed(KEYS.of(first), encode(replace(first, sequence=first.sequence + 1, negotiation=0)))


class FakeTime:
    """A clock that only sleeping and the test itself move."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.slept_s = 100.0, 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(time, "sleep", self._sleep)

    def _sleep(self, length_s: float) -> None:
        self.slept_s += length_s
        self.now_s += length_s


def test_the_brake(monkeypatch: pytest.MonkeyPatch) -> None:
    """A burst is free; after that one message takes as long as its share of the rate, whoever had the burst."""
    clock, held = FakeTime(monkeypatch), RateLimit()
    for _ in range(int(BURST)):
        held.hold()
    assert clock.slept_s == 0.0
    for _ in range(10 * int(BURST)):
        held.hold()
    assert clock.slept_s == pytest.approx(10 * BURST / rate_limit.RATE_HZ, rel=0.2)
    clock.now_s += 10.0  # peace
    before_s = clock.slept_s
    held.hold()
    assert clock.slept_s == before_s


def test_a_flood_that_is_slowed_down_is_still_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """More than any run sends is a flood, for as long as it comes as fast as it is let; no run is."""
    clock, held = FakeTime(monkeypatch), RateLimit()
    flooded = []
    for _ in range(20 * WINDOW):
        clock.now_s += 1e-5  # what waits in the socket is there at once
        flooded.append(held.flooded())
        if flooded[-1]:
            held.hold()
    assert clock.slept_s > 1.0
    assert all(flooded[2 * WINDOW :])
    for _ in range(2 * WINDOW):
        clock.now_s += 1.1 * WINDOW_S / WINDOW
        flooded.append(held.flooded())
    assert not flooded[-1]
    for _ in range(20 * WINDOW):
        clock.now_s += 1.1 * WINDOW_S / WINDOW
        assert not held.flooded()


def test_clock_offset() -> None:
    """Equal ways give the offset exactly; the error is at most half of what the ways take together (RFC 5905)."""
    assert offset(1_000, 6_500, 6_600, 2_100) == Offset(5e-6, 5e-7)
    for there_ns in (0, 100, 900):
        true_ns, way_ns = -3_000, 1_000
        asked_ns = there_ns + true_ns
        found = offset(0, asked_ns, asked_ns + 50, way_ns + 50)
        assert abs(found.ahead_s - true_ns / 1e9) <= found.uncertainty_s + 1e-15
    answers = iter([None])
    assert Offset.measured(lambda: next(answers)) is None


def test_usage() -> None:
    """What a process uses is told in bytes, counts and seconds, and of one that is not there nothing is."""
    used = usage()
    assert 1e7 < (used["memory_bytes"] or 0) < 1e11
    assert (used["threads"] or 0) >= 1
    assert (used["open_files"] or 0) >= 3
    assert (used["cpu_s"] or 0) > 0.0
    assert set(usage("0").values()) == {None}
