"""Slots: the time that a message occupies the channel, and the periods in which all slots fit."""

from itertools import pairwise

import pytest

from tests.protocol.radio.channels import MS, equal_powers, parameters, run
from transport.protocol.radio.frames import Frame
from transport.protocol.radio.send_times import SendTimes
from transport.protocol.radio.slot_length import fewest_periods, frame_lengths, occupied_ns
from transport.protocol.radio.standards_80211 import OFDM

PERIOD_NS = 50 * MS


@pytest.mark.parametrize("message_bytes", [300, 1500, 5000])
@pytest.mark.parametrize("unicast", [False, True])
def test_a_message_occupies_the_channel_no_longer_than_stated(
    message_bytes: int, unicast: bool
) -> None:
    """Whatever its backoffs, a message of a station has ended within its slot."""
    lengths = frame_lengths(message_bytes)
    frames = [Frame(MS, 0, i, length, (1, 2)) for i, length in enumerate(lengths)]
    allowed_ns = occupied_ns(lengths, OFDM, 6.0, receivers=2 if unicast else None)
    for seed in range(20):
        given = parameters(unicast=unicast, seed=seed)
        outcomes, _ = run(given, equal_powers(3), frames, PERIOD_NS)
        last_ns = max(outcome.time_ns for outcome in outcomes) - MS
        assert last_ns <= allowed_ns


def test_one_frame_occupies_difs_and_its_airtime() -> None:
    """A broadcast of one frame has no backoff."""
    assert occupied_ns([1500], OFDM, 6.0) == OFDM.difs_ns + OFDM.message_airtime_ns(1500, 6.0)


@pytest.mark.parametrize(
    ("stations", "slot_ns", "periods"),
    [(4, 10 * MS, 1), (5, 10 * MS, 2), (8, 10 * MS, 2), (9, 10 * MS, 3), (3, 60 * MS, 3)],
)
def test_slots_take_the_fewest_periods(stations: int, slot_ns: int, periods: int) -> None:
    """Four slots of 10 ms fit into 42 ms; a slot that fits into none has a period of its own."""
    assert fewest_periods(stations, 42 * MS, slot_ns) == periods


@pytest.mark.parametrize(("stations", "cycle"), [(4, 1), (5, 2), (32, 3)])
def test_in_a_cycle_each_station_has_one_slot_of_its_own(stations: int, cycle: int) -> None:
    """Over the periods of a cycle no two slots begin within the length of a slot."""
    given = SendTimes(period_ns=PERIOD_NS, stations=stations, cycle=cycle)
    first = 7
    begins_ns = {
        given.turn(station, first) * PERIOD_NS
        + given.offset_ns(station, given.turn(station, first))
        for station in range(stations)
    }
    assert len(begins_ns) == stations
    ordered = sorted(begins_ns)
    assert min(b - a for a, b in pairwise(ordered)) >= given.slot_ns - 1
    assert max(ordered) < (first + cycle) * PERIOD_NS
    assert {given.turn(station, first) - first for station in range(stations)} == set(range(cycle))


def test_what_is_computed_between_turns_is_sent_at_the_next_one() -> None:
    """Plans of all ticks of a cycle have the instant of the same slot."""
    given = SendTimes(period_ns=PERIOD_NS, stations=6, cycle=3)
    instants = {given.instant_ns(4, tick) for tick in (5, 6, 7)}
    assert instants == {7 * PERIOD_NS + given.offset_ns(4, 7)}
