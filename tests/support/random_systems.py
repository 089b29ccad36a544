"""Random systems, states and inputs without symmetry, for tests of the equations of motion."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import GRAVITY, Payload, System, Uav

# rad; keeps Euler rates away from their singularity at 90 deg, where comparisons lose digits.
PITCH_MAX = 1.2


def random_inertia(rng: np.random.Generator, scale: float) -> Array:
    """Return the inertia matrix of a physical body in a random frame, (3, 3), around `scale` kg m^2."""
    a, b, c = scale * rng.uniform(0.3, 1.0, 3)
    R = Rotation.random(rng=rng).as_matrix()
    # Second moments a, b, c of a mass distribution give principal moments that obey the triangle
    # inequality.
    J = R @ np.diag([b + c, a + c, a + b]) @ R.T
    return np.asarray((J + J.T) / 2.0)


def random_system(rng: np.random.Generator, N: int, gravity: float = GRAVITY) -> System:
    """Return a system of N unequal UAVs on unequal rods at irregular attachment points."""
    uavs = [
        Uav(
            mass=rng.uniform(0.5, 2.0),
            inertia=random_inertia(rng, 0.03),
            rho=rng.uniform(-0.6, 0.6, 3),
            rod_length=rng.uniform(0.8, 3.5),
        )
        for _ in range(N)
    ]
    return System(
        payload=Payload(mass=rng.uniform(1.0, 5.0), inertia=random_inertia(rng, 0.4)),
        uavs=uavs,
        gravity=gravity,
    )


def with_drag(rng: np.random.Generator, system: System) -> System:
    """Return a system whose bodies have unequal drag, that of UAVs across and along their rotors' axis."""
    uavs = [replace(uav, drag=rng.uniform(0.1, 1.0, 2)) for uav in system.uavs]
    payload = replace(system.payload, drag=rng.uniform(0.1, 1.0))
    return replace(system, payload=payload, uavs=tuple(uavs))


def random_state(rng: np.random.Generator, N: int, rate: float = 2.0) -> Array:
    """Return a state far from hover with velocities around `rate` (m/s, rad/s) and e .

    Omega = 0, (12 + 12 N,).
    """
    x = np.zeros(12 + 12 * N)
    x[state.R0] = rng.normal(0.0, 5.0, 3)
    x[state.V0] = rng.normal(0.0, rate, 3)
    x[state.THETA0] = random_attitude(rng)
    x[state.OMEGA0] = rng.normal(0.0, rate, 3)
    for i in range(N):
        block = x[state.uav_slice(i)]
        e = rng.normal(0.0, 1.0, 3)
        e /= np.linalg.norm(e)
        Omega = rng.normal(0.0, rate, 3)
        block[state.E] = e
        block[state.ROD_RATE] = Omega - e * (e @ Omega)
        block[state.THETA] = random_attitude(rng)
        block[state.OMEGA] = rng.normal(0.0, rate, 3)
    return x


def random_attitude(rng: np.random.Generator) -> Array:
    """Return random roll, pitch and yaw, with pitch away from the singularity, (3,), rad."""
    return rng.uniform([-np.pi, -PITCH_MAX, -np.pi], [np.pi, PITCH_MAX, np.pi])


def random_forces(rng: np.random.Generator, N: int) -> Array:
    """Return external forces of around 5 N on payload and UAVs in all directions, (3 + 3 N,), inertial frame."""
    return rng.normal(0.0, 5.0, 3 + 3 * N)


def random_input(rng: np.random.Generator, N: int) -> Array:
    """Return thrusts of up to 30 N and moments around 0.3 N m, (4 N,)."""
    return np.column_stack([rng.uniform(0.0, 30.0, N), rng.normal(0.0, 0.3, (N, 3))]).reshape(-1)
