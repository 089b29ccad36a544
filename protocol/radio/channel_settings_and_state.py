"""What a channel is: its settings, the thresholds that follow, its events, and its state between windows."""

from dataclasses import dataclass
from typing import NamedTuple

from transport.protocol.radio.frames import Frame, Transmission
from transport.protocol.radio.reception import CERTAIN_MARGIN
from transport.protocol.radio.standards_80211 import Standard
from transport.protocol.radio.station_queue import Station

# Kinds of events, in their order within an instant.
END, DETECT, TIMEOUT, ACKNOWLEDGE, SEND, ATTEMPT = range(6)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelParameters:
    """Settings of the channel. Powers in mW, ratios of powers without unit."""

    standard: Standard
    rate_mbps: float
    unicast: bool = False
    queue_length: int = 10  # frames of one station, with the one on the air
    attempts: int = 7  # most transmissions of a unicast frame
    noise_mw: float
    sensitivity_mw: float  # a weaker preamble is not detected
    carrier_sense_mw: float  # total power from which the medium is busy without a detected preamble
    # Signal over noise and interference that detection needs, 4 dB.
    preamble_ratio: float = 2.5118864315095797
    interrupted_wait_draws: bool = True  # docs/record/radio.md, frames at an idle medium
    seed: int = 0

    def required_ratio(self, rate_mbps: float) -> float:
        """Return the ratio of signal over noise and interference that a rate requires."""
        return float(10.0 ** (self.standard.required_sinr_db[rate_mbps] / 10.0))

    def thresholds(self) -> "Thresholds":
        """Return the ratios and powers that decide receptions; they are the same in all windows."""
        acknowledgement_mbps = self.standard.acknowledgement_rate_mbps(self.rate_mbps)
        ratio = self.required_ratio(self.rate_mbps)
        acknowledgement_ratio = self.required_ratio(acknowledgement_mbps)
        highest_ratio = max(ratio, acknowledgement_ratio)
        return Thresholds(
            ratio=ratio,
            acknowledgement_ratio=acknowledgement_ratio,
            detected_mw=max(self.sensitivity_mw, self.preamble_ratio * self.noise_mw),
            certain_mw=CERTAIN_MARGIN * highest_ratio * self.noise_mw,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Thresholds:
    """Ratios of signal over noise and interference, and powers on an idle channel, mW."""

    ratio: float  # required by data
    acknowledgement_ratio: float  # required by acknowledgements
    detected_mw: float  # from which a preamble is detected
    certain_mw: float  # from which a payload is certainly decoded


class Event(NamedTuple):
    """Something that happens at an instant; those of one instant in the order of these fields."""

    time_ns: int
    kind: int
    station: int
    # Of the frame sent, of the attempt that times out, or the station to acknowledge.
    number: int = 0
    frame: Frame | None = None


@dataclass(slots=True)
class ChannelCounts:
    """What happened in a window of time."""

    transmissions: int = 0  # of data frames
    repetitions: int = 0  # those after the first of a unicast frame
    acknowledgements: int = 0
    busy_ns: int = 0  # time in which at least one station transmits


@dataclass(frozen=True, slots=True)
class ChannelState:
    """Queues, backoffs and transmissions in progress, carried from one window to the next."""

    stations: tuple[Station, ...]
    air: tuple[Transmission, ...] = ()
    events: tuple[Event, ...] = ()
    time_ns: int = 0

    @classmethod
    def idle(cls, stations: int, standard: Standard) -> "ChannelState":
        """Return the state of a channel that has been idle."""
        return cls(tuple([Station.idle(number, standard) for number in range(stations)]))
