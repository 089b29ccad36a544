"""Estimate of constant external forces from measured states, by filtered prediction errors.

Unmodelled payload mass and wind both act as a force on the payload. Wind acts on the UAVs, too: its
horizontal force shows in their own motion and is assumed equal for all of them. A vertical force on
a UAV passes through the stiff rod and is counted as one on the payload. The estimate enters the
prediction, so that its error vanishes once it is right (offset-free MPC: Pannocchia and Rawlings
2003).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.discretisation import zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.physics.hover import Hover

# Unknowns: the force on the payload (3), and the horizontal force on each UAV (2).
UNKNOWNS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredTeam:
    """A team as an agent measures it."""

    model: Model
    hover: Hover
    owned: Sequence[int]  # measured UAVs, 0-based, at least one


class DisturbanceEstimator:
    """Estimate of an agent that measures the payload and its own UAVs.

    Attributes:
        forces: Estimated forces on payload and UAVs, (3 + 3 N,), inertial frame, N, zero at first.
    """

    def __init__(self, team: MeasuredTeam, period_s: float, time_constant_s: float) -> None:
        self._period_s = period_s
        self._time_constant_s = time_constant_s
        self.forces: Array = np.zeros(3 + 3 * team.model.system.N)
        self.rebuild(team)

    def rebuild(self, team: MeasuredTeam) -> None:
        """Estimate for another team; keep the estimated forces."""
        system = team.model.system
        self._model = team.model
        self._bodies = [1 + uav for uav in team.owned]
        self._weight_N = system.total_mass * system.gravity

        # L: forces on all bodies from the unknowns.
        on_payload = np.eye(3, UNKNOWNS)
        on_uav = np.eye(3, UNKNOWNS, k=3)
        L = np.vstack([on_payload, np.tile(on_uav, (system.N, 1))])

        #   G = d eta/dx Phi E L    at hover, (41)
        velocities = self._observed(self._force_response(team, L))
        self._G_inverse = np.linalg.inv(velocities)

        #   (1 - exp(-T_s / tau)) L
        self._gain = (1.0 - math.exp(-self._period_s / self._time_constant_s)) * L

    def _force_response(self, team: MeasuredTeam, L: Array) -> Array:
        """Return velocities of all bodies per unknown after a sampling period, (1 + N, 3, 5)."""
        model = team.model
        N = model.system.N
        linear = model.linearise(team.hover.x, team.hover.u)

        # At rest, velocities depend on the state as the positions' derivatives do.
        by_state = np.vstack([linear.A_c[state.R0], linear.C[: 3 * N] @ linear.A_c])
        velocities = by_state.reshape(1 + N, 3, -1)

        # The zero-order hold of inputs applies to constant forces as well.
        E = model.force_effect(team.hover.x, team.hover.u) @ L
        with_forces = Linearisation.of(linear.f, linear.A_c, E, linear.y, linear.C)
        effect = zero_order_hold(with_forces, self._period_s).B
        response: Array = velocities @ effect
        return response

    def learn(self, predicted: Array, measured: Array) -> None:
        """Correct the estimate by the prediction error of a period.

        Given are the state at its end predicted with the estimate, (n,), and the same with the
        measured entries replaced. An error that implies a force above the team's weight is ignored:
        the prediction was wrong.

        Source: docs/equations.md (41).
        """
        # The force that explains the error: G^-1 (eta - eta_pred).
        error = self._model.velocities(measured) - self._model.velocities(predicted)
        force = self._G_inverse @ self._observed(error)

        if np.abs(force).max() <= self._weight_N:
            self.forces = self.forces + self._gain @ force

    def _observed(self, velocities: Array) -> Array:
        """Return eta, (5, ...): velocity of the payload, and the own UAVs' mean horizontal one.

        Given are the velocities of all bodies, (1 + N, 3, ...).
        """
        mean = velocities[self._bodies, :2].mean(axis=0)
        return np.concatenate([velocities[0], mean])
