"""Instants at which the UAVs send: the time of computation, and offsets that keep the sends apart.

The time of computation is a random number, not a measurement: the speed of the host plays no role.
"""

from dataclasses import dataclass, field
from typing import Literal

from transport.protocol.radio.radio_random_numbers import normal, uniform

Offsets = Literal["none", "slots", "random"]

_SLOTS_AFTER_DEVIATIONS = 3.0  # slots begin when all but 0.1 % of the computations have ended


@dataclass(frozen=True, slots=True, kw_only=True)
class SendTimes:
    """Instants of the sends of a team within each sampling period.

    A period has `exchanges` exchanges of equal length: one, or one for each iteration of the
    negotiation. In each, a station sends when its computation has ended and its offset has passed:

    none: no offset; all stations send when they are ready.
    slots: a station waits for its own slot. Slots follow a time in which the computation of all
        stations ends, and share the rest of the exchange evenly. They need no messages. Where the
        slots of all stations do not fit into a period, they take turns: station i has its slot in
        the periods k with k = i (mod `cycle`).
    random: an offset that is uniform over the same rest, drawn for each exchange.
    """

    period_ns: int
    stations: int
    exchanges: int = 1
    offsets: Offsets = "slots"
    cycle: int = 1  # periods in which each station has one slot; 1 with several exchanges
    computation_mean_ns: int = 0
    computation_deviation_ns: int = 0
    seed: int = 0

    # Length of an exchange, and in it the time before its first slot and that which slots share.
    exchange_ns: int = field(init=False)
    allowance_ns: int = field(init=False)
    spread_ns: int = field(init=False)  # none if the computation takes the whole exchange
    slots: int = field(init=False)  # of an exchange: those of the stations whose turn it is

    def __post_init__(self) -> None:
        """Compute what all sends have in common."""
        exchange_ns = self.period_ns // self.exchanges
        deviations_ns = round(_SLOTS_AFTER_DEVIATIONS * self.computation_deviation_ns)
        allowance_ns = self.computation_mean_ns + deviations_ns

        object.__setattr__(self, "exchange_ns", exchange_ns)
        object.__setattr__(self, "allowance_ns", allowance_ns)
        object.__setattr__(self, "spread_ns", max(exchange_ns - allowance_ns, 0))
        object.__setattr__(self, "slots", -(-self.stations // self.cycle))

    @property
    def slot_ns(self) -> int:
        """Length of a slot, ns."""
        return self.spread_ns // self.slots

    def turn(self, station: int, tick: int) -> int:
        """Return the tick of the next period, from one on, in which a station has its slot."""
        return tick + (station - tick) % self.cycle

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
            place = station // self.cycle
            return self.allowance_ns + place * self.spread_ns // self.slots
        number = tick * self.exchanges + exchange
        return self.allowance_ns + int(
            self.spread_ns * uniform(self.seed, station, "offset", number)
        )

    def instant_ns(self, station: int, tick: int, exchange: int = 0) -> int:
        """Return the instant at which a station sends what it computes at a tick, ns of the run."""
        begin_ns = exchange * self.exchange_ns
        ready_ns = tick * self.period_ns + begin_ns + self.computed_ns(station, tick, exchange)

        turn = self.turn(station, tick)
        earliest_ns = turn * self.period_ns + begin_ns + self.offset_ns(station, turn, exchange)
        return max(ready_ns, earliest_ns)
