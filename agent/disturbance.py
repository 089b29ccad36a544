"""Estimate of constant external forces from prediction errors of the velocities."""

import math
from collections.abc import Sequence

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Linearisation, Model

# Unknowns: the force on the payload (3), and the horizontal force on each UAV (2).
_UNKNOWNS = 5


class DisturbanceEstimator:
    """Estimate of constant external forces by an agent that measures its UAVs, 0-based: a low-pass filter of errors.

    Unmodelled payload mass and wind both act as a force on the payload. Wind acts on the UAVs, too: its horizontal
    force shows in their own motion and is assumed equal for all of them. A vertical force on a UAV passes through the
    stiff rod and is counted as one on the payload. The `forces`, (3 + 3 N,), inertial frame, N, zero at first, enter
    the prediction, so that its error vanishes once they are right (offset-free MPC: Pannocchia, Rawlings 2003).
    """

    def __init__(
        self, model: Model, hover: Hover, owned: Sequence[int], period_s: float, time_constant_s: float
    ) -> None:
        self._period_s, self._time_constant_s = period_s, time_constant_s
        self.forces: Array = np.zeros(3 + 3 * model.system.N)
        self.rebuild(model, hover, owned)

    def rebuild(self, model: Model, hover: Hover, owned: Sequence[int]) -> None:
        """Take another model of the team, its hover and at least one owned UAV; keep the estimated forces."""
        self._model, self._bodies, period_s = model, [1 + uav for uav in owned], self._period_s
        N = model.system.N
        spread = np.vstack([np.eye(3, _UNKNOWNS), np.tile(np.eye(3, _UNKNOWNS, k=3), (N, 1))])
        linear = model.linearise(hover.x, hover.u)
        # At rest, velocities depend on the state as the positions' derivatives do.
        velocities = np.vstack([linear.A_c[state.R0], linear.C[: 3 * N] @ linear.A_c]).reshape(1 + N, 3, -1)
        # The zero-order hold of inputs applies to constant forces as well.
        E = model.force_effect(hover.x, hover.u) @ spread
        effect = zero_order_hold(Linearisation.of(linear.f, linear.A_c, E, linear.y, linear.C), period_s).B
        self._inverse = np.linalg.inv(self._observed(velocities @ effect))
        self._gain = (1.0 - math.exp(-period_s / self._time_constant_s)) * spread
        self._weight = model.system.total_mass * model.system.gravity

    def learn(self, predicted: Array, measured: Array) -> None:
        """Correct the estimate by the prediction error of a period.

        Given are the state at its end predicted with the estimate, (n,), and the same with the measured entries
        replaced. An error that implies a force above the team's weight is ignored: the prediction was wrong.

        Source: docs/equations.md (41).
        """
        error = self._model.velocities(measured) - self._model.velocities(predicted)
        force = self._inverse @ self._observed(error)
        if np.abs(force).max() <= self._weight:
            self.forces = self.forces + self._gain @ force

    def _observed(self, velocities: Array) -> Array:
        """Return the payload's velocity and the own UAVs' mean horizontal velocity, (5, ...).

        Given are those of all bodies, (1 + N, 3, ...), inertial frame.
        """
        return np.concatenate([velocities[0], velocities[self._bodies, :2].mean(axis=0)])
