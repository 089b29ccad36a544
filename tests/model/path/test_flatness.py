"""References that a team can fly.

The path's derivatives, and the motion of the team that follows from them.
"""

from dataclasses import replace

import numpy as np
import pytest

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.curves import Curve
from transport.model.path.flat_reference import FlatReference
from transport.model.path.flatness import flight, slowed
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import (
    RELEASED_MASS_KG,
    hover,
    hover_after_failures,
    with_released,
)
from transport.model.physics.parameters import ParameterError, Payload, System, Uav, table_1
from transport.model.state import StateView, input_slice, uav_slice

# Central differences of order 8 over steps of 0.3 ms: rounding of numbers up to 10 over the step.
STEP_S = 3e-4
STENCIL = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
SAME_RATE = 2e-9
# Where a difference spans the end of a ramp or a way point of a spline, at which the seventh
# derivative has a kink.
ACROSS_KINKS = 1e-7
# Accelerations by the pull of a bob, 1e-5 N, on the payload.
BOB = 1e-3
# Places of the rods of a team that hangs its payload between them without the third one, too.
LEFT = np.array([[0.3, 0.0, -0.05], [-0.2, -0.3, 0.0], [0.0, 0.0, -0.1], [-0.2, 0.3, -0.05]])
# Results of a few sums of numbers up to 30.
ROUNDING = 1e-12

CURVES = {
    "circle": Curve(kind="circle", duration_s=9.0, ramp_s=3.0, size_I=(2.0, 2.0, 0.5), laps=1.5),
    "eight": Curve(kind="eight", duration_s=16.0, ramp_s=5.0, size_I=(3.8, 1.9, 0.2), laps=2.0),
    "spline": Curve(
        kind="spline",
        duration_s=9.0,
        ramp_s=2.0,
        points_I=[[1, 0, 0], [2, 1, 0], [3, -1, -1], [4, 0, 0]],
    ),
    "straight": Curve(kind=None, duration_s=3.0, ramp_s=1.5, size_I=(1.0, -0.5, 0.5)),
    "table": Curve(  # no difference of the tests spans a knot
        kind=None,
        duration_s=4.75,
        ramp_s=0.0,
        table=[[0, 0, 0, 0], [2, 0, 0, 0], [4, 0.1, -0.1, 0], [4.75, 0.1, 0, 0]],
    ),
    "leaning": Curve(kind="spline", duration_s=4.0, ramp_s=2.0, points_I=[[2, 0, 0]]),
}


def unequal(rate_gains: list[float] | None = None) -> System:
    """Four UAVs of different masses, inertias, rods and places."""
    uavs = [
        Uav(mass=m, inertia=[2e-3 + 1e-3 * m, 3e-3, 5e-3], rho=rho, rod_length=length)
        for m, rho, length in (
            (0.6, [0.3, 0.1, -0.05], 1.0),
            (0.7, [0.2, -0.3, 0.0], 0.8),
            (0.5, [-0.3, -0.2, -0.1], 1.2),
            (0.8, [-0.2, 0.3, -0.05], 0.9),
        )
    ]
    return System(
        payload=Payload(mass=1.4, inertia=[[0.02, 1e-3, 0], [1e-3, 0.02, 0], [0, 0, 0.03]]),
        uavs=uavs,
        rate_gains=rate_gains,
    )


def dragged(system: System) -> System:
    """The system with drag of all bodies, of UAVs across and along the axis of their rotors."""
    drags = np.array([[0.3, 0.5], [0.2, 0.0], [0.4, 0.1], [0.25, 0.25]])
    uavs = [replace(uav, drag=drag) for uav, drag in zip(system.uavs, drags, strict=True)]
    return replace(system, payload=replace(system.payload, drag=0.6), uavs=tuple(uavs))


def along(curve: Curve) -> Maneuver:
    """Rest, the curve, and rest."""
    end_I = curve.path(np.array([curve.duration_s]), 1)[0, 0]
    rest = Phase(name="rest", duration_s=1.0, displacement_I=[0.0, 0.0, 0.0])
    leaning = [[0.5, 1.3, 0.6], [1.0, 1.0, 1.0]] if curve is CURVES["leaning"] else None
    way = Phase(
        name="way",
        duration_s=curve.duration_s,
        displacement_I=end_I,
        way=curve,
        formation=leaning,
    )
    return Maneuver(start_I=[1.0, 2.0, -9.0], phases=[rest, way, rest], profile="smooth")


def difference(values: list[Array]) -> Array:
    """Return the rate at the middle of nine values, `STEP_S` apart."""
    rate: Array = np.tensordot(STENCIL, np.array(values), 1) / STEP_S
    return rate


@pytest.mark.parametrize("kind", CURVES)
@pytest.mark.parametrize(
    ("pushed", "gains", "drag"),
    [
        (False, None, False),
        (True, None, False),
        (False, [20.0, 20.0, 8.0], False),
        (True, None, True),
        (False, [20.0, 20.0, 8.0], True),
    ],
)
def test_reference_satisfies_the_equations_of_motion(
    kind: str, *, pushed: bool, gains: list[float] | None, drag: bool
) -> None:
    """f(x_ref, u_ref, F) = x_ref', (13) and (66)-(68).

    Moments, external forces, mass and drag, commanded body rates.
    """
    system = dragged(unequal(gains)) if drag else unequal(gains)
    rng = np.random.default_rng(3)
    maneuver, at_rest, model = along(CURVES[kind]), hover(system), Model(system)
    forces = np.zeros(4 + 3 * system.N + 2 * drag)
    if pushed:
        forces = rng.uniform(-0.5, 0.5, len(forces))
    times = rng.uniform(0.0, maneuver.duration_s, 60)

    def motion(t_s: Array) -> tuple[Array, Array]:
        found = flight(system, at_rest, maneuver.jets(t_s), forces)
        return found.x, found.u

    x, u = motion(times)
    rates = difference([motion(times + STEP_S * j)[0] for j in range(-4, 5)])
    f = np.array([model.derivative(*row, forces=forces) for row in zip(x, u, strict=True)])
    errors, curve = np.abs(f - rates).max(axis=1), CURVES[kind]
    kinks = 1.0 + np.array([0.0, curve.ramp_s, curve.duration_s - curve.ramp_s, curve.duration_s])
    smooth = (np.abs(times[:, None] - kinks).min(axis=1) > 5.0 * STEP_S) & (
        kind not in ("spline", "table")
    )
    assert errors.max() < ACROSS_KINKS
    assert errors[smooth].max(initial=0.0) < SAME_RATE
    tensions = np.array([model.tensions(*row, forces=forces) for row in zip(x, u, strict=True)])
    np.testing.assert_allclose(
        flight(system, at_rest, maneuver.jets(times), forces).tensions, tensions, atol=ROUNDING
    )
    assert np.abs(x - x[0]).max() > 0.1, "the team must move to be judged by its motion"


@pytest.mark.parametrize("kind", CURVES)
def test_path_has_six_derivatives_and_rests_at_its_ends(kind: str) -> None:
    """Each Taylor coefficient is the rate of the one before, up to the ends, where the team hovers: equation (65)."""
    curve, system = CURVES[kind], unequal()
    times = np.linspace(0.05, 0.95, 25) * curve.duration_s
    path = curve.path(times)
    for order in range(1, len(path)):
        rates = difference([curve.path(times + STEP_S * j)[order - 1] for j in range(-4, 5)])
        scale = 1.0 + np.abs(rates).max()
        np.testing.assert_allclose(
            order * path[order], rates, rtol=0.0, atol=10.0 * SAME_RATE * scale
        )
    reference = FlatReference(system, hover(system), along(curve))
    for t_s in (-1.0, 0.5, curve.duration_s + 1.5):
        resting = flight(system, hover(system), reference.maneuver.jets(np.array([t_s])))
        at_rest = hover(system).x + np.concatenate(
            [reference.maneuver.path(np.array([t_s]))[0][0], np.zeros(57)]
        )
        np.testing.assert_allclose(resting.x[0], at_rest, atol=ROUNDING)
        np.testing.assert_allclose(resting.u[0], hover(system).u, atol=ROUNDING)


def test_smoothed_table_is_close_to_it() -> None:
    """Rows along a curve with millimetres of noise.

    The spline is within a millimetre of the curve, ends are kept.
    """
    times, noise = (
        np.linspace(0.0, 9.0, 181),
        np.random.default_rng(1).normal(scale=1e-3, size=(181, 3)),
    )
    noise[[0, -1]] = 0.0
    exact = CURVES["circle"].path(times)
    table = np.column_stack([times, exact[0] + noise]).tolist()
    found = Curve(kind=None, duration_s=9.0, ramp_s=0.0, table=table).path(times)
    assert np.sqrt(np.mean((found[0] - exact[0]) ** 2)) < 1e-3
    np.testing.assert_allclose(found[0, [0, -1]], exact[0, [0, -1]], atol=ROUNDING)
    assert np.abs(found[2] - exact[2]).max() < 0.1 * np.abs(exact[2]).max()


def test_outputs_are_those_of_the_model() -> None:
    """Outputs along the reference equal h(x_ref), equation (14)."""
    system = unequal()
    reference, times = (
        FlatReference(system, hover(system), along(CURVES["eight"])),
        np.linspace(0.0, 18.0, 40),
    )
    expected = [Model(system).outputs(x) for x in reference.states(times)]
    np.testing.assert_allclose(reference.outputs(times), expected, atol=ROUNDING)


def test_spline_passes_its_way_points_in_time() -> None:
    """Way points with times are passed at these times."""
    times, points = [2.0, 3.5, 5.0, 8.0], np.array([[1.0, 0, 0], [2, 1, 0], [3, -1, -1], [4, 0, 0]])
    curve = Curve(
        kind="spline", duration_s=8.0, ramp_s=1.5, points_I=points.tolist(), times_s=times
    )
    np.testing.assert_allclose(curve.path(np.array(times), 1)[0], points, atol=1e-9)


def test_formation_is_reached() -> None:
    """At rest length and width of a symmetric team are the multiples asked for, at any height.

    Equation (66a).
    """
    phases = [
        Phase(name="rest", duration_s=2.0, displacement_I=[0, 0, 0], formation=rows)
        for rows in ([[0.5, 1.0, 1.0], [1.0, 1.4, 0.3]], None)
    ]
    reference = FlatReference(
        table_1(), hover(table_1()), Maneuver(start_I=[0, 0, -9], phases=phases)
    )
    places = reference.outputs(np.array([0.0, 1.0, 2.0, 3.0]))[:, :12].reshape(4, 4, 3)
    for at, scales in zip(places, [(1, 1), (1, 1), (1.4, 0.3), (1.4, 0.3)], strict=True):
        np.testing.assert_allclose(at[:, :2], places[0, :, :2] * scales, atol=ROUNDING)


@pytest.mark.parametrize("gains", [None, [20.0, 20.0, 8.0]])
def test_reference_of_the_uavs_left_after_a_release(gains: list[float] | None) -> None:
    """All but the bob, which pulls with 1e-5 N, move by the equations of the team that is left."""
    team, bob = unequal(gains), 2
    uavs = [replace(uav, rho=rho) for uav, rho in zip(team.uavs, LEFT, strict=True)]
    team, released = replace(team, uavs=tuple(uavs)), {bob}
    at_rest, model = hover_after_failures(team, released, released), Model(team, released, released)
    system = with_released(team, released)
    maneuver, times = along(CURVES["eight"]), np.random.default_rng(4).uniform(0.0, 18.0, 40)

    def motion(t_s: Array) -> tuple[Array, Array]:
        found = flight(system, at_rest, maneuver.jets(t_s), released=released)
        return found.x, found.u

    x, u = motion(times)
    rates = difference([motion(times + STEP_S * j)[0] for j in range(-4, 5)])
    errors = np.abs(np.array([model.derivative(*row) for row in zip(x, u, strict=True)]) - rates)
    errors[:, uav_slice(bob)] = 0.0
    assert errors.max() < BOB
    assert not u[:, input_slice(bob)].any()


def test_a_formation_is_not_that_of_a_released_uav() -> None:
    """Its bob hangs straight down with its own weight, while the others stand apart, (66a)."""
    team, bob = unequal(), 2
    places = LEFT.copy()
    places[bob] = [0.1, 0.2, -0.1]
    uavs = [replace(uav, rho=rho) for uav, rho in zip(team.uavs, places, strict=True)]
    team = replace(team, uavs=tuple(uavs))
    at_rest = hover_after_failures(team, {bob}, {bob})
    path = np.zeros((7, 1, 5))
    path[0, 0, 3:] = (1.4, 0.8)
    found = flight(with_released(team, {bob}), at_rest, path, released={bob})
    rods = StateView(found.x).e_P[0]
    np.testing.assert_allclose(rods[bob], [0.0, 0.0, -1.0], atol=ROUNDING)
    assert found.tensions[0, bob] == pytest.approx(RELEASED_MASS_KG * team.gravity)
    assert np.abs(np.delete(rods, bob, axis=0)[:, :2]).max() > 0.01


def test_a_slower_path_passes_the_same_places() -> None:
    """In twice the time, the speed is half of it, the acceleration a quarter, and so on."""
    path = along(CURVES["eight"]).jets(np.linspace(0.0, 18.0, 5))
    ratios = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
    np.testing.assert_array_equal(slowed(path, 2.0) * ratios[:, None, None], path)


@pytest.mark.parametrize("drag", [False, True])
def test_track_shifts_with_forces(*, drag: bool) -> None:
    """Its derivatives with respect to forces, mass and drag, by an imaginary step, equal differences.

    Those of states belong to the instants, those of inputs to the middle after each, (73).
    """
    system = dragged(unequal()) if drag else unequal()
    reference, small = FlatReference(system, hover(system), along(CURVES["circle"])), 1e-4
    track, times_s = reference.track(30, 0.1), 0.1 * np.arange(30, dtype=np.float64)
    path, middle = (reference.maneuver.jets(at_s) for at_s in (times_s, times_s + 0.05))
    X_forces, U_forces = track.by_forces(slice(None))
    for i, unit in enumerate(small * np.eye(16 + 2 * drag)):
        ends = [flight(system, hover(system), path, sign * unit).x for sign in (1.0, -1.0)]
        np.testing.assert_allclose(X_forces[..., i], (ends[0] - ends[1]) / (2.0 * small), atol=1e-7)
        ends = [flight(system, hover(system), middle, sign * unit).u for sign in (1.0, -1.0)]
        np.testing.assert_allclose(U_forces[..., i], (ends[0] - ends[1]) / (2.0 * small), atol=1e-7)


def test_track_has_the_inputs_of_the_middle_of_each_period() -> None:
    """Held over a period T they lead the model to the next state with an error of order T^3, (70).

    Those of any other instant of the period leave an error of order T^2.
    """
    system = unequal()
    reference, model = FlatReference(system, hover(system), along(CURVES["circle"])), Model(system)

    def error(period_s: float) -> float:
        per_second = round(1.0 / period_s)
        track = reference.track(2 * per_second, period_s, first=per_second)
        ends = [model.advance(x, u, period_s, 4) for x, u in zip(track.X, track.U, strict=True)]
        return float(np.abs(np.array(ends)[:-1] - track.X[1:]).max())

    assert error(0.04) / error(0.02) == pytest.approx(2.0**3, rel=0.05)


def test_path_with_corners_is_refused() -> None:
    """A ramp has no acceleration that a team could follow."""
    corner = Maneuver(
        start_I=[0, 0, 0], phases=[Phase(name="out", duration_s=2.0, displacement_I=[1, 0, 0])]
    )
    with pytest.raises(ParameterError, match=r"expected a smooth path, .* got 'ramp'"):
        corner.jets(np.zeros(1))
