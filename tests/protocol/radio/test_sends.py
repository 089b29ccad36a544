"""Instants of sends: computation times, slots, random offsets."""

import math

import numpy as np
import pytest

from transport.protocol.radio.send_times import Offsets, SendTimes

MS = 1_000_000
PERIOD_NS = 50 * MS
COUNT = 4_000
SIGMAS = 5.0  # one false alarm in two million, at fixed seeds


def times(offsets: Offsets, **changes: int) -> SendTimes:
    """Return the send times of four UAVs that compute for 5 ms with a deviation of 1 ms."""
    given = {"computation_mean_ns": 5 * MS, "computation_deviation_ns": MS, "stations": 4}
    return SendTimes(period_ns=PERIOD_NS, offsets=offsets, seed=2, **{**given, **changes})


def test_computation_times_have_mean_and_deviation() -> None:
    """Computation times are normal with the mean and deviation given."""
    drawn = np.array([times("none").computed_ns(1, tick) for tick in range(COUNT)]) / MS
    assert abs(drawn.mean() - 5.0) < SIGMAS / math.sqrt(COUNT)
    assert abs(drawn.std() - 1.0) < SIGMAS / math.sqrt(2.0 * COUNT)


def test_computation_times_are_never_negative() -> None:
    """A deviation as large as the mean gives no send before the measurement."""
    given = times("none", computation_deviation_ns=5 * MS)
    assert min(given.computed_ns(0, tick) for tick in range(COUNT)) == 0


def test_without_computation_and_offsets_all_send_at_the_tick() -> None:
    """No scatter at all is one instant for the whole team."""
    given = times("none", computation_mean_ns=0, computation_deviation_ns=0)
    assert {given.instant_ns(station, 3) for station in range(4)} == {3 * PERIOD_NS}


def test_slots_are_apart_and_within_the_period() -> None:
    """Slots begin when the computations have ended and share the rest of the period evenly."""
    given = times("slots", computation_deviation_ns=0)
    instants = [given.instant_ns(station, 2) - 2 * PERIOD_NS for station in range(4)]
    assert instants == [
        5 * MS,
        5 * MS + 45 * MS // 4,
        5 * MS + 90 * MS // 4,
        5 * MS + 135 * MS // 4,
    ]


def test_a_late_computation_delays_its_slot_only() -> None:
    """A station sends when it is ready if that is after its slot."""
    given = times("slots", computation_deviation_ns=10 * MS, stations=32)
    for tick in range(200):
        ready_ns = tick * PERIOD_NS + given.computed_ns(0, tick)
        slot_ns = tick * PERIOD_NS + given.allowance_ns
        assert given.instant_ns(0, tick) == max(ready_ns, slot_ns)


def test_random_offsets_fill_the_rest_of_the_period() -> None:
    """Random offsets are uniform from the end of the computations to the end of the period."""
    given = times("random")
    offsets = np.array([given.offset_ns(2, tick) for tick in range(COUNT)]) / MS
    first, last = 8.0, 50.0
    assert offsets.min() >= first
    assert offsets.max() < last
    uniform_deviation = (last - first) / math.sqrt(12.0)
    assert abs(offsets.mean() - 0.5 * (first + last)) < SIGMAS * uniform_deviation / math.sqrt(
        COUNT
    )


def test_exchanges_of_a_negotiation_follow_each_other() -> None:
    """Three exchanges take a third of the period each, with slots of their own."""
    given = times("slots", exchanges=3, computation_deviation_ns=0)
    starts = [given.instant_ns(0, 0, exchange) for exchange in range(3)]
    assert starts == [exchange * (PERIOD_NS // 3) + 5 * MS for exchange in range(3)]
    assert given.instant_ns(3, 0, 0) < starts[1]


@pytest.mark.parametrize("offsets", ["slots", "random"])
def test_computations_of_a_whole_period_leave_no_slots(offsets: Offsets) -> None:
    """Without time for slots all stations send when they are ready."""
    given = times(offsets, computation_mean_ns=60 * MS, computation_deviation_ns=0)
    assert {given.instant_ns(station, 0) for station in range(4)} == {60 * MS}
