"""The expansion about a state and input, paper (13).

Jacobians against finite differences, outputs by hand.
"""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.paper_form import attitude
from tests.support.random_systems import (
    random_forces,
    random_input,
    random_state,
    random_system,
    with_drag,
)
from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels.compiled_step import CompiledStep, Feedback
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import Payload, System, table_1
from transport.model.state import StateView

# Sixth-order central differences: truncation ~ h^6 = 6e-17, rounding ~ eps / h = 1e-13 of the
# largest entry of f.
STEP = 2e-3
WEIGHTS = {1: 45.0 / 60.0, 2: -9.0 / 60.0, 3: 1.0 / 60.0}
JACOBIAN_TOLERANCE = 1e-10
# Relative to the largest entry: rounding of |e| = 1 and e . Omega = 0 in the random state, times
# entries of that size.
ACROSS_TOLERANCE = 1e-9
# A handful of products and sums per position.
OUTPUT_TOLERANCE = 1e-13
# Accelerations left by the rounding of forces of up to 100 N, rad/s^2 and m/s^2.
AT_REST = 1e-10
FURTHER_KG = 0.7


def vehicle_motion(system: System, x: Array) -> tuple[Array, Array]:
    """Return UAV positions by paper (1) and velocities by paper (4), each (N, 3), inertial frame, m and m/s."""
    view = StateView(x)
    R0 = attitude(view.Theta0)
    rho = np.array([uav.rho for uav in system.uavs])
    rods = np.array([[uav.rod_length] for uav in system.uavs])
    position = view.r0_I + (rho - rods * view.e_P) @ R0.T
    velocity = (
        view.v0_P + np.cross(view.omega0_P, rho) - rods * np.cross(view.Omega_P, view.e_P)
    ) @ R0.T
    return position, velocity


def retracted(x: Array) -> Array:
    """The state of the manifold next to x.

    E -> e / |e|, Omega -> Omega - e (e . Omega), docs/equations.md (13a).
    """
    x = x.copy()
    for i in range((len(x) - state.PAYLOAD) // state.PER_UAV):
        block = x[state.uav_slice(i)]
        e = block[state.E] / np.linalg.norm(block[state.E])
        block[state.E] = e
        block[state.ROD_RATE] -= e * (e @ block[state.ROD_RATE])
    return x


def jacobian(function: Callable[[Array], Array], at: Array) -> Array:
    """Jacobian by sixth-order central differences, (outputs, inputs)."""
    columns = []
    for direction in np.eye(len(at)):
        sides = [
            weight * (function(at + k * STEP * direction) - function(at - k * STEP * direction))
            for k, weight in WEIGHTS.items()
        ]
        columns.append(sum(sides) / STEP)
    return np.column_stack(columns)


def deviation(value: Array, expected: Array) -> float:
    """Largest difference relative to the largest entry."""
    assert value.shape == expected.shape
    return float(np.abs(value - expected).max() / np.abs(expected).max())


def drawn(N: int) -> tuple[System, Model, Array, Array]:
    """A random system at a random state and input, far from any equilibrium."""
    rng = np.random.default_rng(1400 + N)
    system = random_system(rng, N)
    return system, Model(system), random_state(rng, N), random_input(rng, N)


@pytest.mark.parametrize("N", range(1, 9))
def test_jacobians_are_those_of_finite_differences(N: int) -> None:
    """A_c = df/dx along the manifold, B_c = df/du and C = dh/dx about a non-equilibrium point, (15); paper (13)."""
    _, model, x, u = drawn(N)
    linear = model.linearise(x, u)
    assert (
        deviation(linear.A_c, jacobian(lambda z: model.derivative(retracted(z), u), x))
        < JACOBIAN_TOLERANCE
    )
    assert deviation(linear.B_c, jacobian(lambda z: model.derivative(x, z), u)) < JACOBIAN_TOLERANCE
    assert deviation(linear.C, jacobian(model.outputs, x)) < JACOBIAN_TOLERANCE


@pytest.mark.parametrize("N", [1, 3, 4])
def test_jacobians_with_drag_are_those_of_finite_differences(N: int) -> None:
    """A_c = df/dx with drag of all bodies, also beyond the known one, (15), (42)."""
    rng = np.random.default_rng(1450 + N)
    model = Model(with_drag(rng, random_system(rng, N)))
    x, u = random_state(rng, N), random_input(rng, N)
    forces = np.concatenate([random_forces(rng, N), [FURTHER_KG, 0.3, 0.2]])
    linear = model.linearise(x, u, forces=forces)
    by_state = jacobian(lambda z: model.derivative(retracted(z), u, forces=forces), x)
    assert deviation(linear.A_c, by_state) < JACOBIAN_TOLERANCE
    by_input = jacobian(lambda z: model.derivative(x, z, forces=forces), u)
    assert deviation(linear.B_c, by_input) < JACOBIAN_TOLERANCE


@pytest.mark.parametrize("N", [1, 4])
def test_drag_is_a_force_against_the_velocity_of_each_body(N: int) -> None:
    """F_0 = -d_0 v_0,  F_i = -(d_i I + (d_i^z - d_i) b b') v_i on the equations without drag, (42).

    Further drag of UAVs is the same in all directions. What the sensors of the UAVs show is the same.
    """
    rng = np.random.default_rng(1470 + N)
    still = random_system(rng, N)
    system = with_drag(rng, still)
    x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
    known, unknown = Model(system), Model(still)
    further = 0.4, 0.3

    velocities = unknown.velocities(x)
    drags = [-(system.payload.drag + further[0]) * velocities[0]]
    for uav, Theta, v in zip(system.uavs, StateView(x).Theta, velocities[1:], strict=True):
        b = attitude(Theta)[:, 2]
        across, along = uav.drag + further[1]
        drags.append(-across * (v - (b @ v) * b) - along * (b @ v) * b)
    pushed = F + np.concatenate(drags)
    forces = np.concatenate([F, [0.0, *further]])

    for name in ("derivative", "tensions", "sensed"):
        found = getattr(known, name)(x, u, forces=forces)
        expected = getattr(unknown, name)(x, u, forces=pushed)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-10)


def test_released_uavs_have_no_drag() -> None:
    """A bob of a millionth of a kilogram is not held back, whatever its UAV's drag was, (50)."""
    rng = np.random.default_rng(1480)
    system = with_drag(rng, random_system(rng, 4))
    x, u = random_state(rng, 4), random_input(rng, 4)
    forces = np.concatenate([random_forces(rng, 4), [0.0, 0.3, 0.2]])
    left = Model(system, [2], [2])
    assert not left.system.uavs[2].drag.any()
    assert np.abs(left.derivative(x, u, forces=forces)).max() < 1e3


@pytest.mark.parametrize("N", range(1, 9))
def test_dynamics_do_not_see_rod_length(N: int) -> None:
    """A_c is zero across the manifold, along e_i and along Omega_i parallel to e_i, docs/equations.md (15).

    The equations of motion, simplified with |e| = 1, do answer to rod length: without the
    projection the test fails.
    """
    _, model, x, u = drawn(N)
    A_c = model.linearise(x, u).A_c
    stiffness = 0.0
    for i in range(N):
        for part in (state.E, state.ROD_RATE):
            across = np.zeros(len(x))
            across[state.uav_slice(i)][part] = StateView(x).e_P[i]
            assert np.abs(A_c @ across).max() <= ACROSS_TOLERANCE * np.abs(A_c).max()
            change = model.derivative(x + STEP * across, u) - model.derivative(x - STEP * across, u)
            stiffness = max(stiffness, float(np.abs(change).max()) / (2.0 * STEP))
    assert stiffness > 0.01 * np.abs(A_c).max()


@pytest.mark.parametrize("N", [1, 4])
def test_jacobians_under_external_forces(N: int) -> None:
    """The same with forces from outside, which turn with the payload in (37).

    Df/dF is (38) at any forces.
    """
    _, model, x, u = drawn(N)
    F = random_forces(np.random.default_rng(1450 + N), N)
    linear = model.linearise(x, u, forces=F)
    assert deviation(linear.f, model.derivative(x, u, forces=F)) < OUTPUT_TOLERANCE
    along = jacobian(lambda z: model.derivative(retracted(z), u, forces=F), x)
    assert deviation(linear.A_c, along) < JACOBIAN_TOLERANCE
    assert (
        deviation(linear.B_c, jacobian(lambda z: model.derivative(x, z, forces=F), u))
        < JACOBIAN_TOLERANCE
    )
    effect = jacobian(lambda z: model.derivative(x, u, forces=z), F)
    assert deviation(model.force_effect(x, u), effect) < JACOBIAN_TOLERANCE


def heavier(system: System, further_kg: float) -> System:
    """The system with a payload of the same shape and more mass."""
    payload = system.payload
    ratio = 1.0 + further_kg / payload.mass
    return replace(
        system, payload=Payload(mass=ratio * payload.mass, inertia=ratio * payload.inertia)
    )


@pytest.mark.parametrize("N", [1, 4])
def test_further_mass_is_that_of_a_heavier_payload(N: int) -> None:
    """With a mass behind the forces f, T and A_c are those of the heavier system, (37)."""
    system, model, x, u = drawn(N)
    F = random_forces(np.random.default_rng(1460 + N), N)
    with_mass = np.append(F, FURTHER_KG)
    other = Model(heavier(system, FURTHER_KG))
    expected = other.derivative(x, u, forces=F)
    several = model.derivatives(x, u, [with_mass, np.append(0.0 * F, FURTHER_KG)])
    assert deviation(model.derivative(x, u, forces=with_mass), expected) < OUTPUT_TOLERANCE
    assert deviation(several[0], expected) < OUTPUT_TOLERANCE
    assert deviation(several[1], other.derivative(x, u)) < OUTPUT_TOLERANCE
    tensions = other.tensions(x, u, forces=F)
    assert deviation(model.tensions(x, u, forces=with_mass), tensions) < OUTPUT_TOLERANCE
    A_c = other.linearise(x, u, forces=F).A_c
    assert deviation(model.linearise(x, u, forces=with_mass).A_c, A_c) < OUTPUT_TOLERANCE


def test_force_in_place_of_a_mass_keeps_its_hover() -> None:
    """The inputs with which a heavier team hovers balance its further weight as a force, (37)."""
    system = table_1()
    at = hover(heavier(system, FURTHER_KG))
    model = Model(system)
    forces = np.append(np.zeros(3 + 3 * system.N), FURTHER_KG)
    f = model.derivative(at.x, at.u, forces=model.with_weight_of_mass_error(forces))
    assert np.abs(f).max() < AT_REST

    # Without the force its thrusts lift the lighter team.
    total_kg = system.payload.mass + sum(uav.mass for uav in system.uavs)
    climb = model.derivative(at.x, at.u)[state.V0][2]
    assert climb == pytest.approx(-FURTHER_KG * system.gravity / total_kg)


@pytest.mark.parametrize("N", [1, 4, 8])
def test_velocities_are_those_of_the_centres_of_mass(N: int) -> None:
    """(39): R0 v0 of the payload, and of the UAVs paper (4) summed by hand."""
    system, model, x, _ = drawn(N)
    view = StateView(x)
    _, uavs = vehicle_motion(system, x)
    expected = np.vstack([attitude(view.Theta0) @ view.v0_P, uavs])
    assert deviation(model.velocities(x), expected) < OUTPUT_TOLERANCE


@pytest.mark.parametrize("N", range(1, 9))
def test_outputs_by_hand(N: int) -> None:
    """y stacks r_i of paper (1), payload angles, yaw rates (paper, section V-A), payload position, velocity, (14)."""
    system, model, x, _ = drawn(N)
    view = StateView(x)
    positions, _ = vehicle_motion(system, x)
    payload = [view.r0_I, attitude(view.Theta0) @ view.v0_P]
    expected = np.concatenate([positions.reshape(-1), view.Theta0, view.omega_B[:, 2], *payload])
    assert deviation(model.outputs(x), expected) < OUTPUT_TOLERANCE


def test_a_rollout_in_one_call_is_of_teams_with_all_motors(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled one knows no UAVs off: it is taken where all have motors, and the model's steps elsewhere."""
    rolled = np.zeros((2, 60)), np.zeros((1, 16))
    monkeypatch.setattr(CompiledStep, "load", lambda _: SimpleNamespace(rollout=lambda *_: rolled))
    x, bounds = np.zeros(60), np.zeros(16)
    feedback = Feedback(at_x=np.zeros((1, 16)), K=np.zeros((16, 60)), lower=bounds, upper=bounds)
    assert Model(table_1()).rollout(x, feedback, 0.05, None) is rolled
    assert Model(table_1(), {2}).rollout(x, feedback, 0.05, None) is None
