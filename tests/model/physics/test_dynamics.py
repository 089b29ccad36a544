"""Equations of motion against stored reference values and against the paper's own matrix form."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support import paper_form, reference
from tests.support.random_systems import random_forces, random_input, random_state, random_system
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.parameters import Payload
from transport.model.state import StateView

# The stored values carry up to 1.3e-11 of the engines' own error, in the same measure.
REFERENCE_TOLERANCE = 1e-8
# Two exact formulations: rounding times the condition number of M_0q, which stays below 1e5 in the
# draws.
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


@pytest.mark.parametrize("N", [1, 4])
def test_further_mass_is_the_payloads(N: int) -> None:
    """A mass after the forces gives derivative and tensions of a payload of that mass, inertia in proportion."""
    rng = np.random.default_rng(370 + N)
    system, x, u, F = (
        random_system(rng, N),
        random_state(rng, N),
        random_input(rng, N),
        random_forces(rng, N),
    )
    model, known = Model(system), system.payload
    heavier = replace(system, payload=Payload(mass=1.3 * known.mass, inertia=1.3 * known.inertia))
    further = np.append(F, 0.3 * known.mass)
    for of, expected in (
        (model.derivative, Model(heavier).derivative),
        (model.tensions, Model(heavier).tensions),
    ):
        assert deviation(of(x, u, forces=further), expected(x, u, forces=F)) < PAPER_TOLERANCE
