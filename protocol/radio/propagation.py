"""Received power: log-distance path loss with shadowing, and thermal noise."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from transport.protocol.radio.radio_random_numbers import normal

_BOLTZMANN = 1.380649e-23  # J/K
_TEMPERATURE_K = 290.0
_NEAREST_M = 1.0  # the reference distance: path loss does not fall below its loss there

Positions = Sequence[Sequence[float]]
Powers = Sequence[Sequence[float]]


class PowersWhenNeeded(Sequence[Sequence[float]]):
    """Powers that are computed when the first of them is read."""

    def __init__(self, compute: Callable[[], Powers], stations: int) -> None:
        self._compute = compute
        self._stations = stations
        self._powers: Powers | None = None

    def __getitem__(self, place: Any) -> Any:
        """Return the powers of a sender at each station, mW."""
        if self._powers is None:
            self._powers = self._compute()
        return self._powers[place]

    def __len__(self) -> int:
        """Return the number of stations."""
        return self._stations


def milliwatts(dbm: float) -> float:
    """Return a power given in dBm, mW."""
    return float(10.0 ** (dbm / 10.0))


def ratio(decibels: float) -> float:
    """Return a ratio of powers given in dB."""
    return float(10.0 ** (decibels / 10.0))


def noise_mw(bandwidth_hz: float, figure_db: float) -> float:
    """Return thermal noise at a receiver with a noise figure, mW: k T B F."""
    return 1e3 * _BOLTZMANN * _TEMPERATURE_K * bandwidth_hz * ratio(figure_db)


@dataclass(frozen=True, slots=True, kw_only=True)
class Propagation:
    """Log-distance path loss: L = L_1 + 10 n log10(d / 1 m) + X, X constant for each pair."""

    power_mw: float
    exponent: float = 3.0
    reference_loss_db: float = 46.6777  # free space, 1 m, 5.15 GHz
    shadowing_db: float = 0.0  # standard deviation of X
    seed: int = 0

    def shadowing(self, first: int, second: int) -> float:
        """Return the shadowing of a pair of stations, dB, the same in both directions."""
        if self.shadowing_db == 0.0:
            return 0.0
        low, high = sorted((first, second))
        return self.shadowing_db * normal(self.seed, low, "shadowing", high)

    def at_reference(self, stations: int) -> Powers:
        """Return the power of each sender at each station at a distance of 1 m, mW."""
        return [
            [
                self.power_mw / ratio(self.reference_loss_db + self.shadowing(i, j))
                for j in range(stations)
            ]
            for i in range(stations)
        ]

    def power_mw_at(self, reference_mw: float, squared_m2: float) -> float:
        """Return the power at the square of a distance, m2, from that at 1 m, mW."""
        squared_m2 = max(squared_m2, _NEAREST_M * _NEAREST_M)
        return reference_mw * math.pow(squared_m2, -0.5 * self.exponent)

    def powers(self, at_reference: Powers, positions_m: Positions) -> Powers:
        """Return the power of each sender (row) at each station (column), mW.

        Args:
            at_reference: Power at 1 m, mW, (N, N).
            positions_m: Positions, m, (N, 3).
        """
        powers: list[list[float]] = [[0.0] * len(positions_m) for _ in positions_m]
        for i, (x, y, z) in enumerate(positions_m):
            reference = at_reference[i]
            row = powers[i]
            for j in range(i):
                other = positions_m[j]
                dx = x - other[0]
                dy = y - other[1]
                dz = z - other[2]
                power = self.power_mw_at(reference[j], dx * dx + dy * dy + dz * dz)
                row[j] = power
                powers[j][i] = power
        return powers
