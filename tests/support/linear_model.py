"""The linear model about hover as a plant model, for which the theorems of the shared control law hold exactly."""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.discretisation import zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.path.hover_reference import HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase, Profile
from transport.model.physics.hover import Hover
from transport.model.physics.parameters import Payload, System, Uav
from transport.mpc.law.tangent import tangent

PERIOD_S = 0.05


class LinearModel(Model):
    """Model with the A_c, B_c and C of hover at every state, and constant forces with their effect at hover.

    Args:
        system: Physical parameters.
        at: Equilibrium of the system.
    """

    def __init__(self, system: System, at: Hover) -> None:
        super().__init__(system)
        self._at, self._about = at, super().linearise(at.x, at.u)
        self._by_forces = self.force_effect(at.x, at.u)

    def outputs(self, x: Array) -> Array:
        """Return y = h(x_hover) + C (x - x_hover)."""
        y: Array = self._about.y + self._about.C @ (x - self._at.x)
        return y

    def linearise(self, x: Array, u: Array, *, forces: Array | None = None) -> Linearisation:
        """Return the expansion about hover, written about (x, u)."""
        about = self._about
        f = about.f + about.A_c @ (x - self._at.x) + about.B_c @ (u - self._at.u)
        if forces is not None:
            f = f + self._by_forces @ forces
        return Linearisation.of(f, about.A_c, about.B_c, self.outputs(x), about.C)


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference equation of the deviation from hover over one sampling period, and its outputs."""

    A: Array
    B: Array
    C: Array


def difference(system: System, at: Hover) -> Difference:
    """Return A, B and C of a system about hover."""
    linear = Model(system).linearise(at.x, at.u)
    discrete = zero_order_hold(linear, PERIOD_S)
    return Difference(discrete.A, discrete.B, linear.C)


def uneven() -> System:
    """Return five unequal UAVs on unequal rods around an unsymmetric payload, so that no term cancels by symmetry."""
    angles = 2.0 * np.pi * np.arange(5) / 5 + np.array([0.0, 0.2, -0.1, 0.15, 0.05])
    return System(
        payload=Payload(mass=4.0, inertia=[0.5, 0.7, 0.9]),
        uavs=[
            Uav(
                mass=1.2 + 0.15 * i,
                inertia=[0.025 + 0.002 * i, 0.03, 0.05],
                rho=[0.5 * np.cos(angle), 0.4 * np.sin(angle), -0.1 - 0.02 * i],
                rod_length=2.4 + 0.3 * i,
            )
            for i, angle in enumerate(angles)
        ],
    )


def reference_states(
    system: System, at: Hover, profile: Profile, instants: int, start_I: Array | None = None
) -> Array:
    """Return reference states of a move in all directions that ends well before the last instant, (instants, n)."""
    start = np.array([1.0, -2.0, -10.0]) if start_I is None else start_I
    legs = [
        ("hover", 0.5, [0.0, 0.0, 0.0]),
        ("there", 0.7, [0.1, -0.05, 0.08]),
        ("on", 0.5, [0.0, 0.1, -0.05]),
    ]
    phases = [
        Phase(name=name, duration_s=duration, displacement_I=way) for name, duration, way in legs
    ]
    reference = HoverReference(system, at, Maneuver(start_I=start, phases=phases, profile=profile))
    return reference.states(PERIOD_S * np.arange(instants, dtype=np.float64))


def reference_outputs(model: Model, X_ref: Array) -> Array:
    """Return outputs of reference states, (instants, 4 N + 9)."""
    return np.array([model.outputs(x) for x in X_ref])


def small_state(at: Hover, rng: np.random.Generator, size: float) -> Array:
    """Return a deviation from hover of about `size` on the constraint manifold, headings included, (n,)."""
    T = tangent(at.x)
    deviation: Array = T @ (size * rng.standard_normal(T.shape[1]))
    return deviation
