"""Physical parameters of one payload and the N quadrotors that carry it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from transport.model import state
from transport.model.arrays import Array, ArrayLike, ShapeError, assign, checked, frozen

GRAVITY = 9.81  # m/s^2; the paper gives none

# Places of the payload in `System.vector`.
PAYLOAD_MASS = 1
PAYLOAD_INERTIA = slice(2, 8)  # upper triangle, by row

# Of the triangle inequality of the principal moments: exact flat bodies are allowed.
_INERTIA_SLACK = 1e-9
# Largest asymmetry of an inertia, relative to its largest entry: rounding.
_ASYMMETRY = 1e-12
_LEAST_HALF_M = 0.05  # half length of each edge of the payload's box, m


class ParameterError(ValueError):
    """A physical parameter out of its range."""


class Kind(NamedTuple):
    """What the equations of motion of a system depend on, beside its numbers."""

    N: int  # number of UAVs
    rates: bool = False  # inputs are thrust and commanded body rates instead of moments
    drag: bool = False  # the bodies may have drag


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Payload:
    """The carried rigid body."""

    mass: float  # kg
    # About the centre of mass in the payload frame, (3, 3), kg m^2, given as such or as diagonal.
    inertia: Array
    drag: float  # force against its velocity relative to the air, kg/s
    # Centre of mass, (3,), payload frame, m, from the point that controllers take for it. The
    # attachment points of a `System` are from the centre of mass.
    centre: Array

    def __init__(
        self,
        *,
        mass: float,
        inertia: ArrayLike,
        drag: float = 0.0,
        centre: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        assign(
            self,
            mass=float(mass),
            inertia=_inertia("payload inertia", inertia),
            drag=float(drag),
            centre=checked("centre", centre, (3,)),
        )


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Uav:
    """One quadrotor and the rod from its centre of mass to the payload."""

    mass: float  # kg
    # About the centre of mass in the body frame, (3, 3), kg m^2, given as such or as diagonal.
    inertia: Array
    rho: Array  # attachment point in the payload frame, (3,), m
    rod_length: float  # m
    # Force against its velocity relative to the air, in the plane of its rotors and along their
    # axis, (2,), kg/s.
    drag: Array

    def __init__(
        self,
        *,
        mass: float,
        inertia: ArrayLike,
        rho: ArrayLike,
        rod_length: float,
        drag: ArrayLike = (0.0, 0.0),
    ) -> None:
        assign(
            self,
            mass=float(mass),
            inertia=_inertia("UAV inertia", inertia),
            rho=checked("rho", rho, (3,)),
            rod_length=float(rod_length),
            drag=checked("drag", drag, (2,)),
        )


@dataclass(frozen=True, slots=True, init=False, eq=False)
class System:
    """One payload, N UAVs, and gravity along the inertial z axis (down), m/s^2."""

    payload: Payload
    uavs: tuple[Uav, ...]
    gravity: float
    # K of the UAVs' inner loops about each body axis, (3,), 1/s: the inputs are then thrust and
    # commanded body rates; None: thrust and moments.
    rate_gains: Array | None
    # True if the equations of motion have drag: a body has a coefficient, or one is estimated.
    has_drag: bool

    def __init__(
        self,
        *,
        payload: Payload,
        uavs: Sequence[Uav],
        gravity: float = GRAVITY,
        rate_gains: ArrayLike | None = None,
        has_drag: bool = False,
    ) -> None:
        gains = None if rate_gains is None else checked("rate gains", rate_gains, (3,))
        assign(
            self,
            payload=payload,
            uavs=tuple(uavs),
            gravity=float(gravity),
            rate_gains=gains,
            has_drag=has_drag or payload.drag != 0.0 or any(uav.drag.any() for uav in uavs),
        )

    @property
    def N(self) -> int:
        """Number of UAVs."""
        return len(self.uavs)

    @property
    def n(self) -> int:
        """Number of states, 12 + 12 N."""
        return state.PAYLOAD + state.PER_UAV * self.N

    @property
    def m(self) -> int:
        """Number of inputs, 4 N."""
        return state.INPUTS * self.N

    @property
    def p(self) -> int:
        """Number of outputs, 4 N + 9."""
        return 4 * self.N + 9

    @property
    def total_mass(self) -> float:
        """m_T of the paper, kg."""
        return self.payload.mass + sum(uav.mass for uav in self.uavs)

    @property
    def commands_rates(self) -> bool:
        """True if the inputs are thrust and body rates instead of thrust and moments."""
        return self.rate_gains is not None

    @property
    def kind(self) -> Kind:
        """Which equations of motion the system has."""
        return Kind(self.N, self.commands_rates, self.has_drag)

    @property
    def drag(self) -> Array:
        """Drag of the payload, then of each UAV across and along, (1 + 2 N,), kg/s."""
        return np.concatenate([[self.payload.drag], *(uav.drag for uav in self.uavs)])

    def vector(self) -> Array:
        """Return all parameters in the order of `model.physics.dynamics.Symbols`, SI.

        (8 + 11 N,), then three gains with commanded body rates, and `drag` where there is any. Mass and
        inertia of the payload are at `PAYLOAD_MASS` and `PAYLOAD_INERTIA`.
        """
        upper = np.triu_indices(3)
        parts = [np.array([self.gravity, self.payload.mass]), self.payload.inertia[upper]]
        for uav in self.uavs:
            parts += [np.array([uav.mass]), uav.inertia[upper], uav.rho, np.array([uav.rod_length])]
        if self.rate_gains is not None:
            parts.append(self.rate_gains)
        if self.has_drag:
            parts.append(self.drag)

        vector = np.concatenate(parts)
        frozen(vector)
        return vector


def table_1() -> System:
    """Return the system of the paper's Table I.

    A 3 kg payload under four 1.5 kg UAVs on 3.2 m rods.
    """
    corners = [(0.25, 0.25), (0.25, -0.25), (-0.25, -0.25), (-0.25, 0.25)]
    return System(
        payload=Payload(mass=3.0, inertia=[0.556, 0.556, 0.556]),
        uavs=[
            Uav(mass=1.5, inertia=[0.029, 0.029, 0.055], rho=[x, y, -0.125], rod_length=3.2)
            for x, y in corners
        ],
    )


def _inertia(name: str, value: ArrayLike) -> Array:
    """Return the inertia of a body, (3, 3), given as such or as its diagonal.

    Raises: ParameterError: an inertia that no body has.
    """
    try:
        is_diagonal = isinstance(value, np.ndarray | list | tuple) and np.ndim(value[0]) == 0
        array = checked(name, value, (3,) if is_diagonal else (3, 3))
    except (ShapeError, IndexError) as error:
        raise ParameterError(str(error)) from error

    J = np.diag(array) if array.ndim == 1 else array
    if not np.allclose(J, J.T, rtol=0.0, atol=_ASYMMETRY * np.abs(J).max()):
        raise ParameterError(f"{name}: expected a symmetric matrix, got {J.tolist()}")

    moments = np.linalg.eigvalsh(J)
    if moments[0] <= 0.0:
        expected = "expected positive principal moments"
        raise ParameterError(f"{name}: {expected}, got {moments.tolist()} kg m^2")
    if moments[2] > (moments[0] + moments[1]) * (1.0 + _INERTIA_SLACK):
        problem = f"no body has principal moments {moments.tolist()} kg m^2"
        raise ParameterError(f"{name}: {problem}: the largest exceeds the sum of the other two")
    frozen(J)
    return J


def payload_half_size(system: System) -> Array:
    """Return half the edges of the payload's box, (3,), payload frame, m.

    As far as its attachment points, about the point that controllers take for its centre of mass.
    """
    rho = np.array([uav.rho for uav in system.uavs]) + system.payload.centre
    return np.asarray(np.maximum(np.abs(rho).max(axis=0), _LEAST_HALF_M))


def resting_height(system: System, ground_m: float) -> float:
    """Return z of the centre of mass of a level payload on the ground.

    Inertial frame (z down), m.
    """
    return ground_m - float(payload_half_size(system)[2])
