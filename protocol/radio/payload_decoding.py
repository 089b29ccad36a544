"""Which stations detect a transmission, and decode its payload, in one window of time."""

from transport.protocol.radio.channel_settings_and_state import ChannelParameters, Thresholds
from transport.protocol.radio.frames import Powers, Transmission, at_least, members
from transport.protocol.radio.radio_random_numbers import uniform
from transport.protocol.radio.reception import Interference, Signal, success


class Decoding:
    """Receptions with the powers of a window; sets of stations are integers with a bit for each.

    Attributes:
        detecting: By sender, the stations that detect its preamble on an idle channel.
    """

    def __init__(
        self,
        parameters: ChannelParameters,
        thresholds: Thresholds,
        powers: Powers,
        stations: int,
        *,
        near: bool,
    ) -> None:
        self._thresholds = thresholds
        self._powers = powers
        self._seed = parameters.seed
        self._noise_mw = parameters.noise_mw

        # By sender, the stations that certainly decode its payload on an idle channel.
        everyone = (1 << stations) - 1
        others = [everyone & ~(1 << number) for number in range(stations)]
        self.detecting = self._certain = others
        if not near:
            self.detecting = [at_least(thresholds.detected_mw, row) for row in powers]
            self._certain = [at_least(thresholds.certain_mw, row) for row in powers]

    def decoded(self, transmission: Transmission) -> int:
        """Return the stations locked to a transmission that decode its payload."""
        uncertain = transmission.locked
        if not transmission.overlaps:
            uncertain &= ~self._certain[transmission.sender]
        decoded = transmission.locked & ~uncertain
        for number in members(uncertain):
            if self._draw(transmission, number) < self._success(transmission, number):
                decoded |= 1 << number
        return decoded

    def is_weak(self, transmission: Transmission, number: int) -> bool:
        """Return whether a lost transmission would have been lost on an idle channel as well."""
        station = 1 << number
        if not self.detecting[transmission.sender] & station:
            return True
        if self._certain[transmission.sender] & station:
            return False
        success_alone = self._success(transmission, number, alone=True)
        return self._draw(transmission, number) >= success_alone

    def _draw(self, transmission: Transmission, number: int) -> float:
        """Return the random number of a transmission at a receiver; no other one changes it."""
        return uniform(self._seed, transmission.sender, f"payload at {number}", transmission.number)

    def _success(self, transmission: Transmission, number: int, *, alone: bool = False) -> float:
        """Return the probability that a locked station decodes the payload."""
        is_data = transmission.acknowledged < 0
        thresholds = self._thresholds
        ratio = thresholds.ratio if is_data else thresholds.acknowledgement_ratio
        signal = Signal(
            transmission.start_ns,
            transmission.end_ns,
            transmission.frame_bytes,
            self._powers[transmission.sender][number],
            ratio * self._noise_mw,
            ratio,
        )
        interference = [
            Interference(other.start_ns, other.end_ns, self._powers[other.sender][number])
            for other in transmission.overlaps
            if not alone
        ]
        return success(signal, interference)
