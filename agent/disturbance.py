"""Estimate of a constant force on the payload: what the model did not foresee of its velocity, filtered.

A payload heavier than the controller knows and wind look alike to it: as a force from outside. The force enters
the prediction, so that what is left to explain vanishes once it is right (the disturbance model of offset-free MPC:
Pannocchia, Rawlings 2003; Maeder, Borrelli, Morari 2009).
"""

import math
from dataclasses import replace

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Model, payload_force
from model.rotations import rotation


class PayloadForce:
    """The estimate of one agent.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        period_s: Sampling period, s.
        time_constant_s: Of the first-order low-pass filter, s.

    Attributes:
        force_I: The estimate, (3,), inertial frame, N; zero at first.
    """

    def __init__(self, model: Model, hover: Hover, period_s: float, time_constant_s: float) -> None:
        linear = model.linearise(hover.x, hover.u)
        E = model.payload_force_effect(hover.x, hover.u)
        # The hold that turns inputs into states turns a constant force into them as well; the payload hangs level.
        effect = zero_order_hold(replace(linear, B_c=E), period_s).B[state.V0]
        self._gain = (1.0 - math.exp(-period_s / time_constant_s)) * np.linalg.inv(effect)
        self._N = model.system.N
        self.force_I: Array = np.zeros(3)

    @property
    def forces(self) -> Array:
        """For the model: the estimate on the payload and none on the UAVs, (3 + 3 N,), inertial frame, N."""
        return payload_force(self.force_I, self._N)

    def learn(self, predicted: Array, measured: Array) -> None:
        """Take in how the payload moves after a period for which this estimate was part of the prediction.

        Args:
            predicted: Payload states at the end of the period, (12,), SI.
            measured: The same as measured.
        Source: docs/equations.md (41).
        """
        self.force_I = self.force_I + self._gain @ (_velocity(measured) - _velocity(predicted))


def _velocity(payload: Array) -> Array:
    """Of the payload, (3,), inertial frame, m/s."""
    R_IP: Array = rotation(payload[state.THETA0])
    velocity: Array = R_IP @ payload[state.V0]
    return velocity
