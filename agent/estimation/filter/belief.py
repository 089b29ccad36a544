"""Belief of a Kalman filter at a tick: an estimate of the team and the covariance of its error."""

from dataclasses import dataclass
from typing import Protocol

from transport.agent.estimation.filter.manifold import Basis
from transport.agent.estimation.filter.model_error_level import Level
from transport.model.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Covariance:
    """Covariance of the error of an estimate."""

    # (r, r), of the coordinates of the state, of the actual inputs with motor lag, and of the
    # unknown forces.
    P: Array
    basis: Basis  # these coordinates, without the forces, about the state before its correction
    # Squared innovation of the last measurements in units of its covariance (NIS), their number.
    squared_error: float = 0.0
    measurements: int = 0


class Postponed(Protocol):
    """A covariance that is computed when it is asked for."""

    @property
    def value(self) -> Covariance:
        """Return the covariance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedGain:
    """Gain of own measurements alone, from the last correction that had more."""

    gain: Array  # from innovations to state and unknown forces, (n + 7, 15 owned)
    ticks: int  # since that correction


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """Estimate at a tick and the covariance of its error."""

    x: Array  # state, (n,); with motor lag [x, a], (n + m,)
    unknowns: Array  # unknown forces, (7,), see `forces`; none where they are not estimated
    u: Array  # inputs until the tick, (m,)
    level: Level  # of the model's errors
    source: Covariance | Postponed
    saved: SavedGain | None = None  # of `gain_reuse` alone

    @property
    def covariance(self) -> Covariance:
        """Covariance of the error."""
        source = self.source
        return source if isinstance(source, Covariance) else source.value
