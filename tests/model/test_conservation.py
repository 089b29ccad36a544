"""Conservation laws along integrated motion, and the balance of power and momentum under inputs."""

import numpy as np
import pytest

from model.arrays import Array
from model.linearisation import Model
from model.parameters import System
from model.state import StateView
from tests.support import invariants, paper_form, reference
from tests.support.random_systems import random_input, random_state, random_system

# Stored energies and momenta carry the engines' rounding; ours are sums of a few dozen terms.
REFERENCE_TOLERANCE = 1e-9
# Relative drift over the motion: steps of 2.5 ms leave local errors near rounding, 400 of them add up to 1e-14.
DRIFT = 1e-12
# Rods are projected after every step, so their constraints hold to the rounding of one normalisation.
CONSTRAINT_TOLERANCE = 1e-14
# Second-order central differences along x': BALANCE_STEP_S^2 times third derivatives, measured 1e-8.
BALANCE_TOLERANCE = 1e-6
BALANCE_STEP_S = 1e-5

DURATION_S = 1.0
SAMPLES = 20
STEPS_PER_SAMPLE = 20


def motion(system: System, x: Array, u: Array) -> Array:
    """States over DURATION_S at SAMPLES equal intervals, the first one included, (SAMPLES + 1, n)."""
    model = Model(system)
    states = [x]
    for _ in range(SAMPLES):
        states.append(model.integrate(states[-1], u, DURATION_S / SAMPLES, STEPS_PER_SAMPLE)[0])
    return np.array(states)


@pytest.mark.parametrize("name", reference.ACCELERATIONS)
def test_hand_written_invariants_are_the_engines(name: str) -> None:
    """Energy, linear and angular momentum summed over the bodies by paper (1), (4) are what the engines stored."""
    case = reference.acceleration(name)
    own = {
        "energy": np.array(invariants.energy(case.system, case.x)),
        "linear_momentum": invariants.linear_momentum(case.system, case.x),
        "angular_momentum_no_uav_spin": invariants.angular_momentum(case.system, case.x),
    }
    for block, value in own.items():
        expected = case.expected[block]
        assert np.abs(value - expected).max() < REFERENCE_TOLERANCE * max(1.0, np.abs(expected).max()), block


@pytest.mark.parametrize("N", [1, 3, 6])
def test_free_motion_conserves_energy_and_momenta(N: int) -> None:
    """Without gravity and inputs, (7)-(10) conserve energy, linear and angular momentum, and every UAV's spin."""
    rng = np.random.default_rng(900 + N)
    system = random_system(rng, N, gravity=0.0)
    states = motion(system, random_state(rng, N, rate=0.5), np.zeros(4 * N))
    energy = np.array([invariants.energy(system, x) for x in states])
    momentum = np.array([invariants.linear_momentum(system, x) for x in states])
    spins = np.array([invariants.spin(system, x) for x in states])
    turning = np.array([invariants.angular_momentum(system, x) for x in states]) + spins.sum(axis=1)
    for quantity in (energy, momentum, turning, spins):
        assert np.abs(quantity - quantity[0]).max() < DRIFT * np.abs(quantity[0]).max()
    # The motion was one: a system at rest would conserve all of this, too.
    assert np.abs(states[-1] - states[0]).max() > 0.1


@pytest.mark.parametrize("N", [1, 4])
def test_rods_stay_unit_and_do_not_spin(N: int) -> None:
    """|e_i| = 1 and e_i . Omega_i = 0 after every call of `integrate`, under inputs too, paper section II-A."""
    rng = np.random.default_rng(1100 + N)
    view = StateView(motion(random_system(rng, N), random_state(rng, N, rate=0.5), 0.3 * random_input(rng, N)))
    assert np.abs(np.linalg.norm(view.e_P, axis=-1) - 1.0).max() < CONSTRAINT_TOLERANCE
    scale = np.abs(view.Omega_P).max()
    assert np.abs((view.e_P * view.Omega_P).sum(axis=-1)).max() < CONSTRAINT_TOLERANCE * scale


@pytest.mark.parametrize("N", [1, 3, 6])
def test_inputs_account_for_energy_and_momentum(N: int) -> None:
    """E' = sum f_i . r_i' + tau_i . omega_i and P' = m_T g k + sum f_i: rods and joints do no work, paper (7)-(10)."""
    rng = np.random.default_rng(1200 + N)
    system = random_system(rng, N)
    x, u = random_state(rng, N), random_input(rng, N)
    x_dot = Model(system).derivative(x, u)
    ahead, behind = x + BALANCE_STEP_S * x_dot, x - BALANCE_STEP_S * x_dot
    force_I = paper_form.thrust_forces(x, u)
    _, velocity = invariants.vehicle_motion(system, x)
    power = (force_I * velocity).sum() + (u.reshape(N, 4)[:, 1:] * StateView(x).omega_B).sum()
    energy_rate = (invariants.energy(system, ahead) - invariants.energy(system, behind)) / (2.0 * BALANCE_STEP_S)
    assert abs(energy_rate - power) < BALANCE_TOLERANCE * max(1.0, abs(power))
    change = invariants.linear_momentum(system, ahead) - invariants.linear_momentum(system, behind)
    force = system.total_mass * system.gravity * paper_form.K + force_I.sum(axis=0)
    assert np.abs(change / (2.0 * BALANCE_STEP_S) - force).max() < BALANCE_TOLERANCE * np.abs(force).max()
