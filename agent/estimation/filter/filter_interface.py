"""Interface of a Kalman filter of the team: beliefs through sampling periods and measurements."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.agent.estimation.filter.belief import Belief
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model


@dataclass(frozen=True, kw_only=True)
class FilterPeriod:
    """A sampling period of the team, as it is understood when its end is predicted."""

    model: Model  # equations of motion
    end: Array  # state predicted at its end, (n,), with motor lag (n + m,)
    u: Array  # commanded inputs, (m,)
    # Forces estimated at its beginning, as `Model` takes them; None if they are not estimated.
    forces: Array | None
    unannounced: Unannounced  # which of them follow the control law or the fail-safe
    # Derivative of these inputs by the state, (m, n), with motor lag (m, n + m); None if all
    # inputs have been told.
    K: Array | None
    correlation: float  # c, of the errors of the other agents' estimates with the own ones
    # Where information about the others is overdue: how much they act alone, and c by input; else None.
    silent: Silent | None = None

    @cached_property
    def alone(self) -> float:
        """Mean share of the law alone in the unannounced inputs, 0 to 1."""
        by_law = self.unannounced.by_law
        if self.silent is None or not by_law.any():
            return 0.0
        return float(self.silent.alone[by_law].mean())

    @property
    def is_alone(self) -> bool:
        """Return whether an unannounced input is partly that of a UAV alone."""
        return self.alone > 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensed:
    """Measurements of some sensors of a UAV."""

    uav: int  # 0-based
    sensors: tuple[int, ...]  # 0 position, 1 velocity, 2 attitude, 3 body rates, 4 specific force
    values: Array  # of all its sensors, (15,), SI; those of other sensors are ignored


class Filter(Protocol):
    """Kalman filter of the team: a pure function from belief to belief."""

    def first(self, x: Array) -> Belief:
        """Return the belief without any measurement, about a state."""

    def predict(self, belief: Belief, period: FilterPeriod) -> Belief:
        """Return the belief at the end of a sampling period."""

    def correct(self, belief: Belief, model: Model, sensed: Sequence[Sensed]) -> Belief:
        """Return the belief with measurements of its tick."""

    def certain(self, belief: Belief, entries: npt.NDArray[np.intp]) -> Belief:
        """Return the belief with some entries of the state certain."""

    def forces(self, belief: Belief) -> Array | None:
        """Return the estimated forces and mass error; None where they are not estimated."""

    def is_plausible(self, belief: Belief) -> bool:
        """Return whether a belief can be that of a team in flight."""
