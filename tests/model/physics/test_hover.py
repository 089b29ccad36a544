"""Hover: an equilibrium of the full dynamics where one exists, a refusal that says why where none does."""

import numpy as np
import pytest

from tests.support.paper_form import K
from tests.support.random_systems import random_inertia
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import ParameterError, Payload, System, Uav, table_1
from transport.model.state import INPUTS, StateView

# Accelerations left by the rounding of least squares and of forces of up to 100 N, rad/s^2 and
# m/s^2.
AT_REST = 1e-10
# Forces of up to 100 N.
FORCE_TOLERANCE_N = 1e-11
# Closed forms of single forces, relative: least squares of six equations.
FORCE_RATIO_TOLERANCE = 1e-12


def ring_system(rng: np.random.Generator, N: int) -> System:
    """N unequal UAVs attached all around the payload's centre of mass, at different heights and distances."""
    # Less than half a turn between neighbours keeps the centre of mass between the attachment
    # points.
    angles = 2.0 * np.pi * (np.arange(N) + rng.uniform(-0.2, 0.2, N)) / N
    radii, heights = rng.uniform(0.2, 0.6, N), rng.uniform(-0.3, 0.1, N)
    uavs = [
        Uav(
            mass=rng.uniform(0.5, 2.0),
            inertia=random_inertia(rng, 0.03),
            rho=[radius * np.cos(a), radius * np.sin(a), z],
            rod_length=rng.uniform(0.8, 3.5),
        )
        for a, radius, z in zip(angles, radii, heights, strict=True)
    ]
    return System(
        payload=Payload(mass=rng.uniform(1.0, 5.0), inertia=random_inertia(rng, 0.4)), uavs=uavs
    )


def spread_rods(system: System, depth: float) -> Array:
    """Rods leaning outwards, on lines that meet `depth` m below the centre of mass, (N, 3).

    Forces along lines through one point above or below the centre of mass leave no moment there, so
    only the balance of forces remains, and rods all around the payload can hold it.
    """
    rods = np.array([depth * K - uav.rho for uav in system.uavs])
    return np.asarray(rods / np.linalg.norm(rods, axis=1, keepdims=True))


def assert_at_rest(system: System, rods_P: Array | None) -> None:
    """x' = 0 in the dynamics, the model's tensions are hover's, and no rod or UAV moves."""
    at = hover(system, rods_P)
    model = Model(system)
    assert np.abs(model.derivative(at.x, at.u)).max() < AT_REST
    assert np.abs(model.tensions(at.x, at.u) - at.tensions).max() < FORCE_TOLERANCE_N
    view = StateView(at.x)
    assert not view.v0_P.any()
    assert not view.omega0_P.any()
    assert not view.r0_I.any()
    assert (at.u[::INPUTS] > 0.0).all()


def test_table_1_hovers_with_equal_shares() -> None:
    """By symmetry each UAV of Table I lifts itself and a quarter of the payload, with level attitude."""
    system = table_1()
    at = hover(system)
    assert_at_rest(system, None)
    assert at.u[::INPUTS] == pytest.approx(
        (1.5 + 3.0 / 4.0) * system.gravity, rel=FORCE_RATIO_TOLERANCE
    )
    assert at.tensions == pytest.approx(3.0 / 4.0 * system.gravity, rel=FORCE_RATIO_TOLERANCE)
    assert np.abs(StateView(at.x).Theta).max() < AT_REST
    assert np.array_equal(StateView(at.x).e_P, np.tile(K, (4, 1)))


@pytest.mark.parametrize("N", [3, 4, 6, 8])
def test_vertical_rods_hold_unequal_systems(N: int) -> None:
    """f(x, u) = 0 of paper (12) with upright rods, unequal UAVs and attachment points all around the payload."""
    rng = np.random.default_rng(1900 + N)
    for _ in range(3):
        assert_at_rest(ring_system(rng, N), None)


@pytest.mark.parametrize("N", [3, 4, 6, 8])
def test_tilted_rods_hold_unequal_systems(N: int) -> None:
    """f(x, u) = 0 of paper (12) with rods that lean outwards and pull against each other."""
    rng = np.random.default_rng(2000 + N)
    for _ in range(3):
        system = ring_system(rng, N)
        assert_at_rest(system, spread_rods(system, rng.uniform(1.5, 4.0)))


def test_one_vehicle_hovers_above_the_centre_of_mass() -> None:
    """N = 1 hangs the payload straight below: thrust is the whole weight, paper (7) at rest."""
    system = System(
        payload=Payload(mass=2.0, inertia=[0.1, 0.2, 0.25]),
        uavs=[Uav(mass=1.0, inertia=[0.02, 0.02, 0.03], rho=[0.0, 0.0, -0.2], rod_length=1.0)],
    )
    assert_at_rest(system, None)
    assert hover(system).u[0] == pytest.approx(3.0 * system.gravity, rel=FORCE_RATIO_TOLERANCE)


@pytest.mark.parametrize("d", [0.3, 1e-7])
def test_one_vehicle_off_axis_is_refused_with_the_imbalance(d: float) -> None:
    """A rod beside the centre of mass leaves a moment, which is no rounding.

    The text has the largest part that no tension removes.
    """
    weight = 3.0 * 9.81
    system = System(
        payload=Payload(mass=3.0, inertia=[0.5, 0.5, 0.5]),
        uavs=[Uav(mass=1.5, inertia=[0.03, 0.03, 0.05], rho=[d, 0.0, -0.1], rod_length=2.0)],
        gravity=9.81,
    )
    # Least squares of [1; -d] T = [W; 0]: T = W / (1 + d^2), which leaves the moment d T and the
    # force d^2 T.
    moment = d * weight / (1.0 + d**2)
    with pytest.raises(
        ParameterError, match=f"no hover equilibrium.*leave {moment:.3g} N or N m on the payload"
    ):
        hover(system)


@pytest.mark.parametrize(
    ("mass", "places", "text"),
    [
        (
            1.5,
            [[0.25, -0.25, -0.1], [0.25, 0.25, -0.1]],
            "centre of mass must hang between the attachment points",
        ),
        (
            0.5,
            [[0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [0.12, 0.0, 0.0]],
            "UAV3 would have to push down",
        ),
    ],
)
def test_attachments_on_one_side_are_refused(
    mass: float, places: list[list[float]], text: str
) -> None:
    """UAVs on one side of the centre of mass cannot balance it with upright rods.

    One that had to push is named.
    """
    uavs = [Uav(mass=mass, inertia=[0.03, 0.03, 0.05], rho=rho, rod_length=2.0) for rho in places]
    system = System(payload=Payload(mass=3.0, inertia=[0.5, 0.5, 0.5]), uavs=uavs)
    with pytest.raises(ParameterError, match=text):
        hover(system)


def test_given_thrusts_are_those_of_the_equilibrium() -> None:
    """The UAVs whose thrusts are free hold the rest; a UAV without thrust loads its rod with its weight."""
    system = ring_system(np.random.default_rng(2100), 6)
    free = hover(system).u[::INPUTS]
    given = {1: float(free[1]) + 0.5, 4: 0.0}
    at = hover(system, None, given)
    assert np.abs(Model(system).derivative(at.x, at.u)).max() < AT_REST
    assert at.u[::INPUTS][[1, 4]] == pytest.approx([given[1], 0.0], rel=FORCE_RATIO_TOLERANCE)
    assert at.tensions[4] == pytest.approx(-system.uavs[4].mass * system.gravity)


@pytest.mark.parametrize("leans", [(0.3, 0.2), (0.3, 0.0), (0.0, -0.3)])
def test_a_given_thrust_on_a_tilted_rod_is_refused(leans: tuple[float, float]) -> None:
    """Along a tilted rod no thrust follows from the tension alone; the UAV and its rod are named."""
    system = ring_system(np.random.default_rng(2200), 4)
    rods = np.tile(K, (4, 1))
    rods[2, :2] = leans
    with pytest.raises(ParameterError, match="given thrust of UAV3: expected a vertical rod, got "):
        hover(system, rods, {2: 20.0})
