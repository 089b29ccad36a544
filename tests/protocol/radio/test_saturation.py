"""Throughput of saturated stations against Bianchi's closed form.

Source: G. Bianchi, Performance analysis of the IEEE 802.11 distributed coordination function, IEEE
Journal on Selected Areas in Communications 18 (3), 2000, equations (7), (9) and (13).
"""

import math

import pytest

from tests.protocol.radio.channels import equal_powers, parameters, run
from transport.protocol.radio.frames import Frame, FrameResult
from transport.protocol.radio.standards_80211 import DSSS, OFDM, Standard

MESSAGE_BYTES = 1500
# Bianchi's chain counts down in the slot of a transmission, too, and collisions end with DIFS.
AGREEMENT = 0.03
SECOND_NS = 1_000_000_000


def bianchi_mbps(standard: Standard, stations: int, rate_mbps: float) -> float:
    """Return the saturation throughput of basic access, Mb/s of messages."""
    W = standard.cw_min + 1
    m = round(math.log2((standard.cw_max + 1) / W))

    def transmission(p: float) -> float:
        """Probability that a station transmits in a slot, (7), for its collision probability p."""
        sum_of_windows = sum((2.0 * p) ** i for i in range(m))  # (1 - (2p)^m) / (1 - 2p)
        return 2.0 / (1.0 + W + p * W * sum_of_windows)

    # (9): p = 1 - (1 - tau)^(n - 1), which has one solution.
    low, high = 0.0, 1.0
    for _ in range(60):
        p = 0.5 * (low + high)
        if p < 1.0 - (1.0 - transmission(p)) ** (stations - 1):
            low = p
        else:
            high = p
    tau = transmission(low)

    some = 1.0 - (1.0 - tau) ** stations
    one = stations * tau * (1.0 - tau) ** (stations - 1)
    frame_ns = standard.message_airtime_ns(MESSAGE_BYTES, rate_mbps)
    acknowledgement_ns = standard.acknowledgement_airtime_ns(rate_mbps)
    success_ns = frame_ns + standard.sifs_ns + acknowledgement_ns + standard.difs_ns
    collision_ns = frame_ns + standard.difs_ns
    # Payload over the mean length of a slot of the chain, (13).
    mean_ns = (1.0 - some) * standard.slot_ns + one * success_ns + (some - one) * collision_ns
    return one * 8.0 * MESSAGE_BYTES / mean_ns * 1e3


@pytest.mark.parametrize("stations", [2, 5, 10, 20])
@pytest.mark.parametrize(
    ("standard", "rate_mbps", "seconds"), [(OFDM, 6.0, 10), (OFDM, 24.0, 5), (DSSS, 11.0, 10)]
)
def test_saturation_throughput(
    standard: Standard, rate_mbps: float, seconds: int, stations: int
) -> None:
    """Stations that always have a frame share the channel as Bianchi's Markov chain says."""
    duration_ns = seconds * SECOND_NS
    most = duration_ns // standard.message_airtime_ns(MESSAGE_BYTES, rate_mbps)
    frames = [
        Frame(0, station, sequence, MESSAGE_BYTES, ((station + 1) % stations,))
        for station in range(stations)
        for sequence in range(2 * most // stations)
    ]
    given = parameters(
        standard=standard,
        rate_mbps=rate_mbps,
        unicast=True,
        queue_length=len(frames),
        attempts=1000,
    )
    outcomes, _ = run(given, equal_powers(stations), frames, duration_ns)
    delivered = sum(outcome.result is FrameResult.DELIVERED for outcome in outcomes)
    mbps = delivered * 8.0 * MESSAGE_BYTES / seconds / 1e6
    assert mbps == pytest.approx(bianchi_mbps(standard, stations, rate_mbps), rel=AGREEMENT)
