"""Equations of motion against stored reference values and against the paper's own matrix form."""

import numpy as np
import pytest

from model.arrays import Array
from model.linearisation import Model
from model.parameters import System
from model.state import StateView
from tests.support import paper_form, reference
from tests.support.random_systems import random_forces, random_input, random_state, random_system

# The stored values carry up to 1.3e-11 of the engines' own error, in the same measure.
REFERENCE_TOLERANCE = 1e-8
# Two exact formulations: rounding times the condition number of M_0q, which stays below 1e5 in the draws.
PAPER_TOLERANCE = 1e-10


def deviation(value: Array, expected: Array) -> float:
    """Largest difference relative to the block's largest entry, or to 1 when the block is small."""
    assert value.shape == expected.shape
    return float(np.abs(value - expected).max() / max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("name", reference.ACCELERATIONS)
def test_derivative_is_that_of_the_physics_engines(name: str) -> None:
    """x' = f(x, u) gives the engines' accelerations and the kinematics of paper (2), (3)."""
    case = reference.acceleration(name)
    rate = StateView(Model(case.system).derivative(case.x, case.u))
    blocks = {
        "v0_dot": rate.v0_P,
        "omega0_dot": rate.omega0_P,
        "Omega_dot": rate.Omega_P,
        "omega_i_dot": rate.omega_B,
        "r0_dot": rate.r0_I,
        "e_dot": rate.e_P,
    }
    off = {block: deviation(value, case.expected[block]) for block, value in blocks.items()}
    assert max(off.values()) < REFERENCE_TOLERANCE, off


@pytest.mark.parametrize("name", reference.ACCELERATIONS)
def test_tensions_are_those_of_the_physics_engines(name: str) -> None:
    """T_i of m_i a_i = f_i + m_i g k + T_i R0 e_i, positive when the rod pulls."""
    case = reference.acceleration(name)
    tensions = Model(case.system).tensions(case.x, case.u)
    assert deviation(tensions, case.expected["rod_tension"]) < REFERENCE_TOLERANCE


@pytest.mark.parametrize("name", reference.ACCELERATIONS)
def test_outputs_and_their_rates_are_the_vehicles_motion(name: str) -> None:
    """The first 3 N outputs are r_i of paper (1); C x' is then r_i' of paper (4)."""
    case = reference.acceleration(name)
    N = case.system.N
    model = Model(case.system)
    linear = model.linearise(case.x, case.u)
    positions = model.outputs(case.x)[: 3 * N].reshape(N, 3)
    velocities = (linear.C @ linear.f)[: 3 * N].reshape(N, 3)
    assert deviation(positions, case.expected["r_i"]) < REFERENCE_TOLERANCE
    assert deviation(velocities, case.expected["r_i_dot"]) < REFERENCE_TOLERANCE


@pytest.mark.parametrize("N", range(1, 9))
def test_accelerations_solve_the_papers_linear_system(N: int) -> None:
    """The 6 x 6 system in rod tensions has the solution of paper (11), M_0q (v0', omega0', Omega') = f_0q."""
    rng = np.random.default_rng(100 + N)
    for _ in range(5):
        system = random_system(rng, N)
        x, u = random_state(rng, N), random_input(rng, N)
        rate = StateView(Model(system).derivative(x, u))
        expected = paper_form.accelerations(system, x, paper_form.thrust_forces(x, u))
        for value, wanted in zip((rate.v0_P, rate.omega0_P, rate.Omega_P), expected, strict=True):
            assert deviation(value, wanted) < PAPER_TOLERANCE


@pytest.mark.parametrize("N", range(1, 9))
def test_tensions_close_newtons_law_of_each_vehicle(N: int) -> None:
    """With a_i from paper (1) and (11), what is missing in Newton's law of a UAV lies along its rod and is T_i."""
    rng = np.random.default_rng(200 + N)
    system = random_system(rng, N)
    x, u = random_state(rng, N), random_input(rng, N)
    model = Model(system)
    force_I = paper_form.thrust_forces(x, u)
    a_I = paper_form.vehicle_accelerations(system, x, model.derivative(x, u))
    tensions = model.tensions(x, u)
    assert deviation(tensions, paper_form.rod_tensions(system, x, force_I, a_I)) < PAPER_TOLERANCE
    view = StateView(x)
    masses = np.array([[uav.mass] for uav in system.uavs])
    pull_I = tensions[:, None] * view.e_P @ paper_form.attitude(view.Theta0).T
    assert deviation(masses * a_I, force_I + masses * system.gravity * paper_form.K + pull_I) < PAPER_TOLERANCE


@pytest.mark.parametrize("N", [1, 4, 8])
def test_forces_like_weights_are_more_gravity(N: int) -> None:
    """Forces m_j a k on all bodies are a gravity larger by a, in the motion and in the tensions, (37)."""
    rng = np.random.default_rng(250 + N)
    system, a = random_system(rng, N), 2.5
    heavier = System(payload=system.payload, uavs=system.uavs, gravity=system.gravity + a)
    x, u = random_state(rng, N), random_input(rng, N)
    masses = [system.payload.mass, *[uav.mass for uav in system.uavs]]
    F = np.concatenate([mass * a * paper_form.K for mass in masses])
    model = Model(system)
    assert deviation(model.derivative(x, u, forces=F), Model(heavier).derivative(x, u)) < PAPER_TOLERANCE
    assert deviation(model.tensions(x, u, forces=F), Model(heavier).tensions(x, u)) < PAPER_TOLERANCE


@pytest.mark.parametrize("N", [1, 4, 8])
def test_forces_on_the_vehicles_are_thrust(N: int) -> None:
    """The paper's f_i, a force on UAV i, may come from outside: without thrust the forces on UAVs do the same."""
    rng = np.random.default_rng(260 + N)
    system = random_system(rng, N)
    x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
    F[:3] = 0.0
    pushed = StateView(Model(system).derivative(x, u * np.tile([0.0, 1.0, 1.0, 1.0], N), forces=F))
    expected = paper_form.accelerations(system, x, F[3:].reshape(N, 3))
    for value, wanted in zip((pushed.v0_P, pushed.omega0_P, pushed.Omega_P), expected, strict=True):
        assert deviation(value, wanted) < PAPER_TOLERANCE


@pytest.mark.parametrize("N", [1, 4])
def test_no_forces_are_zero_forces(N: int) -> None:
    """Leaving the forces out is the same, bit for bit, as giving zeros."""
    rng = np.random.default_rng(270 + N)
    model = Model(random_system(rng, N))
    x, u, none = random_state(rng, N), random_input(rng, N), np.zeros(3 + 3 * N)
    assert model.derivative(x, u).tobytes() == model.derivative(x, u, forces=none).tobytes()
    assert model.tensions(x, u).tobytes() == model.tensions(x, u, forces=none).tobytes()
    assert model.linearise(x, u).A_c.tobytes() == model.linearise(x, u, forces=none).A_c.tobytes()
    assert model.integrate(x, u, 0.05, 2)[0].tobytes() == model.integrate(x, u, 0.05, 2, forces=none)[0].tobytes()


@pytest.mark.parametrize("N", [1, 4, 8])
def test_vehicles_turn_by_eulers_equation(N: int) -> None:
    """J_i omega_i' + omega_i x J_i omega_i = tau_i, paper (10), whatever the rest of the system does."""
    rng = np.random.default_rng(300 + N)
    system = random_system(rng, N)
    x, u = random_state(rng, N), random_input(rng, N)
    omega, omega_dot = StateView(x).omega_B, StateView(Model(system).derivative(x, u)).omega_B
    J = np.array([uav.inertia for uav in system.uavs])
    momentum = np.einsum("nij,nj->ni", J, omega)
    moment = np.einsum("nij,nj->ni", J, omega_dot) + np.cross(omega, momentum)
    assert deviation(moment, u.reshape(N, 4)[:, 1:]) < PAPER_TOLERANCE


@pytest.mark.parametrize("N", [1, 3, 6])
def test_constraints_of_the_rods_are_kept_by_the_derivative(N: int) -> None:
    """d/dt |e_i|^2 = 0 and d/dt (e_i . Omega_i) = 0 at every state that satisfies both, paper section II-A."""
    rng = np.random.default_rng(400 + N)
    system = random_system(rng, N)
    x, u = random_state(rng, N), random_input(rng, N)
    view, rate = StateView(x), StateView(Model(system).derivative(x, u))
    scale = max(1.0, float(np.abs(rate.Omega_P).max()))
    length = (view.e_P * rate.e_P).sum(axis=1)
    spin = (view.e_P * rate.Omega_P).sum(axis=1) + (rate.e_P * view.Omega_P).sum(axis=1)
    assert np.abs(length).max() < PAPER_TOLERANCE
    assert np.abs(spin).max() < PAPER_TOLERANCE * scale
