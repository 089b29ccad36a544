"""Estimate of constant forces from outside: what the model did not foresee of the velocities, filtered.

A payload heavier than the controller knows and wind look alike to it: as a force on the payload. Wind pushes the
UAVs as well, sideways; that force is taken to be the same on all of them. What pushes the UAVs up or down cannot be
told from what pushes the payload, to which stiff rods hand it on, and is counted there. The forces enter the
prediction, so that what is left to explain vanishes once they are right (the disturbance model of offset-free MPC:
Pannocchia, Rawlings 2003; Maeder, Borrelli, Morari 2009).
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
from model.rotations import rotation
from model.state import StateView


class DisturbanceEstimator:
    """The estimate of one agent.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        owned: UAVs whose motion it sees, 0-based.
        period_s: Sampling period, s.
        time_constant_s: Of the first-order low-pass filter, s.

    Attributes:
        forces: The estimate, (3 + 3 N,), inertial frame, N; zero at first.
    """

    def __init__(
        self, model: Model, hover: Hover, owned: Sequence[int], period_s: float, time_constant_s: float
    ) -> None:
        self._model, self._owned = model, list(owned)
        N = model.system.N
        # Unknowns: the force on the payload, and sideways the one on every UAV.
        self._spread = np.vstack([np.eye(3, 5), np.tile(np.eye(3, 5, 3), (N, 1))])
        self._spread[5::3] = 0
        linear = model.linearise(hover.x, hover.u)
        E = model.force_effect(hover.x, hover.u) @ self._spread
        # The hold that turns inputs into states turns constant forces into them as well.
        effect = zero_order_hold(replace(linear, B_c=E), period_s).B
        per_period = self._velocity_changes(hover.x, effect)
        self._gain = (1.0 - math.exp(-period_s / time_constant_s)) * np.linalg.inv(per_period)
        self.forces: Array = np.zeros(3 + 3 * N)
