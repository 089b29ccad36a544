"""Equations of motion against MuJoCo on random systems at test time."""

import numpy as np
import pytest

from model.arrays import Array
from model.linearisation import Model
from model.parameters import System
from model.state import StateView
from tests.support import engine
from tests.support.paper_form import attitude, vehicle_accelerations
from tests.support.random_systems import random_forces, random_input, random_state, random_system

# The engine's rods are exactly massless, so only rounding is left: 1e-12 in the draws, relative to the largest entry.
ENGINE_TOLERANCE = 1e-10


def own_accelerations(system: System, x: Array, u: Array, forces: Array | None = None) -> engine.Accelerations:
    """The model's derivative turned into the engine's quantities: absolute derivatives, inertial components."""
    derivative = Model(system).derivative(x, u, forces=forces)
    view, rate = StateView(x), StateView(derivative)
    R0, omega0 = attitude(view.Theta0), view.omega0_P
    turns = zip(view.Theta, rate.omega_B, strict=True)
    return engine.Accelerations(
        payload_I=R0 @ (rate.v0_P + np.cross(omega0, view.v0_P)),
        payload_turn_I=R0 @ rate.omega0_P,
        rods_turn_I=(rate.Omega_P + np.cross(omega0, view.Omega_P)) @ R0.T,
        uavs_I=vehicle_accelerations(system, x, derivative),
        uavs_turn_I=np.array([attitude(Theta) @ omega_dot for Theta, omega_dot in turns]),
    )


def assert_same(own: engine.Accelerations, engines: engine.Accelerations) -> None:
    """Every block within ENGINE_TOLERANCE of the engine's, relative to its largest entry or 1."""
    for block in ("payload_I", "payload_turn_I", "rods_turn_I", "uavs_I", "uavs_turn_I"):
        value, expected = getattr(own, block), getattr(engines, block)
        off = np.abs(value - expected).max() / max(1.0, np.abs(expected).max())
        assert off < ENGINE_TOLERANCE, block


@pytest.mark.parametrize("N", range(1, 7))
def test_accelerations_are_mujocos(N: int) -> None:
    """Payload, rods and UAVs accelerate as in MuJoCo at random states and inputs, paper (7)-(10)."""
    rng = np.random.default_rng(600 + N)
    for _ in range(4):
        system = random_system(rng, N)
        x, u = random_state(rng, N), random_input(rng, N)
        assert_same(own_accelerations(system, x, u), engine.accelerations(system, x, u))


@pytest.mark.parametrize("N", range(1, 7))
def test_external_forces_are_mujocos(N: int) -> None:
    """Forces on the centres of mass, inertial, accelerate everything as MuJoCo's applied forces do."""
    rng = np.random.default_rng(650 + N)
    for _ in range(4):
        system = random_system(rng, N)
        x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
        assert_same(own_accelerations(system, x, u, F), engine.accelerations(system, x, u, F))


@pytest.mark.parametrize("gravity", [0.0, 1.62])
def test_gravity_is_the_systems(gravity: float) -> None:
    """The agreement holds for other values of g, and without any, in paper (7)-(9)."""
    rng = np.random.default_rng(700)
    system = random_system(rng, 3, gravity=gravity)
    x, u = random_state(rng, 3), random_input(rng, 3)
    assert_same(own_accelerations(system, x, u), engine.accelerations(system, x, u))


def test_rods_may_be_horizontal_or_upright() -> None:
    """Rods sideways and above the UAVs (lift from below) are states like any other, paper (9)."""
    rng = np.random.default_rng(800)
    system = random_system(rng, 3)
    x, u = random_state(rng, 3), random_input(rng, 3)
    view = StateView(x)
    view.e_P[:] = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    view.Omega_P[:] = [[0.0, 2.0, -1.0], [1.0, 0.0, 3.0], [-2.0, 1.0, 0.0]]
    assert_same(own_accelerations(system, x, u), engine.accelerations(system, x, u))
