"""A team after a motor failure: statics with the UAV on its rod, and without it."""

import numpy as np
import pytest

from tests.support.paper_form import K, attitude
from tests.support.runs import SCENARIOS
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import (
    RELEASED_MASS_KG,
    hover,
    hover_after_failures,
    motor_off_state,
    no_inputs,
    released_state,
)
from transport.model.physics.parameters import ParameterError, System, table_1
from transport.model.state import INPUTS, StateView
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized

DEAD = 2  # UAV 3; UAV 1 is opposite, UAVs 2 and 4 are its neighbours
OPPOSITE, NEIGHBOURS = 0, (1, 3)
WEIGHT_N = 1.5 * 9.81  # of a UAV of Table I
MOST_N = 45.0  # default of controller.limits.thrust_N

# Accelerations left by the rounding of forces of up to 100 N, m/s^2 and rad/s^2.
AT_REST = 1e-10
FORCE_TOLERANCE_N = 1e-10
# The bob of a released UAV weighs 1e-5 N.
BOB_TOLERANCE_N = 2.0 * RELEASED_MASS_KG * 9.81
# That weight moves a payload of 3 kg by 3e-6 m/s^2; within 1 s, with rods that fall over at 2
# rad/s, below 1e-5.
BOB_DEVIATION = 1e-5
ROLLED = (1.2, -0.5, 0.8)  # attitude of a payload, rad


def larger(uavs: int) -> System:
    """A team of another size, as `transport scenario new` makes it."""
    ready = read_scenario(SCENARIOS / "resilient.toml")
    return Setup.of(resized(ready, Team(uavs=uavs), "resilient"), "larger").system


def thrusts(u: Array) -> Array:
    """Thrusts of all UAVs, (N,), N."""
    return u[::INPUTS]


def test_three_hold_a_payload_without_the_fourth() -> None:
    """Cut loose: the neighbours carry half the payload each, the opposite UAV nothing.

    Docs/equations.md (51).
    """
    at = hover_after_failures(table_1(), {DEAD}, {DEAD})
    np.testing.assert_allclose(
        thrusts(at.u)[list(NEIGHBOURS)], 2.0 * WEIGHT_N, atol=BOB_TOLERANCE_N
    )
    assert thrusts(at.u)[OPPOSITE] == pytest.approx(WEIGHT_N, abs=BOB_TOLERANCE_N)
    assert thrusts(at.u)[DEAD] == 0.0
    assert np.abs(Model(table_1(), {DEAD}, {DEAD}).derivative(at.x, at.u)).max() < AT_REST
    assert at.x[state.uav_slice(DEAD)][2] == -1.0


def test_with_the_fourth_on_its_rod_the_opposite_one_has_no_thrust() -> None:
    """Four UAVs, level payload.

    The opposite one rests on its rod, its neighbours are 0.9 N from their bound.
    """
    at = hover_after_failures(table_1(), {DEAD}, set())
    assert thrusts(at.u)[OPPOSITE] == 0.0
    given = hover_after_failures(table_1(), {DEAD}, set(), {DEAD: 20.0})
    np.testing.assert_array_equal(given.u, at.u, "without motors there is no thrust to give")
    np.testing.assert_allclose(
        thrusts(at.u)[list(NEIGHBOURS)], 3.0 * WEIGHT_N, atol=FORCE_TOLERANCE_N
    )
    assert pytest.approx(0.855) == MOST_N - 3.0 * WEIGHT_N
    np.testing.assert_allclose(at.tensions[[OPPOSITE, DEAD]], -WEIGHT_N, atol=FORCE_TOLERANCE_N)
    assert np.abs(Model(table_1()).derivative(at.x, at.u)).max() < AT_REST


@pytest.mark.parametrize(
    ("uavs", "least", "most"), [(5, 15.2, 40.0), (6, 14.7, 36.8), (8, 17.6, 32.8)]
)
def test_five_and_more_hold_a_dead_uav(uavs: int, least: float, most: float) -> None:
    """With five or more a level hover exists in which every other UAV has thrust to spare in both directions."""
    system = larger(uavs)
    at = hover_after_failures(system, {DEAD}, set())
    others = np.delete(thrusts(at.u), DEAD)
    assert least < others.min()
    assert others.max() < most
    assert np.abs(Model(system).derivative(at.x, at.u)).max() < AT_REST


def test_two_neighbours_gone_is_too_much() -> None:
    """Two UAVs that are left on one side of the payload have no hover, and the text says so."""
    with pytest.raises(ParameterError, match="no hover equilibrium"):
        hover_after_failures(table_1(), {0, 1}, {0, 1})


def moving(system: System) -> tuple[Array, Array]:
    """A state off its equilibrium, everything in motion, and inputs near hover."""
    rng = np.random.default_rng(17)
    at = hover(system)
    x = at.x + 0.05 * rng.standard_normal(system.n)
    view = StateView(x)
    view.e_P[:] /= np.linalg.norm(view.e_P, axis=1, keepdims=True)
    view.Omega_P[:] -= view.e_P * (view.e_P * view.Omega_P).sum(axis=1, keepdims=True)
    return x, at.u * (1.0 + 0.02 * rng.standard_normal(system.m))


def test_the_rest_moves_as_a_system_without_the_released_uav() -> None:
    """Payload and the UAVs that are left follow the trajectory of a system that never had the fourth."""
    system = table_1()
    live = [i for i in range(4) if i != DEAD]
    three = System(
        payload=system.payload, uavs=[system.uavs[i] for i in live], gravity=system.gravity
    )
    x, u = moving(system)
    columns = np.concatenate(
        [np.arange(12), *[np.arange(12) + state.uav_slice(i).start for i in live]]
    )
    with_bob, without = released_state(x, DEAD), x[columns]
    model, reference = Model(system, {DEAD}, {DEAD}), Model(three)
    for _ in range(20):
        with_bob, _ = model.integrate(with_bob, u, 0.05, 5)
        without, _ = reference.integrate(without, u[state.input_indices(live)], 0.05, 5)
        assert np.abs(with_bob[columns] - without).max() < BOB_DEVIATION
    assert np.abs(without[:12] - x[:12]).max() > 0.1  # it has moved


def test_a_released_uav_is_a_bob_straight_below_its_attachment_point() -> None:
    """Also from a payload that has turned far about all axes its rod hangs down, at rest, (14)."""
    system, (x, _) = table_1(), moving(table_1())
    x[state.THETA0] = ROLLED
    hung = released_state(x, DEAD)
    place_I = Model(system).outputs(hung)[3 * DEAD : 3 * DEAD + 3]
    uav = system.uavs[DEAD]
    attachment_I = x[state.R0] + attitude(x[state.THETA0]) @ uav.rho
    np.testing.assert_allclose(place_I - attachment_I, uav.rod_length * K, atol=AT_REST)

    bob = StateView(hung)
    for motion in (bob.Omega_P, bob.Theta, bob.omega_B):
        assert not motion[DEAD].any()
    others = np.delete(np.arange(system.n), np.arange(system.n)[state.uav_slice(DEAD)])
    np.testing.assert_array_equal(hung[others], x[others])


def test_a_motor_off_uav_acts_by_its_mass_alone() -> None:
    """Its inputs have no effect whatever they are, nor has its attitude.

    A wind on a released UAV has none either.
    """
    system = table_1()
    x, u = moving(system)
    x = motor_off_state(x, DEAD)
    assert not x[state.uav_slice(DEAD)][state.OMEGA].any()
    off = Model(system, {DEAD}, set())
    dead = Model(system).derivative(x, no_inputs(u, [DEAD]))
    np.testing.assert_array_equal(off.derivative(x, u), dead)
    assert not off.linearise(x, u).B_c[:, state.input_slice(DEAD)].any()
    turned = x.copy()
    turned[state.uav_slice(DEAD)][state.THETA] += 0.3
    np.testing.assert_allclose(off.derivative(turned, u), dead, atol=AT_REST)
    released, hung = Model(system, {DEAD}, {DEAD}), released_state(x, DEAD)
    gust = np.zeros(15)
    gust[9:12] = [1.0, 2.0, -3.0]
    np.testing.assert_array_equal(
        released.derivative(hung, u, forces=gust), released.derivative(hung, u)
    )
