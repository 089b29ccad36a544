"""Airtimes and interframe spaces against values computed by hand from the standard."""

import pytest

from transport.protocol.radio.standards_80211 import DSSS, OFDM, OVERHEAD_BYTES, STANDARDS

US = 1_000


@pytest.mark.parametrize(
    ("rate_mbps", "frame_bytes", "airtime_us"),
    [
        # 20 us + 4 us * ceil((16 + 8 * bytes + 6) / bits per symbol); IEEE 802.11-2020, 17.4.3.
        (6.0, 1536, 20 + 4 * 513),  # 12310 bits in symbols of 24
        (9.0, 1536, 20 + 4 * 342),  # of 36
        (24.0, 1536, 20 + 4 * 129),  # of 96
        (54.0, 1536, 20 + 4 * 57),  # of 216
        (6.0, 14, 20 + 4 * 6),  # an acknowledgement: 134 bits
        (24.0, 14, 20 + 4 * 2),
    ],
)
def test_airtimes_of_ofdm(rate_mbps: float, frame_bytes: int, airtime_us: int) -> None:
    """The airtime of an OFDM frame is its preamble, its header and whole symbols of 4 us."""
    assert OFDM.airtime_ns(frame_bytes, rate_mbps) == airtime_us * US


@pytest.mark.parametrize(
    ("rate_mbps", "frame_bytes", "airtime_us"),
    [
        # 192 us + bits over rate, in whole microseconds; IEEE 802.11-2020, 16.3.4.
        (1.0, 1536, 192 + 12288),
        (2.0, 1536, 192 + 6144),
        (5.5, 1536, 192 + 2235),  # 2234.2
        (11.0, 1536, 192 + 1118),  # 1117.1
        (1.0, 14, 192 + 112),
    ],
)
def test_airtimes_of_dsss(rate_mbps: float, frame_bytes: int, airtime_us: int) -> None:
    """The airtime of a DSSS or CCK frame is the long preamble and its bits over the rate."""
    assert DSSS.airtime_ns(frame_bytes, rate_mbps) == airtime_us * US


def test_interframe_spaces() -> None:
    """DIFS is SIFS and two slots; EIFS is SIFS, the slowest acknowledgement and DIFS."""
    assert OFDM.difs_ns == 34 * US
    assert OFDM.difs_ns + OFDM.eifs_extra_ns == (16 + 44 + 34) * US
    assert DSSS.difs_ns == 50 * US
    assert DSSS.difs_ns + DSSS.eifs_extra_ns == (10 + 304 + 50) * US


@pytest.mark.parametrize(
    ("name", "rate_mbps", "acknowledgement_mbps"),
    [
        ("802.11a", 6.0, 6.0),
        ("802.11a", 9.0, 6.0),
        ("802.11a", 18.0, 12.0),
        ("802.11a", 54.0, 24.0),
        ("802.11b", 1.0, 1.0),
        ("802.11b", 11.0, 2.0),
    ],
)
def test_rates_of_acknowledgements(
    name: str, rate_mbps: float, acknowledgement_mbps: float
) -> None:
    """An acknowledgement has the highest basic rate that is not above the rate of the data."""
    assert STANDARDS[name].acknowledgement_rate_mbps(rate_mbps) == acknowledgement_mbps


def test_a_message_has_36_bytes_around_it() -> None:
    """A message travels with 8 bytes of LLC/SNAP, 24 of MAC header and 4 of checksum."""
    assert OVERHEAD_BYTES == 36
    assert OFDM.message_airtime_ns(1500, 6.0) == OFDM.airtime_ns(1536, 6.0)
