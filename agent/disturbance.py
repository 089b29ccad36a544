"""Estimate of constant forces from outside: what the model did not foresee of the velocities, filtered.

A payload heavier than the controller knows and wind look alike to it: as a force on the payload. Wind pushes the
UAVs as well; sideways that shows in their own motion, and is taken to be the same for all of them. What pushes them
up or down cannot be told from what pushes the payload, to which stiff rods hand it on, and is counted there. The
forces enter the prediction, so that what is left to explain vanishes once they are right (the disturbance model of
offset-free MPC: Pannocchia, Rawlings 2003; Maeder, Borrelli, Morari 2009).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Model

# Unknowns: the force on the payload (3), and the horizontal force on each UAV (2).
_UNKNOWNS = 5


class DisturbanceEstimator:
    """The estimate of one agent.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        owned: UAVs whose motion the agent measures, 0-based.
        period_s: Sampling period, s.
        time_constant_s: Of the first-order low-pass filter, s.

    Attributes:
        forces: The estimate, (3 + 3 N,), inertial frame, N; zero at first.
    """

    def __init__(
        self, model: Model, hover: Hover, owned: Sequence[int], period_s: float, time_constant_s: float
    ) -> None:
        self._period_s, self._time_constant_s = period_s, time_constant_s
        self.forces: Array = np.zeros(3 + 3 * model.system.N)
        self.rebuild(model, hover, owned)

    def rebuild(self, model: Model, hover: Hover, owned: Sequence[int]) -> None:
        """Go on with another model of the team, and the forces found so far.

        Args:
            model: The system as the controller knows it now.
            hover: Its equilibrium.
            owned: UAVs whose motion the agent measures, 0-based, at least one.
        """
        self._model, self._bodies, period_s = model, [1 + uav for uav in owned], self._period_s
        N = model.system.N
        spread = np.vstack([np.eye(3, _UNKNOWNS), np.tile(np.eye(3, _UNKNOWNS, k=3), (N, 1))])
        linear = model.linearise(hover.x, hover.u)
        # At rest, velocities follow the state as positions follow what they are the derivative of.
        velocities = np.vstack([linear.A_c[state.R0], linear.C[: 3 * N] @ linear.A_c]).reshape(1 + N, 3, -1)
        # The hold that turns inputs into states turns constant forces into them as well.
        effect = zero_order_hold(replace(linear, B_c=model.force_effect(hover.x, hover.u) @ spread), period_s).B
        self._cause = np.linalg.inv(self._seen(velocities @ effect))
        self._gain = (1.0 - math.exp(-period_s / self._time_constant_s)) * spread
        self._weight = model.system.total_mass * model.system.gravity

    def learn(self, predicted: Array, measured: Array) -> None:
        """Take in the state after a period for which this estimate was part of the prediction.

        What would take a force larger than the weight of the whole team was no force, but a wrong prediction.

        Args:
            predicted: State at the end of the period, (n,).
            measured: The same with what was measured in its place, (n,).
        Source: docs/equations.md (41).
        """
        missed = self._model.velocities(measured) - self._model.velocities(predicted)
        cause = self._cause @ self._seen(missed)
        if np.abs(cause).max() <= self._weight:
            self.forces = self.forces + self._gain @ cause

    def _seen(self, velocities: Array) -> Array:
        """Of the velocities of payload and UAVs, what is explained by a force: the payload's, sideways the own UAVs'.

        Args:
            velocities: (1 + N, 3, ...), inertial frame.
        Returns: (5, ...).
        """
        return np.concatenate([velocities[0], velocities[self._bodies, :2].mean(axis=0)])
