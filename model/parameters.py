"""Physical parameters of one payload and the N quadrotors that carry it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model import state
from model.arrays import Array, ArrayLike, ShapeError, checked, frozen

GRAVITY = 9.81  # m/s^2; the paper gives none

# Relative slack of the triangle inequality of the principal moments: exact flat bodies are allowed.
_INERTIA_SLACK = 1e-9
# Least half length of each edge of the payload's box, m.
_LEAST_HALF_M = 0.05


class ParameterError(ValueError):
    """A physical parameter out of its range."""


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Payload:
    """The carried rigid body.

    Attributes:
        mass: kg.
        inertia: About the centre of mass in the payload frame, (3, 3), kg m^2. A vector of 3 is the diagonal.
    """

    mass: float
    inertia: Array

    def __init__(self, *, mass: float, inertia: ArrayLike) -> None:
        object.__setattr__(self, "mass", _positive("payload mass", mass, "kg"))
        object.__setattr__(self, "inertia", _inertia("payload inertia", inertia))


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Uav:
    """One quadrotor and the rod from its centre of mass to the payload.

    Attributes:
        mass: kg.
        inertia: About the centre of mass in the UAV's body frame, (3, 3), kg m^2. A vector of 3 is the diagonal.
        rho: Attachment point in the payload frame, (3,), m.
        rod_length: m.
    """

    mass: float
    inertia: Array
    rho: Array
    rod_length: float

    def __init__(self, *, mass: float, inertia: ArrayLike, rho: ArrayLike, rod_length: float) -> None:
        object.__setattr__(self, "mass", _positive("UAV mass", mass, "kg"))
        object.__setattr__(self, "inertia", _inertia("UAV inertia", inertia))
        object.__setattr__(self, "rho", checked("rho", rho, (3,)))
        object.__setattr__(self, "rod_length", _positive("rod length", rod_length, "m"))


@dataclass(frozen=True, slots=True, init=False, eq=False)
class System:
    """One payload, N UAVs, and gravity along the inertial z axis (down), m/s^2.

    Attributes:
        rate_gains: K of the UAVs' inner loops about each body axis, (3,), 1/s: the inputs are then thrust and commanded
            body rates. None: thrust and moments.
    """

    payload: Payload
    uavs: tuple[Uav, ...]
    gravity: float = GRAVITY
    rate_gains: Array | None = None

    def __init__(
        self, *, payload: Payload, uavs: Sequence[Uav], gravity: float = GRAVITY, rate_gains: ArrayLike | None = None
    ) -> None:
        if not uavs:
            raise ParameterError("system: expected at least one UAV, got none")
        object.__setattr__(self, "payload", payload)
        object.__setattr__(self, "uavs", tuple(uavs))
        # Zero gravity is used by tests of the dynamics.
        if not (np.isfinite(gravity) and gravity >= 0.0):
            raise ParameterError(f"gravity: expected a number >= 0 m/s^2, got {gravity!r}")
        object.__setattr__(self, "gravity", float(gravity))
        if rate_gains is not None:
            rate_gains = checked("rate gains", rate_gains, (3,))
            if rate_gains.min() <= 0.0:
                raise ParameterError(f"rate gains: expected three numbers > 0 1/s, got {rate_gains.tolist()}")
        object.__setattr__(self, "rate_gains", rate_gains)

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
        """Whether the inputs are thrust and body rates instead of thrust and moments."""
        return self.rate_gains is not None

    def vector(self) -> Array:
        """Return all parameters in the order of `model.dynamics.Symbols`, (8 + 11 N,) or (11 + 11 N,), SI."""
        parts = [np.array([self.gravity, self.payload.mass]), _upper(self.payload.inertia)]
        for uav in self.uavs:
            parts += [np.array([uav.mass]), _upper(uav.inertia), uav.rho, np.array([uav.rod_length])]
        vector = np.concatenate(parts if self.rate_gains is None else [*parts, self.rate_gains])
        frozen(vector)
        return vector


def table_1() -> System:
    """Return the system of the paper's Table I: a 3 kg payload under four 1.5 kg UAVs on 3.2 m rods."""
    corners = [(0.25, 0.25), (0.25, -0.25), (-0.25, -0.25), (-0.25, 0.25)]
    return System(
        payload=Payload(mass=3.0, inertia=[0.556, 0.556, 0.556]),
        uavs=[Uav(mass=1.5, inertia=[0.029, 0.029, 0.055], rho=[x, y, -0.125], rod_length=3.2) for x, y in corners],
    )


def _positive(name: str, value: float, unit: str) -> float:
    if not (isinstance(value, int | float | np.number) and np.isfinite(value) and value > 0.0):
        raise ParameterError(f"{name}: expected a number > 0 {unit}, got {value!r}")
    return float(value)


def _inertia(name: str, value: ArrayLike) -> Array:
    try:
        diagonal = isinstance(value, np.ndarray | list | tuple) and np.ndim(value[0]) == 0
        array = checked(name, value, (3,) if diagonal else (3, 3))
    except (ShapeError, IndexError) as error:
        raise ParameterError(str(error)) from error
    J = np.diag(array) if array.ndim == 1 else array
    if not np.allclose(J, J.T, rtol=0.0, atol=1e-12 * np.abs(J).max()):
        raise ParameterError(f"{name}: expected a symmetric matrix, got {J.tolist()}")
    moments = np.linalg.eigvalsh(J)
    if moments[0] <= 0.0:
        raise ParameterError(f"{name}: expected positive principal moments, got {moments.tolist()} kg m^2")
    if moments[2] > (moments[0] + moments[1]) * (1.0 + _INERTIA_SLACK):
        raise ParameterError(
            f"{name}: no body has principal moments {moments.tolist()} kg m^2: "
            "the largest exceeds the sum of the other two"
        )
    frozen(J)
    return J


def _upper(J: Array) -> Array:
    return J[np.triu_indices(3)]


def payload_half_size(system: System) -> Array:
    """Return half the edges of the payload's box, (3,), m: about its centre of mass, as far as its attachment points.

    The payload is taken for this box where it touches the ground; the equations of motion know no shape. Edges are
    parallel to the axes of the payload frame.
    """
    rho = np.array([uav.rho for uav in system.uavs])
    return np.asarray(np.maximum(np.abs(rho).max(axis=0), _LEAST_HALF_M))


def payload_corners(system: System) -> Array:
    """Return the corners of the payload's box, (8, 3), payload frame, m."""
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * payload_half_size(system)


def resting_height(system: System, ground_m: float) -> float:
    """Return z of the centre of mass of a level payload on the ground, inertial frame (z down), m."""
    return ground_m - float(payload_half_size(system)[2])
