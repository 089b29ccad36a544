"""Unknown external forces on the team: seven numbers, their forces on the bodies, their effect.

They are horizontal forces on the payload, its mass error, horizontal forces equal on all UAVs, and
the drag of payload and UAVs per speed: along a path, wind and drag are then constants.
"""

from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.rotations import cross, rotation

PAYLOAD_FORCE = slice(0, 2)  # horizontal, inertial frame, N
MASS_ERROR = 2  # of the payload, kg
UAV_FORCE = slice(3, 5)  # horizontal, on each UAV, inertial frame, N
DRAG = slice(5, 7)  # of the payload and of each UAV, kg/s
COUNT = 7

# A mass error leaves at least a tenth of the payload.
MOST_MISSING = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """A state of the team, its inputs, and the forces estimated there."""

    model: Model  # equations of motion there
    x: Array  # (n,)
    actual: Array  # actual inputs, (m,)
    forces: Array | None  # as `Model` takes them, with the mass error; None if not estimated


class UnknownForces:
    """The unknown forces on the bodies of a team; docs/equations.md (63a)."""

    def __init__(self, model: Model) -> None:
        N = model.system.N
        self._model = model
        self._least_kg = -MOST_MISSING * model.system.payload.mass

        # Forces of all bodies, inertial frame, and the mass error, from the unknowns; drag depends
        # on the velocities unless the model has it.
        self._spread = np.zeros((4 + 3 * N, COUNT))
        self._spread[:2, PAYLOAD_FORCE] = np.eye(2)
        self._spread[-1, MASS_ERROR] = 1.0
        self._spread[3:-1, UAV_FORCE] = np.tile(np.eye(3, 2), (N, 1))

    def on_bodies(self, x: Array, unknowns: Array) -> Array:
        """Return the forces and the mass error as `Model` takes them, (4 + 3 N,), at a state.

        (6 + 3 N,) with the errors of drag where the equations of motion have drag.
        """
        forces: Array = self._spread @ unknowns
        forces[-1] = max(forces[-1], self._least_kg)
        if self._model.system.has_drag:
            return np.concatenate([forces, unknowns[DRAG]])
        forces[:-1] += self._by_drag(x) @ unknowns[DRAG]
        return forces

    def derivative(self, place: Situation) -> Array:
        """Return the forces on the bodies per unknown, (3 + 3 N, 7).

        The inertia of the mass error, which turns the payload, is left out.
        """
        rate = place.model.derivative(place.x, place.actual, forces=place.forces)
        view = state.StateView(place.x)
        derivative = self._spread[:-1].copy()

        #   F_0 = dm (g k - a_0),    a_0 = R_0 (v_0' + omega_0 x v_0)    (63a)
        acceleration_P = rate[state.V0] + cross(view.omega0_P, view.v0_P)
        derivative[:3, MASS_ERROR] = -rotation(view.Theta0) @ acceleration_P
        derivative[2, MASS_ERROR] += place.model.system.gravity

        derivative[:, DRAG] = self._by_drag(place.x)
        return derivative

    def over_a_period(self, place: Situation, A: Array, period_s: float) -> Array:
        """Return the effect of the unknowns over a sampling period on the state, (len(A), 7).

        A is the discrete transition matrix of the period; the effect is of second order in it.
        """
        model = place.model
        unknown = place.forces
        if unknown is None:
            return np.zeros((len(A), 0))

        # The equations of motion are affine in the forces, (38), but not in mass and drag.
        bodies = 3 + 3 * model.system.N
        still = np.concatenate([np.zeros(bodies), unknown[bodies:]])
        units = np.zeros((len(unknown), COUNT))
        units[:bodies] = self.derivative(place)
        pushed = [still, *(still + unit for unit in units.T)]
        f, *by_unit = model.derivatives(place.x, place.actual, pushed)
        E = np.zeros((len(A), COUNT))
        E[: len(place.x)] = (by_unit - f).T

        #   integral of exp(A_c t) E  =  T_s / 2 (E + A E) + O(T_s^3)
        return np.asarray(period_s / 2.0 * (E + A @ E))

    def _by_drag(self, x: Array) -> Array:
        """Return the forces on the bodies per drag of payload and UAVs, (3 + 3 N, 2)."""
        velocities = self._model.velocities(x[: self._model.system.n]).reshape(-1)
        forces = np.zeros((len(self._spread) - 1, 2))
        forces[:3, 0] = -velocities[:3]
        forces[3:, 1] = -velocities[3:]
        return forces
