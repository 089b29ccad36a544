"""Traffic of others on the channel: one more station, which all stations of the team hear."""

from dataclasses import dataclass

from transport.protocol.radio.frames import Frame
from transport.protocol.radio.propagation import Powers
from transport.protocol.radio.radio_random_numbers import exponential
from transport.protocol.radio.standards_80211 import Standard


@dataclass(frozen=True, slots=True)
class BackgroundState:
    """The next frame of others: its number and its instant, ns."""

    number: int = 0
    next_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """Frames of others that arrive at random (Poisson) and offer a share of the airtime.

    The station contends as all others do, so the carried share is smaller on a full channel.
    """

    share: float  # of the airtime, 0 to 1
    station: int  # number of the station: behind those of the team
    power_mw: float  # at each station of the team, and of each station of the team at this one
    message_bytes: int = 1500
    seed: int = 0

    def frames(
        self, state: BackgroundState, standard: Standard, rate_mbps: float, until_ns: int
    ) -> tuple[list[Frame], BackgroundState]:
        """Return the frames before an instant, and the state from there on."""
        if self.share == 0.0:
            return [], state
        mean_ns = standard.message_airtime_ns(self.message_bytes, rate_mbps) / self.share
        number = state.number
        next_ns = state.next_ns
        frames = []
        while next_ns < until_ns:
            frames.append(Frame(next_ns, self.station, number, self.message_bytes, ()))
            number += 1
            next_ns += round(mean_ns * exponential(self.seed, self.station, "background", number))
        return frames, BackgroundState(number, next_ns)

    def heard(self, powers: Powers) -> Powers:
        """Return the powers of the team with those of this station behind them, if it sends."""
        if self.share == 0.0:
            return powers
        team = [(*row, self.power_mw) for row in powers]
        return [*team, (self.power_mw,) * (len(powers) + 1)]
