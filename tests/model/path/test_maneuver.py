"""The path of the payload and the references that follow from it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.paper_form import K
from tests.support.systems import paper_maneuver
from transport.model.arrays import Array, ShapeError
from transport.model.linear.linearisation import Model
from transport.model.path.curves import Curve
from transport.model.path.hover_reference import HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase, PhaseKind, Profile
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.hover import hover
from transport.model.physics.parameters import ParameterError, table_1
from transport.model.state import StateView

PROFILES: list[Profile] = ["ramp", "min_jerk", "step"]
# Sums of a few displacements of metres.
PATH_TOLERANCE_M = 1e-13
# Central differences: step^2 / 6 times the third derivative of the path, up to 3 m/s^3, plus
# rounding / step.
DIFFERENCE_STEP_S = 1e-4
SPEED_TOLERANCE = 1e-7
# Before the end of a phase, where a step has not yet made its next jump, and how far 1 m/s gets in
# that time.
JUST_BEFORE_S = 1e-12
JUST_BEFORE_M = 2e-12
# Positions of 10 m through one rotation and a few products.
OUTPUT_TOLERANCE_M = 1e-13


def two_legs(profile: Profile) -> Maneuver:
    """A leg with all three components, then a different one: 2 s and 3 s."""
    return Maneuver(
        start_I=[1.0, 2.0, -3.0],
        phases=[
            Phase(name="out", duration_s=2.0, displacement_I=[1.0, -0.5, 0.25]),
            Phase(name="on", duration_s=3.0, displacement_I=[0.0, 2.0, -1.0]),
        ],
        profile=profile,
    )


def test_paper_maneuver_passes_its_way_points() -> None:
    """Hover, 2.5 m up, 2.5 m along x, 2.5 m down, hover, 5 s each, from 10 m height (paper, section V-A)."""
    maneuver = paper_maneuver()
    r, _ = maneuver.path(np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0]))
    expected = [
        [0.0, 0.0, -10.0],
        [0.0, 0.0, -10.0],
        [0.0, 0.0, -12.5],
        [2.5, 0.0, -12.5],
        [2.5, 0.0, -10.0],
        [2.5, 0.0, -10.0],
    ]
    assert r == pytest.approx(np.array(expected), abs=PATH_TOLERANCE_M)
    assert maneuver.duration_s == 25.0
    assert [phase.name for phase in maneuver.phases] == [
        "hover",
        "climb",
        "translate",
        "descend",
        "hover",
    ]


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_ends_where_the_phases_add_up(profile: Profile) -> None:
    """Positions at the ends of phases do not depend on the profile.

    Before and after, the path stands still.
    """
    r, v = two_legs(profile).path(np.array([-1.0, 2.0 - JUST_BEFORE_S, 5.0, 100.0]))
    assert r[1] == pytest.approx([2.0, 1.5, -2.75], abs=JUST_BEFORE_M)
    assert r[[0, 2, 3]] == pytest.approx(
        np.array([[1.0, 2.0, -3.0], [2.0, 3.5, -3.75], [2.0, 3.5, -3.75]]), abs=PATH_TOLERANCE_M
    )
    assert not v[[0, 2, 3]].any()


def test_the_formation_changes_from_row_to_row_of_its_phase() -> None:
    """Each row ends at its share of the phase, wherever in the maneuver that begins."""
    rows = [[0.25, 1.0, 2.0], [1.0, 3.0, 4.0]]
    phase = Phase(name="go", duration_s=8.0, displacement_I=[3.0, 0.0, 0.0], formation=rows)
    first, second = phase.formation_steps(start_s=3.0)
    assert (first.begin_s, first.span_s, [*first.sizes]) == (3.0, 2.0, [1.0, 2.0])
    assert (second.begin_s, second.span_s, [*second.sizes]) == (5.0, 6.0, [3.0, 4.0])


@pytest.mark.parametrize("profile", PROFILES)
def test_velocity_is_the_derivative_of_the_path(profile: Profile) -> None:
    """Inside the phases v = dr/dt, by central differences; a step stands still there."""
    maneuver = two_legs(profile)
    t = np.concatenate([np.linspace(0.1, 1.9, 19), np.linspace(2.1, 4.9, 29)])
    _, v = maneuver.path(t)
    ahead, behind = maneuver.path(t + DIFFERENCE_STEP_S)[0], maneuver.path(t - DIFFERENCE_STEP_S)[0]
    assert v == pytest.approx((ahead - behind) / (2.0 * DIFFERENCE_STEP_S), abs=SPEED_TOLERANCE)
    assert v.any() == (profile != "step")


def test_min_jerk_is_the_fifth_order_polynomial() -> None:
    """s = 10 c^3 - 15 c^4 + 6 c^5, docs/equations.md (20).

    Checked away from the ends, where symmetry says less.
    """
    c = np.array([0.1, 0.3, 0.8])
    r, _ = two_legs("min_jerk").path(2.0 * c)
    share = 10.0 * c**3 - 15.0 * c**4 + 6.0 * c**5
    assert r - [1.0, 2.0, -3.0] == pytest.approx(
        np.outer(share, [1.0, -0.5, 0.25]), abs=PATH_TOLERANCE_M
    )


def rods_leaning() -> Array:
    """Rods of Table I leaning outwards by some degrees, on lines through one point, (4, 3)."""
    rods = np.array([2.0 * K - uav.rho for uav in table_1().uavs])
    return np.asarray(rods / np.linalg.norm(rods, axis=1, keepdims=True))


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("leaning", [False, True])
def test_reference_outputs_are_those_of_the_reference_states(
    profile: Profile, leaning: bool
) -> None:
    """y_ref(t) = h(x_ref(t)) of paper (12).

    What is weighted and what is linearised about do not drift apart.
    """
    system = table_1()
    at = hover(system, rods_leaning() if leaning else None)
    reference = HoverReference(system, at, two_legs(profile))
    model = Model(system)
    t = np.linspace(-0.5, 6.0, 27)
    outputs = np.array([model.outputs(x) for x in reference.states(t)])
    assert reference.outputs(t) == pytest.approx(outputs, abs=OUTPUT_TOLERANCE_M)


def test_reference_states_move_along_the_path() -> None:
    """x_ref is the hover state at r0(t) with velocity r0'(t), payload level; C f then gives y_ref'."""
    system = table_1()
    at = hover(system)
    reference = HoverReference(system, at, two_legs("min_jerk"))
    t = np.linspace(0.0, 5.0, 11)
    r, v = reference.maneuver.path(t)
    states = reference.states(t)
    view = StateView(states)
    assert np.array_equal(view.r0_I, r)
    assert np.array_equal(view.v0_P, v)
    states[:, :6] = at.x[:6]
    assert np.array_equal(states, np.tile(at.x, (11, 1)))


def test_impossible_phases_are_refused() -> None:
    """No vector: the text has the name, what was expected and what came."""
    with pytest.raises(
        ShapeError, match=r"phase 'climb' displacement: expected shape \(3\), got \(2\)"
    ):
        Phase(name="climb", duration_s=1.0, displacement_I=[0.0, 1.0])
    with pytest.raises(ShapeError, match="maneuver start: expected finite numbers, got nan"):
        Maneuver(start_I=[0.0, 0.0, float("nan")], phases=paper_maneuver().phases)
    with pytest.raises(ParameterError, match="maneuver: expected at least one phase, got none"):
        Maneuver(start_I=[0.0, 0.0, 0.0], phases=[])


def delivery(press_m: float = 0.2) -> Maneuver:
    """From the ground up, along, and down to the ground again."""
    return Maneuver(
        start_I=[0.0, 0.0, -0.125],
        phases=[
            Phase(name="up", kind="take_off", duration_s=4.0, displacement_I=[0.0, 0.0, -2.0]),
            Phase(name="along", duration_s=3.0, displacement_I=[3.0, 0.0, 0.0]),
            Phase(name="down", kind="land", duration_s=8.0, displacement_I=[0.0, 0.0, 2.0]),
            Phase(name="rest", duration_s=2.0, displacement_I=[0.0, 0.0, 0.0]),
        ],
        profile="ramp",
        press_m=press_m,
    )


def test_the_payload_stands_while_its_weight_goes_over() -> None:
    """In the first quarter of a take-off and the last of a landing the path stands still, and is smooth in between."""
    maneuver = delivery()
    r, v = maneuver.path(np.array([0.0, 0.5, 1.0, 4.0, 7.0, 13.0, 14.0, 17.0]))
    assert r[:, 2] == pytest.approx(
        [-0.125, -0.125, -0.125, -2.125, -2.125, -0.125, -0.125, -0.125]
    )
    assert np.abs(v[[0, 1, 2, 5, 6, 7], 2]).max() == 0.0
    # The fastest: half-way.
    assert maneuver.path(np.array([2.5]))[1][0, 2] == pytest.approx(-2.0 / 3.0 * 15.0 / 8.0)


def test_what_controllers_follow_is_below_the_path_on_the_ground() -> None:
    """From `press_m` to nothing and back, for all outputs of height and their rates alike."""
    times_s = np.linspace(0.0, 17.0, 341)
    maneuver = delivery()
    depth, rate = maneuver.press(times_s)
    assert depth[times_s == 0.0] == depth[-1] == 0.2
    assert np.abs(depth[(times_s >= 1.0) & (times_s <= 13.0)]).max() < PATH_TOLERANCE_M
    ahead, behind = (
        maneuver.press(times_s + step)[0] for step in (DIFFERENCE_STEP_S, -DIFFERENCE_STEP_S)
    )
    assert np.abs((ahead - behind) / (2.0 * DIFFERENCE_STEP_S) - rate).max() < SPEED_TOLERANCE
    system = table_1()
    reference = HoverReference(system, hover(system), maneuver)
    y, x = reference.followed(times_s)
    flown_y, flown_x = reference.outputs(times_s), reference.states(times_s)
    lower = np.zeros(system.p)
    lower[[2, 5, 8, 11, -4]] = 1.0
    faster = np.zeros(system.p)
    faster[-1] = 1.0
    np.testing.assert_allclose(
        y - flown_y, np.outer(depth, lower) + np.outer(rate, faster), atol=PATH_TOLERANCE_M
    )
    assert (x - flown_x)[:, [2, 5]] == pytest.approx(np.column_stack([depth, rate]))
    assert np.abs(np.delete(x - flown_x, [2, 5], axis=1)).max() == 0.0


def test_curves_carry_no_weight_to_or_from_the_ground() -> None:
    """Between take-off and landing the reference stays on the path, also along a circle: (59)."""
    circle = Curve(kind="circle", duration_s=3.0, ramp_s=1.0, size_I=(1.0, 1.0, 0.0))
    up, along, down, rest = delivery().phases
    turn = Phase(name="turn", kind="circle", duration_s=3.0, displacement_I=[0, 0, 0], way=circle)

    straight = Maneuver(start_I=[0, 0, -0.125], phases=[up, along, down, rest], press_m=0.2)
    turning = Maneuver(start_I=[0, 0, -0.125], phases=[up, turn, down, rest], press_m=0.2)
    times_s = np.linspace(0.0, 17.0, 341)
    for expected, actual in zip(straight.press(times_s), turning.press(times_s), strict=True):
        np.testing.assert_array_equal(actual, expected)


APPROACH = Curve(kind=None, duration_s=4.0, ramp_s=2.0, size_I=(1.0, 0.0, 0.0))


def test_a_landing_after_a_target_does_not_press() -> None:
    """Before the target the reference is pressed as without it, then it stays on the path, (59)."""
    given_s = 6.0  # in flight
    aside = PathTarget(since_s=given_s, point_I=np.array([1.0, 1.0, -2.0]), approach=APPROACH)
    times_s = np.linspace(0.0, 17.0, 341)
    before = times_s <= given_s
    again = replace(aside, since_s=14.5)  # where the ground would take the weight
    landing, led = delivery(), delivery().with_target(aside).with_target(again)
    for expected, actual in zip(landing.press(times_s), led.press(times_s), strict=True):
        np.testing.assert_array_equal(actual[before], expected[before])
        assert np.abs(actual[~before]).max() < PATH_TOLERANCE_M
        assert np.abs(expected[~before]).max() > PATH_TOLERANCE_M


@pytest.mark.parametrize("lands", [False, True], ids=["aside", "faster down"])
def test_a_landing_that_a_later_target_replaces_does_not_press(*, lands: bool) -> None:
    """The reference is pressed by the newest target alone, as deep as by a landing without the one before, (59)."""
    down = PathTarget(
        since_s=5.0, point_I=np.array([0.0, 0.0, -0.125]), approach=APPROACH, lands=True
    )
    place = [1.0, 1.0, -0.125 if lands else -2.0]
    newest = PathTarget(since_s=6.0, point_I=np.array(place), approach=APPROACH, lands=lands)
    times_s = np.linspace(0.0, 17.0, 341)
    replaced, alone = (
        delivery().with_target(down).with_target(newest),
        delivery().with_target(newest),
    )
    for expected, actual in zip(alone.press(times_s), replaced.press(times_s), strict=True):
        np.testing.assert_allclose(actual, expected, atol=PATH_TOLERANCE_M)
    assert replaced.press(times_s)[0][-1] == pytest.approx(0.2 if lands else 0.0)


@pytest.mark.parametrize("kind", ["move", "circle", "land"])
@pytest.mark.parametrize("rests", [False, True])
def test_after_a_landing_comes_a_take_off(kind: PhaseKind, *, rests: bool) -> None:
    """A payload on the ground is not dragged along, also after a rest."""
    down = Phase(name="down", kind="land", duration_s=8.0, displacement_I=[0.0, 0.0, 2.0])
    rest = Phase(name="rest", duration_s=1.0, displacement_I=[0.0, 0.0, 0.0])
    turn = Curve(kind="circle", duration_s=3.0, ramp_s=1.0, size_I=(1.0, 1.0, 0.0))
    along = Phase(
        name="along",
        kind=kind,
        duration_s=3.0,
        displacement_I=[0.0 if kind == "circle" else 3.0, 0.0, 0.0],
        way=turn if kind == "circle" else None,
    )
    phases = [down, rest, along] if rests else [down, along]
    with pytest.raises(
        ParameterError, match="phase 'along': expected a take-off, or no way, after a landing"
    ):
        Maneuver(start_I=[0.0, 0.0, -2.125], phases=phases)

    up = Phase(name="up", kind="take_off", duration_s=8.0, displacement_I=[0.0, 0.0, -2.0])
    again = Maneuver(start_I=[0.0, 0.0, -2.125], phases=[*phases[:-1], up, along])
    assert again.phases[-1] is along


SPLINE = Curve(
    kind="spline", duration_s=6.0, ramp_s=2.0, times_s=[2.0, 6.0], points_I=[[1, 0, 0], [2, 1, 0]]
)


@pytest.mark.parametrize("way", [None, SPLINE], ids=["straight", "spline"])
def test_a_longer_phase_is_the_same_way_slower(way: Curve | None) -> None:
    """At a time that is longer by the factor it is at the same place; the other phases take as long as before."""
    rest = Phase(name="rest", duration_s=2.0, displacement_I=[0.0, 0.0, 0.0])
    end = Phase(name="end", duration_s=3.0, displacement_I=[0.0, 1.0, 0.0])
    go = Phase(name="go", duration_s=6.0, displacement_I=[2.0, 1.0, 0.0], way=way)
    before = Maneuver(start_I=[0.0, 0.0, -9.0], phases=[rest, go, end], profile="min_jerk")
    after = before.with_longer(2, 1.5)
    assert [phase.duration_s for phase in after.phases] == [2.0, 9.0, 3.0]

    t_s = np.linspace(0.0, 6.0, 31)
    r, v = before.path(2.0 + t_s)
    slower_r, slower_v = after.path(2.0 + 1.5 * t_s)
    np.testing.assert_allclose(slower_r[:-1], r[:-1], atol=PATH_TOLERANCE_M)
    np.testing.assert_allclose(1.5 * slower_v[:-1], v[:-1], atol=PATH_TOLERANCE_M)
    for each_s in (1.0, 9.5):
        later_s = each_s if each_s < 2.0 else each_s + 3.0
        np.testing.assert_allclose(
            after.path(np.array([later_s])), before.path(np.array([each_s])), atol=PATH_TOLERANCE_M
        )


def test_along_a_table_the_speed_is_constant_between_rows() -> None:
    """At a row it is that of the way ahead, and none before the first row and from the last one on."""
    table = [[0.0, 0.0, 0.0, 0.0], [1.0, 2.0, 0.0, 0.0], [3.0, 2.0, -1.0, 0.5]]
    phase = Phase(name="go", duration_s=3.0, displacement_I=[2.0, -1.0, 0.5], way=table)
    maneuver = Maneuver(start_I=[0.0, 0.0, 0.0], phases=[phase])
    r, v = maneuver.path(np.array([-0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0]))
    still, along, across = [0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, -0.5, 0.25]
    np.testing.assert_array_equal(v, [still, along, along, across, across, still, still])
    half, end = [2.0, -0.5, 0.25], [2.0, -1.0, 0.5]
    np.testing.assert_array_equal(r, [still, still, [1.0, 0.0, 0.0], along, half, end, end])


@pytest.mark.parametrize(
    ("field", "rows", "text"),
    [
        ("way", [[0, 0, 0, 0]], "expected rows from"),
        ("way", [[0, 0, 0, 0], [2, 1, 0, 0], [3, 1, 1, 1]], "expected rows from"),
        ("way", [[0, 0, 1, 0], [3, 1, 0, 0]], "expected rows from"),
        ("way", [[0, 0, 0, 0], [3, 1 + 1e-6, 0, 0]], "expected rows from"),
        ("way", [[0, 0, 0, 0], [2, 1, 0, 0], [2, 1, 0, 0], [3, 1, 0, 0]], "row 3: .* > 2 s, got 2"),
        ("formation", [[0.0, 1, 1]], "expected rows of shares"),
        ("formation", [[0.5, 1, 1], [0.5, 2, 1]], "expected rows of shares"),
        ("formation", [[1.1, 1, 1]], "expected rows of shares"),
        ("formation", [[1.0, 0.0, 1]], "expected rows of shares"),
        ("formation", [[1.0, 1, -1.0]], "expected rows of shares"),
    ],
)
def test_impossible_tables_are_refused(field: str, rows: list[list[float]], text: str) -> None:
    """A table leads from zero to the end of its phase in rising times; shares rise to 1 at most, sizes are positive."""
    table: dict[str, Any] = {field: rows}
    with pytest.raises(ParameterError, match=f"phase 'go' {field}: .*{text}|{text}"):
        Phase(name="go", duration_s=3.0, displacement_I=[1.0, 0.0, 0.0], **table)


def test_a_table_of_two_rows_is_a_straight_way() -> None:
    """From its start to its end, which may differ from that of the phase by rounding."""
    table = [[0.0, 0.0, 0.0, 0.0], [3.0, 1.0 + 1e-12, 0.0, 0.0]]
    phase = Phase(name="go", duration_s=3.0, displacement_I=[1.0, 0.0, 0.0], way=table)
    r, v = Maneuver(start_I=[0.0, 0.0, 0.0], phases=[phase]).path(np.array([1.5]))
    assert r[0] == pytest.approx([0.5, 0.0, 0.0])
    assert v[0] == pytest.approx([1.0 / 3.0, 0.0, 0.0])
