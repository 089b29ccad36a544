"""Headers of messages, refusals by the header alone, and the rate limit for a flood of refused messages."""

import time
from contextlib import suppress
from dataclasses import replace

import msgpack
import pytest

from protocol.admission import rate_limit as rate_limit
from protocol.admission.admission import Admission
from protocol.admission.rate_limit import BURST, REQUEST_BURST, REQUEST_RATE_HZ, WINDOW, WINDOW_S, RateLimit
from protocol.network.health import Offset, offset, usage
from protocol.wire.codec import VERSION, encode
from protocol.wire.header import Header, header_of, place_of
from protocol.wire.keys import Keys
from protocol.wire.messages import BUNDLES, KINDS, LinkChange, MessageError, Plan
from protocol.wire.rejections import Rejections
from tests.support import runs
from tests.support.garbage import VALUES
from tests.support.runs import setup
from tests.support.samples import sample

KEYS = Keys("header")


@pytest.mark.parametrize("kind", [*KINDS.values(), *BUNDLES.values()], ids=[*KINDS, *BUNDLES])
def test_header_equals_the_fields_of_the_message(kind: type) -> None:
    """The header of an encoded message or bundle of any kind has the values of the message's own fields."""
    message = sample(kind)
    expected = Header(
        message.kind, message.sender, message.incarnation, message.sequence, message.tick, place_of(message)
    )
    assert header_of(encode(message)) == expected


def test_invalid_headers_are_refused() -> None:
    """Empty data, another version and invalid msgpack are refused; data beyond the header are not judged."""
    for data, reason in (
        (b"", "malformed"),
        (b"\xffabc", "wrong_version"),
        (bytes([VERSION, 0x95, 0xC1]), "malformed"),
        (
            bytes([VERSION, 0x95, 0xDD, 0x05, 0xF5, 0xE1, 0x00]),
            "malformed",
        ),  # a list of 10^8 entries without its entries
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


class PlantAdmission:
    """The plant's admission after agent 1's plan of tick 5."""

    def __init__(self) -> None:
        self.rejections = Rejections()
        self.admission = Admission("plant", KEYS, setup(), self.rejections)
        self.admission.announce("agent1", 1)
        self.plan = runs.plan(setup(), 1, 5)
        self.key = KEYS.of(self.plan)
        assert self.hears(self.plan)
        assert self.admission.released() is None  # the plan has been read

    def hears(self, plan: Plan) -> bool:
        """Return whether a plan is admitted."""
        heard = self.admission.read(self.key, encode(plan))
        return heard is not None and encode(heard) == encode(plan)


def test_only_what_is_over_has_passed() -> None:
    """A replay or an earlier tick is counted unread; the next tick, another incarnation or another sender is read."""
    plant = PlantAdmission()
    over = [plant.plan, replace(plant.plan, sequence=99), replace(plant.plan, sequence=98, tick=4, start_tick=4)]
    for message in [*over, over[0]]:
        assert plant.admission.has_passed(plant.key, encode(message))
    news = [
        runs.plan(setup(), 1, 6),
        replace(plant.plan, incarnation=2),
        replace(plant.plan, sender="agent2", agent=1),
    ]
    for message in news:
        assert not plant.admission.has_passed(plant.key, encode(message))
    assert not plant.admission.has_passed(KEYS.of(runs.plan(setup(), 2, 5)), encode(runs.plan(setup(), 2, 5)))
    assert not plant.admission.has_passed(KEYS.left("agent2"), b"")  # a process leaves; this has no content
    assert plant.rejections.total == 0  # only the reading thread counts
    plant.admission.count_unread()
    assert {(entry.sender, entry.reason): entry.count for entry in plant.rejections} == {
        ("agent1", "replayed"): 2,
        ("agent1", "past"): 2,
    }
    assert plant.hears(news[0])


def test_what_has_passed_would_be_refused() -> None:
    """A message refused unread is also refused when read, now and after any messages in between."""
    for between in ((), (6,), (6, 7)):
        for sequence in (0, 10, 11, 99):
            for tick, negotiation in ((4, 0), (5, 0), (5, 1), (6, 0), (6, 1)):
                plant = PlantAdmission()
                message = replace(plant.plan, sequence=sequence, tick=tick, start_tick=tick, negotiation=negotiation)
                passed = plant.admission.has_passed(plant.key, encode(message))
                for k in between:
                    assert plant.hears(runs.plan(setup(), 1, k))
                if passed:
                    assert not plant.hears(message)
                else:
                    # A plan may be relayed, and the proposals of its tick come alone: they have an order of their own.
                    in_order = negotiation > 0 or not between
                    assert plant.hears(message) == (in_order and sequence != plant.plan.sequence)


def test_rosters_and_link_changes_are_counted_separately() -> None:
    """Under their common key a roster is refused unread by its version, a link change by its number."""
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
    """Agents send several plans within a tick: the second one is not a repetition of the first."""
    run = setup("controller.negotiation_iterations=2")
    admission = Admission("plant", KEYS, run, Rejections())
    admission.announce("agent1", 1)
    first = replace(runs.plan(run, 1, 5), negotiation=1)
    assert admission.read(KEYS.of(first), encode(first)) is not None
    assert admission.released() is None
    assert admission.has_passed(KEYS.of(first), encode(first))
    assert not admission.has_passed(KEYS.of(first), encode(replace(first, sequence=first.sequence + 1, negotiation=0)))


class FakeTime:
    """A clock that advances only by sleeping and by the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.slept_s = 100.0, 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(time, "sleep", self._sleep)

    def _sleep(self, length_s: float) -> None:
        self.slept_s += length_s
        self.now_s += length_s


@pytest.mark.parametrize(("rate_hz", "burst"), [(rate_limit.RATE_HZ, BURST), (REQUEST_RATE_HZ, REQUEST_BURST)])
def test_rate_limit(rate_hz: float, burst: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A burst is free; each later message takes its share of the rate, whichever sender used the burst."""
    clock, held = FakeTime(monkeypatch), RateLimit(rate_hz, burst)
    for _ in range(int(burst)):
        held.hold()
    assert clock.slept_s == 0.0
    for _ in range(1000):
        held.hold()
    assert clock.slept_s == pytest.approx(1000 / rate_hz, rel=0.2)
    clock.now_s += 10.0  # a pause without messages
    before_s = clock.slept_s
    held.hold()
    assert clock.slept_s == before_s


def test_a_flood_that_is_slowed_down_is_still_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rate above that of any run is a flood until the sender slows down by itself; the rate of a run is none."""
    clock, held = FakeTime(monkeypatch), RateLimit()
    flooded = []
    for _ in range(20 * WINDOW):
        clock.now_s += 1e-5  # messages that wait in the socket arrive at once
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
    """Equal delays of both ways give the exact offset; the error is at most half of the round-trip delay (RFC 5905)."""
    assert offset(1_000, 6_500, 6_600, 2_100) == Offset(5e-6, 5e-7)
    for there_ns in (0, 100, 900):
        true_ns, way_ns = -3_000, 1_000
        asked_ns = there_ns + true_ns
        found = offset(0, asked_ns, asked_ns + 50, way_ns + 50)
        assert abs(found.ahead_s - true_ns / 1e9) <= found.uncertainty_s + 1e-15
    answers = iter([None])
    assert Offset.measured(lambda: next(answers)) is None


def test_usage() -> None:
    """Resource use of a process is in bytes, counts and seconds; every value is None for an unknown process."""
    used = usage()
    assert 1e7 < (used["memory_bytes"] or 0) < 1e11
    assert (used["threads"] or 0) >= 1
    assert (used["open_files"] or 0) >= 3
    assert (used["cpu_s"] or 0) > 0.0
    assert set(usage("0").values()) == {None}
