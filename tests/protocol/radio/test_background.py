"""Traffic of others: its share of the airtime, and its effect on the team."""

import math

import pytest

from tests.protocol.radio.channels import MS, NEAR_MW, broadcast, equal_powers, parameters
from transport.protocol.radio.background_traffic import Background, BackgroundState
from transport.protocol.radio.channel_settings_and_state import ChannelState
from transport.protocol.radio.frames import Frame, FrameResult
from transport.protocol.radio.medium_access_and_retries import Channel
from transport.protocol.radio.standards_80211 import OFDM

PERIOD_NS = 50 * MS
PERIODS = 400
SIGMAS = 5.0


def flown(share: float) -> tuple[float, float]:
    """Return airtime share and delivered share of three stations in 20 s."""
    background = Background(share=share, station=3, power_mw=NEAR_MW, seed=5)
    waiting = BackgroundState()
    powers = background.heard(equal_powers(3))
    state = ChannelState.idle(len(powers), OFDM)
    busy_ns = delivered = 0
    for period in range(1, PERIODS + 1):
        end_ns = period * PERIOD_NS
        frames = [
            broadcast(3, station, end_ns - 40 * MS + 10 * station * MS, period, 200)
            for station in range(3)
        ]
        others: list[Frame]
        others, waiting = background.frames(waiting, OFDM, 6.0, end_ns)
        state, outcomes, counts = Channel(parameters(queue_length=200)).advance(
            state, powers, [*frames, *others], end_ns
        )
        busy_ns += counts.busy_ns
        delivered += sum(outcome.result is FrameResult.DELIVERED for outcome in outcomes)
    return busy_ns / (PERIODS * PERIOD_NS), delivered / (PERIODS * 3 * 2)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_background_takes_its_share(share: float) -> None:
    """The airtime is that of the team and the share of the others while there is room."""
    team = 3 * OFDM.message_airtime_ns(200, 6.0) / PERIOD_NS
    frames = share * PERIODS * PERIOD_NS / OFDM.message_airtime_ns(1500, 6.0)
    airtime, _ = flown(share)
    assert abs(airtime - team - share) < SIGMAS * share / math.sqrt(frames)


def test_background_is_broadcast_among_unicast_plans() -> None:
    """Frames of others have no receiver in the team, and take air all the same."""
    others = [Frame(MS, 2, 0, 1500, ())]
    _, outcomes, counts = Channel(parameters(unicast=True)).advance(
        ChannelState.idle(3, OFDM), equal_powers(3), others, PERIOD_NS
    )
    assert outcomes == []
    assert counts.busy_ns == OFDM.message_airtime_ns(1500, 6.0)


def test_background_costs_deliveries() -> None:
    """Frames of others collide with those of the team."""
    assert flown(0.0)[1] == 1.0
    assert flown(0.6)[1] < flown(0.2)[1] < 1.0
