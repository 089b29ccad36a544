"""Timing and rates of the supported 802.11 standards, and the time that a frame occupies the air.

Sources: IEEE 802.11-2020, clause 17 (OFDM, "802.11a"), clauses 15 and 16 (DSSS and CCK, "802.11b").
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

# Bytes around a message: LLC/SNAP header 8, MAC header of a data frame 24, frame check sequence 4.
OVERHEAD_BYTES = 8 + 24 + 4
ACK_BYTES = 14
# Longest message of one frame: the largest MSDU, 2304 bytes, with the LLC/SNAP header.
MESSAGE_BYTES = 2304 - 8

_MICROSECOND_NS = 1_000
_OFDM_SYMBOL_NS = 4 * _MICROSECOND_NS
_OFDM_SERVICE_BITS = 16
_OFDM_TAIL_BITS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Standard:
    """Timing of one physical layer."""

    name: str
    slot_ns: int
    sifs_ns: int  # short interframe space
    preamble_ns: int  # preamble and physical header, at the lowest rate
    cca_ns: int  # time from the start of a frame until a receiver has detected it
    cw_min: int  # contention window of the first attempt, slots
    cw_max: int
    bandwidth_hz: float
    basic_rates_mbps: tuple[float, ...]  # rates of acknowledgements
    # Signal over noise and interference at which 37 % of frames of 1536 bytes arrive, dB, by rate.
    required_sinr_db: Mapping[float, float]

    @property
    def difs_ns(self) -> int:
        """Idle time before backoff counts (distributed interframe space), ns: SIFS + 2 slots."""
        return self.sifs_ns + 2 * self.slot_ns

    @property
    def rates_mbps(self) -> tuple[float, ...]:
        """Rates, Mb/s, in ascending order."""
        return tuple(sorted(self.required_sinr_db))

    def acknowledgement_rate_mbps(self, rate_mbps: float) -> float:
        """Return the highest basic rate that is not above the rate of the data, Mb/s."""
        return max(rate for rate in self.basic_rates_mbps if rate <= rate_mbps)

    def airtime_ns(self, frame_bytes: int, rate_mbps: float) -> int:
        """Return the duration of a frame on the air, ns; its bytes include all headers."""
        if self.name == "802.11b":
            return self.preamble_ns + _dsss_payload_ns(frame_bytes, rate_mbps)
        return self.preamble_ns + _ofdm_payload_ns(frame_bytes, rate_mbps)

    def message_airtime_ns(self, message_bytes: int, rate_mbps: float) -> int:
        """Return the duration of a data frame that carries a message, ns."""
        return self.airtime_ns(message_bytes + OVERHEAD_BYTES, rate_mbps)

    def acknowledgement_airtime_ns(self, rate_mbps: float) -> int:
        """Return the duration of the acknowledgement of data sent at a rate, ns."""
        return self.airtime_ns(ACK_BYTES, self.acknowledgement_rate_mbps(rate_mbps))

    @property
    def eifs_extra_ns(self) -> int:
        """Excess of EIFS over DIFS, ns: SIFS and an acknowledgement at the lowest basic rate."""
        return self.sifs_ns + self.airtime_ns(ACK_BYTES, min(self.basic_rates_mbps))


@cache
def _ofdm_payload_ns(frame_bytes: int, rate_mbps: float) -> int:
    """Return the duration of the OFDM symbols of a frame, ns."""
    bits = _OFDM_SERVICE_BITS + 8 * frame_bytes + _OFDM_TAIL_BITS
    bits_per_symbol = round(rate_mbps * 4)  # a symbol takes 4 us
    symbols = -(-bits // bits_per_symbol)
    return symbols * _OFDM_SYMBOL_NS


@cache
def _dsss_payload_ns(frame_bytes: int, rate_mbps: float) -> int:
    """Return the duration of the payload of a DSSS or CCK frame, ns, in whole microseconds."""
    return math.ceil(8 * frame_bytes / rate_mbps) * _MICROSECOND_NS


OFDM = Standard(
    name="802.11a",
    slot_ns=9 * _MICROSECOND_NS,
    sifs_ns=16 * _MICROSECOND_NS,
    preamble_ns=20 * _MICROSECOND_NS,
    cca_ns=4 * _MICROSECOND_NS,
    cw_min=15,
    cw_max=1023,
    bandwidth_hz=20e6,
    basic_rates_mbps=(6.0, 12.0, 24.0),
    required_sinr_db={
        6.0: 0.2,
        9.0: 2.1,
        12.0: 3.2,
        18.0: 5.7,
        24.0: 8.8,
        36.0: 11.9,
        48.0: 16.1,
        54.0: 17.4,
    },
)
DSSS = Standard(
    name="802.11b",
    slot_ns=20 * _MICROSECOND_NS,
    sifs_ns=10 * _MICROSECOND_NS,
    preamble_ns=192 * _MICROSECOND_NS,  # long preamble
    cca_ns=4 * _MICROSECOND_NS,
    cw_min=31,
    cw_max=1023,
    bandwidth_hz=22e6,
    basic_rates_mbps=(1.0, 2.0),
    required_sinr_db={1.0: -4.4, 2.0: 0.2, 5.5: 2.8, 11.0: 5.8},
)
STANDARDS: Mapping[str, Standard] = {standard.name: standard for standard in (OFDM, DSSS)}
