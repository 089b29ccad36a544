"""Instants at which the UAVs send: the time of computation, and offsets that keep the sends apart.

The time of computation is a random number, not a measurement: the speed of the host plays no role.
"""

from dataclasses import dataclass
from typing import Literal

from transport.protocol.radio.draws import normal, uniform

Offsets = Literal["none", "slots", "random"]

_SLOTS_AFTER_DEVIATIONS = 3.0  # slots begin when all but 0.1 % of the computations have ended


@dataclass(frozen=True, slots=True, kw_only=True)
class SendTimes:
    """Instants of the sends of a team within each sampling period.

    A period has `exchanges` exchanges of equal length: one, or one for each iteration of the
    negotiation. In each, a station sends when its computation has ended and its offset has passed:

    none: no offset; all stations send when they are ready.
    slots: station i of N waits for its own slot. Slots follow a time in which the computation of all
        stations ends, and share the rest of the exchange evenly. They need no messages.
    random: an offset that is uniform over the same rest, drawn for each exchange.
    """

    period_ns: int
    stations: int
    exchanges: int = 1
    offsets: Offsets = "slots"
    computation_mean_ns: int = 0
    computation_deviation_ns: int = 0
    seed: int = 0

    @property
    def exchange_ns(self) -> int:
        """Length of an exchange, ns."""
        return self.period_ns // self.exchanges

    @property
    def computation_allowance_ns(self) -> int:
        """Time from the start of an exchange to its first slot, ns."""
        return self.computation_mean_ns + round(
            _SLOTS_AFTER_DEVIATIONS * self.computation_deviation_ns
        )

    @property
    def spread_ns(self) -> int:
        """Time that the slots share, ns; none if the computation takes the whole exchange."""
        return max(self.exchange_ns - self.computation_allowance_ns, 0)

    def computed_ns(self, station: int, tick: int, exchange: int = 0) -> int:
        """Return the time of a computation, ns: normal, and never negative."""
        number = tick * self.exchanges + exchange
        deviation = self.computation_deviation_ns
        if deviation == 0:
            return self.computation_mean_ns
        return max(
            0,
            self.computation_mean_ns
            + round(deviation * normal(self.seed, station, "computation", number)),
        )

    def offset_ns(self, station: int, tick: int, exchange: int = 0) -> int:
        """Return the earliest send of a station after the start of an exchange, ns."""
        if self.offsets == "none":
            return 0
        if self.offsets == "slots":
            return self.computation_allowance_ns + station * self.spread_ns // self.stations
        number = tick * self.exchanges + exchange
        return self.computation_allowance_ns + int(
            self.spread_ns * uniform(self.seed, station, "offset", number)
        )

    def instant_ns(self, station: int, tick: int, exchange: int = 0) -> int:
        """Return the instant of a send, ns after the start of the run."""
        start_ns = tick * self.period_ns + exchange * self.exchange_ns
        ready_ns = self.computed_ns(station, tick, exchange)
        return start_ns + max(ready_ns, self.offset_ns(station, tick, exchange))
