"""Motion of the team by the model, through failures of UAVs; the reference where that diverges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from transport.model import state
from transport.model.arrays import Array, within
from transport.model.linear import motor_lag as motors
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import Hover

# Integration steps per sampling period: local error below 1e-8 at 50 ms, with motor lag below 1e-5
# after large jumps of the commands; far below any sensor.
STEPS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """Failure of UAVs: another system from a tick on."""

    tick: int
    model: Model  # equations of motion from then on
    hover: Hover  # of the team from then on
    moved: Callable[[Array], Array]  # state at the tick, (n,) or (n + m,), after the failure
    own_left: Sequence[int]  # UAVs of the agent, 0-based, that have not failed


@dataclass(slots=True, kw_only=True)
class PredictedMotion:
    """Prediction of the state over a sampling period; docs/equations.md (13b), (53)."""

    model: Model  # equations of motion before any failure
    reference: Callable[[int], Array]  # state to assume at a tick, (n,), with motor lag (n + m,)
    period_s: float
    steps: int = STEPS  # integration steps per period
    lag_s: float = 0.0  # of the motors
    failures: list[Failure] = field(default_factory=list)  # ascending in the tick

    def add(self, failure: Failure) -> None:
        """Change the system at a tick, not before the previous change."""
        self.failures.append(failure)

    def model_at(self, tick: int) -> Model:
        """Return the equations of motion from a tick on."""
        model = self.model
        for failure in self.failures:
            if failure.tick <= tick:
                model = failure.model
        return model

    def predict(self, x: Array, tick: int, u: Array, forces: Array | None) -> Array:
        """Return the state one period after `tick`; the reference if that diverges."""
        model = self.model_at(tick)
        period = motors.Period(duration_s=self.period_s, steps=self.steps, lag_s=self.lag_s)
        end = motors.integrate(model, x, u, period, forces)
        if not within(end, state.LARGEST):
            return self.reference_at(tick + 1)
        return self.moved(end, tick + 1)

    def moved(self, x: Array, tick: int) -> Array:
        """Return a state at a tick after the failures of that tick."""
        for failure in self.failures:
            if failure.tick == tick:
                x = failure.moved(x)
        return x

    def set_entries(self, x: Array, tick: int) -> list[np.ndarray]:
        """Return the entries of a state at a tick that each failure of that tick has set."""
        failures = [failure for failure in self.failures if failure.tick == tick]
        if not failures:
            return []
        shifted = x + 1.0  # entries that a failure sets do not stay where they are moved to
        return [np.flatnonzero(failure.moved(shifted) != shifted) for failure in failures]

    def reference_at(self, tick: int) -> Array:
        """Return the reference state at a tick, after the failures until then."""
        x = self.reference(tick)
        for failure in self.failures:
            if failure.tick <= tick:
                x = failure.moved(x)
        return x
