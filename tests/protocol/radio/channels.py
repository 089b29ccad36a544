"""Channels of the tests: powers by what stations hear of each other, and runs over one window."""

from collections.abc import Iterable, Sequence
from typing import Any

from transport.protocol.radio.channel_settings_and_state import (
    ChannelCounts,
    ChannelParameters,
    ChannelState,
)
from transport.protocol.radio.frames import Frame, FrameOutcome
from transport.protocol.radio.medium_access_and_retries import Channel
from transport.protocol.radio.standards_80211 import OFDM

MS = 1_000_000
NOISE_MW = 1e-9
NEAR_MW = 1e-4  # 50 dB above the noise
SILENT_MW = 0.0


def parameters(**changes: Any) -> ChannelParameters:
    """Return an 802.11a broadcast channel at 6 Mb/s that is sensed 10 dB above the noise."""
    given: dict[str, Any] = {
        "standard": OFDM,
        "rate_mbps": 6.0,
        "noise_mw": NOISE_MW,
        "sensitivity_mw": 10.0 * NOISE_MW,
        "carrier_sense_mw": 10.0 * NOISE_MW,
        "seed": 1,
    }
    return ChannelParameters(**{**given, **changes})


def equal_powers(stations: int, power_mw: float = NEAR_MW) -> list[list[float]]:
    """Return powers of stations that all hear each other equally well."""
    return [[power_mw] * stations for _ in range(stations)]


def broadcast(
    stations: int, sender: int, sent_ns: int, sequence: int = 0, message_bytes: int = 1500
) -> Frame:
    """Return a frame for all other stations."""
    others = tuple(station for station in range(stations) if station != sender)
    return Frame(sent_ns, sender, sequence, message_bytes, others)


def run(
    given: ChannelParameters,
    powers: Sequence[Sequence[float]],
    frames: Iterable[Frame],
    until_ns: int,
) -> tuple[list[FrameOutcome], ChannelCounts]:
    """Return outcomes and counts of one window on a channel that was idle."""
    idle = ChannelState.idle(len(powers), given.standard)
    _, outcomes, counts = Channel(given).advance(idle, powers, frames, until_ns)
    return outcomes, counts
