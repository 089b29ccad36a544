"""Channel: carrier sense, collisions, capture, hidden nodes, queues and retries."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests.protocol.radio.channels import (
    MS,
    NEAR_MW,
    NOISE_MW,
    SILENT_MW,
    broadcast,
    equal_powers,
    parameters,
    run,
)
from transport.protocol.radio.channel_settings_and_state import ChannelState
from transport.protocol.radio.frames import Frame, FrameOutcome, FrameResult
from transport.protocol.radio.medium_access_and_retries import Channel
from transport.protocol.radio.standards_80211 import OFDM

AIRTIME_NS = OFDM.message_airtime_ns(1500, 6.0)
SECOND_NS = 1_000 * MS
PERIOD_NS = 50 * MS


def results(outcomes: list[FrameOutcome]) -> Counter[FrameResult]:
    """Return the outcomes by result."""
    return Counter(outcome.result for outcome in outcomes)


def random_frames(stations: int, periods: int, spread_ns: int, seed: int = 4) -> list[Frame]:
    """Return one broadcast per station and period, spread at random."""
    random = np.random.default_rng(seed)
    return [
        broadcast(
            stations, station, period * PERIOD_NS + int(random.integers(spread_ns)), period, 800
        )
        for period in range(periods)
        for station in range(stations)
    ]


def random_powers(stations: int, seed: int = 5) -> list[list[float]]:
    """Return powers from inaudible to near, the same in both directions."""
    random = np.random.default_rng(seed)
    level = random.uniform(-2.0, 5.0, (stations, stations))
    return [
        [float(NOISE_MW * 10.0 ** level[min(i, j), max(i, j)]) for j in range(stations)]
        for i in range(stations)
    ]


def test_a_frame_on_an_idle_channel_arrives_after_difs_and_its_airtime() -> None:
    """Without other traffic the delay is DIFS and the airtime."""
    outcomes, counts = run(parameters(), equal_powers(3), [broadcast(3, 0, MS)], SECOND_NS)
    arrival_ns = MS + OFDM.difs_ns + AIRTIME_NS
    assert [(outcome.receiver, outcome.result, outcome.time_ns) for outcome in outcomes] == [
        (1, FrameResult.DELIVERED, arrival_ns),
        (2, FrameResult.DELIVERED, arrival_ns),
    ]
    assert counts.busy_ns == AIRTIME_NS


@pytest.mark.parametrize("stations", [2, 4, 16])
def test_sends_at_one_instant_all_collide(stations: int) -> None:
    """Stations that find the channel idle at one instant transmit at one instant."""
    frames = [broadcast(stations, station, MS) for station in range(stations)]
    outcomes, counts = run(parameters(), equal_powers(stations), frames, SECOND_NS)
    assert results(outcomes) == {FrameResult.COLLISION: stations * (stations - 1)}
    assert counts.transmissions == stations


def test_a_station_defers_to_a_frame_on_the_air() -> None:
    """A frame sent during another one waits for its end, DIFS and a whole number of slots."""
    frames = [broadcast(2, 0, MS), broadcast(2, 1, MS + AIRTIME_NS // 2)]
    outcomes, _ = run(parameters(), equal_powers(2), frames, SECOND_NS)
    first, second = outcomes
    waited_ns = second.time_ns - AIRTIME_NS - first.time_ns - OFDM.difs_ns
    assert results(outcomes) == {FrameResult.DELIVERED: 2}
    assert waited_ns % OFDM.slot_ns == 0
    assert 0 <= waited_ns <= OFDM.cw_min * OFDM.slot_ns


def test_post_backoff_keeps_a_sender_from_the_next_frame() -> None:
    """Behind its own frame a station waits for a random backoff, also on an idle channel."""
    frames = [broadcast(2, 0, MS, sequence) for sequence in range(400)]
    outcomes, _ = run(parameters(queue_length=400), equal_powers(2), frames, 10 * SECOND_NS)
    ends_ns = [outcome.time_ns for outcome in outcomes]
    waits = np.diff(ends_ns) - AIRTIME_NS - OFDM.difs_ns
    assert set(waits // OFDM.slot_ns) == set(range(OFDM.cw_min + 1))
    assert not np.any(waits % OFDM.slot_ns)


@pytest.mark.parametrize("draws", [True, False])
def test_an_interrupted_wait_draws_a_backoff_or_keeps_none(draws: bool) -> None:
    """Frames whose wait for DIFS was interrupted all follow at once, or draw."""
    # The second and the third station wait when the first one starts; without a draw they collide.
    frames = [broadcast(3, station, MS + 10_000 * station) for station in range(3)]
    collided = 0
    for seed in range(40):
        given = parameters(interrupted_wait_draws=draws, seed=seed)
        outcomes, _ = run(given, equal_powers(3), frames, SECOND_NS)
        collided += FrameResult.COLLISION in results(outcomes)
    # Two draws among 16 slots are equal in 2.5 of 40 cases; more than 10 would be 5 sigma.
    assert collided <= 10 if draws else collided == 40


def test_the_near_one_of_two_colliding_frames_is_captured() -> None:
    """Of two frames at one instant a receiver decodes the one whose power stands out."""
    powers = equal_powers(3)
    powers[1][2] = powers[2][1] = NEAR_MW / 100.0
    frames = [broadcast(3, 0, MS), broadcast(3, 1, MS)]
    outcomes, _ = run(parameters(), powers, frames, SECOND_NS)
    fate = {(outcome.frame.sender, outcome.receiver): outcome.result for outcome in outcomes}
    assert fate[0, 2] is FrameResult.DELIVERED
    assert fate[1, 2] is FrameResult.COLLISION
    assert fate[0, 1] is fate[1, 0] is FrameResult.COLLISION  # both transmit


@pytest.mark.parametrize(("excess_db", "captured"), [(3.0, False), (5.0, True)])
def test_capture_needs_the_threshold_of_preambles(excess_db: float, captured: bool) -> None:
    """A preamble 4 dB above noise and interference is detected, a weaker one is not."""
    powers = equal_powers(3)
    powers[0][2] = NEAR_MW * 10.0 ** (excess_db / 10.0)
    frames = [broadcast(3, 0, MS), broadcast(3, 1, MS)]
    outcomes, _ = run(parameters(), powers, frames, SECOND_NS)
    fate = {(outcome.frame.sender, outcome.receiver): outcome.result for outcome in outcomes}
    assert (fate[0, 2] is FrameResult.DELIVERED) == captured


def test_a_higher_rate_needs_more_signal_over_interference() -> None:
    """A payload 6 dB above interference is decoded at 6 Mb/s, not at 54."""
    powers = equal_powers(3)
    powers[0][2] = NEAR_MW * 10.0**0.6
    frames = [broadcast(3, 0, MS), broadcast(3, 1, MS)]
    for rate_mbps, expected in ((6.0, FrameResult.DELIVERED), (54.0, FrameResult.COLLISION)):
        outcomes, _ = run(parameters(rate_mbps=rate_mbps), powers, frames, SECOND_NS)
        fate = {(outcome.frame.sender, outcome.receiver): outcome.result for outcome in outcomes}
        assert fate[0, 2] is expected


def test_hidden_nodes_collide_at_the_station_between_them() -> None:
    """Stations that do not hear each other do not defer, and collide at one that hears both."""
    powers = equal_powers(3)
    powers[0][2] = powers[2][0] = SILENT_MW
    frames = [broadcast(3, 0, MS), broadcast(3, 2, MS + AIRTIME_NS // 2)]
    outcomes, counts = run(parameters(), powers, frames, SECOND_NS)
    fate = {(outcome.frame.sender, outcome.receiver): outcome.result for outcome in outcomes}
    assert fate == {
        (0, 1): FrameResult.COLLISION,
        (2, 1): FrameResult.COLLISION,
        (0, 2): FrameResult.WEAK,
        (2, 0): FrameResult.WEAK,
    }
    assert counts.busy_ns < 2 * AIRTIME_NS

    powers[0][2] = powers[2][0] = NEAR_MW
    outcomes, _ = run(parameters(), powers, frames, SECOND_NS)
    assert results(outcomes) == {FrameResult.DELIVERED: 4}


def test_a_station_defers_to_frames_that_it_cannot_tell_apart() -> None:
    """Of two with equal power at one instant it decodes none, and waits for their end."""
    frames = [broadcast(3, 0, MS), broadcast(3, 1, MS), broadcast(3, 2, MS + AIRTIME_NS // 2)]
    outcomes, counts = run(parameters(), equal_powers(3), frames, SECOND_NS)
    assert counts.busy_ns == 2 * AIRTIME_NS
    assert {one.result for one in outcomes if one.frame.sender == 2} == {FrameResult.DELIVERED}


def test_an_acknowledgement_does_not_end_the_wait_for_another_frame() -> None:
    """A station that acknowledges during a frame that it senses sends its own behind that one."""
    sensed_mw = 2.0 * NOISE_MW
    powers = equal_powers(4, SILENT_MW)
    for one, other, power_mw in ((0, 1, NEAR_MW), (2, 3, NEAR_MW), (1, 2, sensed_mw)):
        powers[one][other] = powers[other][one] = power_mw
    frames = [
        Frame(MS, 0, 0, 1500, (1,)),
        Frame(MS + AIRTIME_NS // 2, 2, 0, 1500, (3,)),
        Frame(MS + AIRTIME_NS // 4, 1, 0, 1500, (0,)),
    ]
    given = parameters(unicast=True, carrier_sense_mw=sensed_mw)
    outcomes, counts = run(given, powers, frames, SECOND_NS)
    assert results(outcomes) == {FrameResult.DELIVERED: 3}
    ends_ns = {one.frame.sender: one.time_ns for one in outcomes}
    assert ends_ns[1] - AIRTIME_NS >= ends_ns[2] + OFDM.difs_ns
    assert counts.repetitions == 0


def test_power_too_weak_to_decode_keeps_the_channel_busy() -> None:
    """A station defers to power above its threshold, although it detects no preamble."""
    sensed_mw = 2.0 * NOISE_MW
    powers = [[SILENT_MW, sensed_mw], [sensed_mw, SILENT_MW]]
    frames = [broadcast(2, 0, MS), broadcast(2, 1, MS + AIRTIME_NS // 2)]
    _, counts = run(parameters(carrier_sense_mw=sensed_mw), powers, frames, SECOND_NS)
    assert counts.busy_ns == 2 * AIRTIME_NS
    _, counts = run(parameters(carrier_sense_mw=1.1 * sensed_mw), powers, frames, SECOND_NS)
    assert counts.busy_ns < 2 * AIRTIME_NS


def test_a_frame_below_the_sensitivity_is_weak() -> None:
    """A frame that no receiver could hear on an idle channel is lost as weak."""
    powers = equal_powers(2, 9.0 * NOISE_MW)
    outcomes, _ = run(parameters(), powers, [broadcast(2, 0, MS)], SECOND_NS)
    assert results(outcomes) == {FrameResult.WEAK: 1}


def test_a_queue_holds_its_length_and_drops_the_newest() -> None:
    """Of frames sent at once a queue keeps as many as it holds, the oldest."""
    frames = [broadcast(2, 0, MS, sequence) for sequence in range(10)]
    outcomes, _ = run(parameters(queue_length=4), equal_powers(2), frames, SECOND_NS)
    delivered = [o.frame.sequence for o in outcomes if o.result is FrameResult.DELIVERED]
    dropped = [o.frame.sequence for o in outcomes if o.result is FrameResult.QUEUE]
    assert delivered == [0, 1, 2, 3]
    assert dropped == [4, 5, 6, 7, 8, 9]


def test_unicast_frames_at_one_instant_arrive_after_retries() -> None:
    """Acknowledged frames survive the collision that loses broadcasts, by repetitions."""
    frames = [Frame(MS, station, 0, 1500, ((station + 1) % 4,)) for station in range(4)]
    outcomes, counts = run(parameters(unicast=True), equal_powers(4), frames, SECOND_NS)
    assert results(outcomes) == {FrameResult.DELIVERED: 4}
    assert counts.repetitions >= 4
    assert counts.acknowledgements == 4


def test_unicast_to_a_silent_receiver_exhausts_the_attempts() -> None:
    """A frame without acknowledgement is sent as often as allowed, then given up."""
    frame = Frame(MS, 0, 0, 1500, (1,))
    powers = equal_powers(2, SILENT_MW)
    outcomes, counts = run(parameters(unicast=True, attempts=5), powers, [frame], SECOND_NS)
    assert results(outcomes) == {FrameResult.RETRIES: 1}
    assert counts.transmissions == 5


def test_the_contention_window_doubles_up_to_its_largest_and_begins_anew() -> None:
    """It is 2 w + 1 behind each attempt, and the smallest behind the last one (IEEE 802.11-2020, 10.3.4)."""
    channel = Channel(parameters(unicast=True, attempts=9))
    state = ChannelState.idle(2, OFDM)
    frames = [Frame(MS, 0, 0, 1500, (1,))]
    windows = []
    for until_ns in range(2 * MS, 200 * MS, MS):
        state, *_ = channel.advance(state, equal_powers(2, SILENT_MW), frames, until_ns)
        frames = []
        windows.append(state.stations[0].window)
    assert list(dict.fromkeys(windows)) == [15, 31, 63, 127, 255, 511, 1023]
    assert windows[-1] == 15


def test_an_acknowledgement_is_awaited_for_sifs_a_slot_and_a_preamble() -> None:
    """The only attempt is lost at the timeout of its acknowledgement (IEEE 802.11-2020, 10.3.2.11)."""
    frame = Frame(MS, 0, 0, 1500, (1,))
    powers = equal_powers(2, SILENT_MW)
    [outcome], _ = run(parameters(unicast=True, attempts=1), powers, [frame], SECOND_NS)
    timeout_ns = OFDM.sifs_ns + OFDM.slot_ns + OFDM.preamble_ns
    assert outcome.delay_ns == OFDM.difs_ns + AIRTIME_NS + timeout_ns


@pytest.mark.parametrize(("heard_db", "acknowledgement_mbps"), [(50.0, 24.0), (12.0, 6.0)])
def test_a_third_station_keeps_quiet_for_an_acknowledgement(
    heard_db: float, acknowledgement_mbps: float
) -> None:
    """For SIFS and its airtime: at its rate if the frame is decoded, else at the lowest one (EIFS)."""
    rate_mbps = 54.0
    powers = equal_powers(3)
    powers[0][2] = NOISE_MW * 10.0 ** (heard_db / 10.0)
    powers[1][2] = powers[2][1] = SILENT_MW
    airtime_ns = OFDM.message_airtime_ns(1500, rate_mbps)
    frames = [Frame(MS, 0, 0, 1500, (1,)), Frame(MS + airtime_ns // 2, 2, 0, 1500, (0,))]
    quiet_ns = OFDM.sifs_ns + OFDM.acknowledgement_airtime_ns(acknowledgement_mbps) + OFDM.difs_ns

    slots = set()
    for seed in range(100):
        given = parameters(unicast=True, rate_mbps=rate_mbps, seed=seed)
        (first, second), _ = run(given, powers, frames, SECOND_NS)
        assert first.result is second.result is FrameResult.DELIVERED
        slots.add((second.time_ns - airtime_ns - quiet_ns - first.time_ns) / OFDM.slot_ns)
    assert slots == set(range(OFDM.cw_min + 1))


def test_a_lost_acknowledgement_delivers_once() -> None:
    """A receiver that is heard badly reports its frame once, however often it is repeated."""
    powers = [[SILENT_MW, NEAR_MW], [SILENT_MW, SILENT_MW]]
    frame = Frame(MS, 0, 0, 1500, (1,))
    outcomes, counts = run(parameters(unicast=True), powers, [frame], SECOND_NS)
    assert results(outcomes) == {FrameResult.DELIVERED: 1}
    assert counts.transmissions == 7


def test_unicast_to_several_receivers_sends_to_each_in_turn() -> None:
    """A unicast frame takes as many transmissions as it has receivers."""
    outcomes, counts = run(
        parameters(unicast=True), equal_powers(4), [broadcast(4, 0, MS)], SECOND_NS
    )
    assert [outcome.receiver for outcome in outcomes] == [1, 2, 3]
    assert counts.transmissions == counts.acknowledgements == 3


@pytest.mark.parametrize("unicast", [False, True])
@pytest.mark.parametrize("spread_ns", [1, MS, 40 * MS])
def test_each_frame_has_one_outcome_per_receiver(unicast: bool, spread_ns: int) -> None:
    """Frames are conserved: each is delivered or lost for one reason at each of its receivers."""
    frames = random_frames(8, 20, spread_ns)
    given = parameters(unicast=unicast, queue_length=20)
    outcomes, _ = run(given, random_powers(8), frames, 100 * SECOND_NS)
    expected = Counter((frame, receiver) for frame in frames for receiver in frame.receivers)
    assert Counter((outcome.frame, outcome.receiver) for outcome in outcomes) == expected
    assert all(outcome.time_ns >= outcome.frame.sent_ns for outcome in outcomes)


@pytest.mark.parametrize("unicast", [False, True])
def test_the_order_of_the_frames_changes_nothing(unicast: bool) -> None:
    """Frames in any order have equal outcomes."""
    frames = random_frames(6, 10, 2 * MS)
    given = parameters(unicast=unicast)
    expected = run(given, random_powers(6), frames, 10 * SECOND_NS)
    shuffled = [frames[place] for place in np.random.default_rng(6).permutation(len(frames))]
    assert run(given, random_powers(6), shuffled, 10 * SECOND_NS) == expected


@pytest.mark.parametrize("unicast", [False, True])
def test_windows_do_not_change_the_outcomes(unicast: bool) -> None:
    """Any division of time into windows has the same outcomes: the state has all."""
    frames = random_frames(6, 8, 2 * MS)
    given = parameters(unicast=unicast)
    powers = random_powers(6)
    expected, counts = run(given, powers, frames, SECOND_NS)

    state = ChannelState.idle(6, OFDM)
    outcomes: list[FrameOutcome] = []
    busy_ns = 0
    # 0.7 ms ends windows within frames, waits and acknowledgements.
    for until_ns in [*range(0, SECOND_NS, 700_000), SECOND_NS]:
        begin_ns = state.time_ns
        sent = [frame for frame in frames if begin_ns <= frame.sent_ns < until_ns]
        state, more, counted = Channel(given).advance(state, powers, sent, until_ns)
        outcomes += more
        busy_ns += counted.busy_ns
    assert outcomes == expected
    assert busy_ns == counts.busy_ns


@pytest.mark.parametrize("spread_ns", [MS, 10 * MS, 40 * MS])
@pytest.mark.parametrize("unicast", [False, True])
def test_a_near_team_has_the_channel_of_its_powers(unicast: bool, spread_ns: int) -> None:
    """Steps that a near team saves change neither outcomes nor state, whatever the window.

    The slow way has windows that are shorter than a frame: nothing can be decided at once there.
    """
    stations = 6
    frames = random_frames(stations, 6, spread_ns)
    # All near, but some stand out among those that collide, and are then not decoded.
    above = np.random.default_rng(7).uniform(0.0, 10.0, (stations, stations))
    powers = (NEAR_MW * np.maximum(above, above.T).clip(1.0)).tolist()
    channel = Channel(parameters(unicast=unicast, rate_mbps=54.0))
    assert channel.is_near(NEAR_MW)

    found = channel.advance(ChannelState.idle(stations, OFDM), powers, frames, SECOND_NS, near=True)

    state = ChannelState.idle(stations, OFDM)
    outcomes: list[FrameOutcome] = []
    for until_ns in range(500_000, SECOND_NS + 1, 500_000):
        begin_ns = state.time_ns
        sent = [frame for frame in frames if begin_ns <= frame.sent_ns < until_ns]
        state, more, _ = channel.advance(state, powers, sent, until_ns)
        outcomes += more
    assert (found[0].stations, found[1]) == (state.stations, outcomes)


@pytest.mark.parametrize("above_noise_db", [9.0, 11.0, 15.0, 20.0, 50.0])
@pytest.mark.parametrize("rate_mbps", [6.0, 54.0])
def test_a_near_station_decodes_whatever_is_sent_alone(
    above_noise_db: float, rate_mbps: float
) -> None:
    """Its power is above the sensitivity, and so far above the noise that the rate is decoded."""
    power_mw = NOISE_MW * 10.0 ** (above_noise_db / 10.0)
    given = parameters(rate_mbps=rate_mbps)
    outcomes, _ = run(given, equal_powers(2, power_mw), [broadcast(2, 0, MS)], SECOND_NS)
    is_near = Channel(given).is_near(power_mw)
    assert not is_near or results(outcomes) == {FrameResult.DELIVERED: 1}
    assert is_near or above_noise_db < 50.0


def test_what_happens_at_the_end_of_a_window_belongs_to_the_next() -> None:
    """A frame that ends at that instant is decided behind it."""
    end_ns = MS + OFDM.difs_ns + AIRTIME_NS
    for until_ns, decided in ((end_ns, 0), (end_ns + 1, 1)):
        outcomes, _ = run(parameters(), equal_powers(2), [broadcast(2, 0, MS)], until_ns)
        assert len(outcomes) == decided


def test_a_frame_on_the_air_draws_no_backoff() -> None:
    """What its sender senses meanwhile interrupts no wait: each of two that collide draws once, behind its own."""
    frames = [broadcast(3, station, MS) for station in (0, 1)]
    idle = ChannelState.idle(3, OFDM)
    given = parameters(interrupted_wait_draws=True)
    state, *_ = Channel(given).advance(idle, equal_powers(3), frames, SECOND_NS)
    assert [station.backoffs for station in state.stations] == [1, 1, 0]


def test_a_state_is_not_changed_by_its_use() -> None:
    """The same state twice gives the same channel: `advance` has no memory."""
    frames = random_frames(5, 2, MS)
    given = parameters()
    powers = random_powers(5)
    state, *_ = Channel(given).advance(ChannelState.idle(5, OFDM), powers, frames, 2 * MS)
    assert state.air or state.events
    channel = Channel(given)
    first = channel.advance(state, powers, [], SECOND_NS)
    assert channel.advance(state, powers, [], SECOND_NS) == first


def test_the_seed_changes_the_backoffs() -> None:
    """Another seed is another channel."""
    frames = random_frames(8, 5, MS)
    first = run(parameters(seed=1), equal_powers(8), frames, SECOND_NS)
    assert run(parameters(seed=1), equal_powers(8), frames, SECOND_NS) == first
    assert run(parameters(seed=2), equal_powers(8), frames, SECOND_NS) != first


def test_parameters_are_values() -> None:
    """Equal settings are equal, so that they can be keys."""
    assert parameters() == parameters()
    assert replace(parameters(), seed=2) != parameters()
