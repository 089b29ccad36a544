"""Targets given during the flight: the path leads to them smoothly, and stays as it was before."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from transport.model.path.curves import ORDERS, Curve
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.path.target_and_stop import PathTarget

RAMPS = Maneuver(
    start_I=[0.0, 0.0, -10.0],
    phases=[
        Phase(name="hover", duration_s=5.0, displacement_I=[0.0, 0.0, 0.0]),
        Phase(name="climb", duration_s=5.0, displacement_I=[0.0, 0.0, -2.5]),
    ],
)
EIGHT = Maneuver(
    start_I=[0.0, 0.0, -10.0],
    phases=[
        Phase(
            name="eight", duration_s=20.0, displacement_I=[0.0, 0.0, 0.0], kind="eight",
            way=Curve(kind="eight", duration_s=20.0, ramp_s=4.0, size_I=(3.0, 1.5, 0.0), laps=2.0),
        )
    ],
    profile="smooth",
)  # fmt: skip


def target(
    since_s: float, point: list[float], duration_s: float = 4.0, way: Curve | None = None
) -> PathTarget:
    """Return a target that is approached in some time."""
    approach = Curve(
        kind=None, duration_s=duration_s, ramp_s=duration_s / 2.0, size_I=(1.0, 0.0, 0.0)
    )
    return PathTarget(since_s=since_s, point_I=np.array(point), approach=approach, way=way)


WAY = Curve(kind="spline", duration_s=6.0, ramp_s=2.0, points_I=[[1.0, 0.0, 0.0], [1.0, 1.0, -1.0]])
TO = [
    target(6.0, [1.0, 2.0, -11.0]),
    target(8.0, [-2.0, 0.0, -9.0], 3.0),
    target(8.5, [3.0, 3.0, -12.0], 5.0, WAY),
]


def test_the_path_is_smooth_to_the_order_that_moments_need() -> None:
    """Each jet is the derivative of the one below (equation (75)), also where targets begin, overlap and end."""
    led = EIGHT.with_target(TO[0]).with_target(TO[1]).with_target(TO[2])
    h = 1e-4
    for t_s in (6.0, 7.0, 8.0, 8.25, 8.5, 10.9, 11.0, 13.5, 15.0, 19.5, 30.0):
        below, at, above = (led.jets(np.array([t_s + d]))[:, 0] for d in (-h, 0.0, h))
        for order in range(1, ORDERS):
            slope = (above[order - 1] - below[order - 1]) / (2.0 * h) / order
            assert np.abs(slope - at[order]).max() < 1e-5 * max(1.0, float(np.abs(at[order]).max()))
    assert (led.jets(np.array([19.5, 25.0]))[1:] == 0.0).all()
    assert np.allclose(led.jets(np.array([25.0]))[0, 0], [4.0, 4.0, -13.0])


@pytest.mark.parametrize("maneuver", [RAMPS, EIGHT], ids=["ramps", "eight"])
def test_a_target_changes_nothing_before_it_and_stays_between(maneuver: Maneuver) -> None:
    """Before a target the path is the same bit for bit.

    Then a mean of old path and target, with its velocity.
    """
    led, times_s = maneuver.with_target(TO[0]), np.linspace(0.0, 20.0, 401)
    (before, _), (path, velocity) = maneuver.path(times_s), led.path(times_s)
    assert (path[times_s <= 6.0] == before[times_s <= 6.0]).all()
    assert (path[times_s >= 10.0] == TO[0].point_I).all()
    low, high = np.minimum(before, TO[0].point_I), np.maximum(before, TO[0].point_I)
    after = times_s > 6.0
    assert (path >= low - 1e-12)[after].all()
    assert (path <= high + 1e-12)[after].all()
    moved = np.cumsum((velocity[1:] + velocity[:-1]) / 2.0, axis=0) * (times_s[1] - times_s[0])
    assert np.abs(path[0] + moved - path[1:]).max() < 0.05  # ramps have corners
    assert ("target", 6.0, 10.0) in led.stages()
    assert led.phase_at(7.0).name == "target"


END_S = 10.0  # of the phases of `RAMPS`


@pytest.mark.parametrize(
    "targets",
    [
        [],
        [target(2.0, [1.0, 0.0, -10.0])],  # ends in the second phase
        [target(5.0, [1.0, 0.0, -10.0])],  # begins with it
        [target(6.0, [1.0, 0.0, -10.0])],  # ends with it
        [target(8.0, [1.0, 0.0, -10.0])],  # ends after it
        [target(2.0, [1.0, 0.0, -10.0]), target(4.0, [2.0, 0.0, -10.0], 3.0)],  # on the way
        [target(1.0, [1.0, 0.0, -10.0], 3.0), target(6.0, [2.0, 0.0, -10.0], 3.0)],  # at rest
    ],
    ids=["none", "within", "boundary", "end", "beyond", "replaced", "two"],
)
def test_the_stages_of_a_flight_follow_each_other(targets: list[PathTarget]) -> None:
    """Each begins where the one before it ends, and is the phase at its first and last instant."""
    maneuver = Maneuver(start_I=RAMPS.start_I, phases=RAMPS.phases, targets=targets)
    stages = maneuver.stages()
    assert stages[0][1] == 0.0
    assert stages[-1][2] == max([END_S, *(one.ends_s for one in targets)])
    assert all(before[2] == after[1] for before, after in pairwise(stages))
    for name, begin_s, end_s in stages:
        assert begin_s < end_s
        last_s = float(np.nextafter(end_s, 0.0))
        assert [maneuver.phase_at(t_s).name for t_s in (begin_s, last_s)] == [name, name]


def test_a_braking_target_rests_on_the_path_before_and_goes_on_from_there() -> None:
    """Smooth to the highest order where it begins and rests, without a way back, by half its time: (78)."""
    shape = Curve(
        kind="spline", duration_s=12.0, ramp_s=3.0, points_I=((6.0, 1.0, 0.0), (12.0, 0.0, -1.0))
    )
    go = Phase(name="go", duration_s=12.0, displacement_I=(12.0, 0.0, -1.0), way=shape)
    before = Maneuver(start_I=(0.0, 0.0, -10.0), phases=[go])
    rest_I = before.path(np.array([6.0]))[0][0]
    approach = Curve(kind=None, duration_s=2.0, ramp_s=1.0, size_I=(1.0, 0.0, 0.0))
    way = Curve(
        kind="spline", duration_s=8.0, ramp_s=2.0, points_I=((0.0, 3.0, 0.0), (4.0, 3.0, 0.0))
    )
    target = PathTarget(since_s=5.0, point_I=rest_I, approach=approach, way=way, brakes=True)
    after = before.with_target(target)

    t_s = np.linspace(0.0, 5.0, 50)
    np.testing.assert_array_equal(after.jets(t_s), before.jets(t_s))
    for instant_s in (5.0, 7.0):
        sides_s = instant_s + np.array([-1e-4, 1e-4])
        first, second = np.moveaxis(after.jets(sides_s)[:4], 1, 0)
        np.testing.assert_allclose(first, second, atol=1e-3)
    # On the same curve all the time, and never back.
    braking_s = np.linspace(5.0, 7.0, 200)
    r_I, v_I = after.path(braking_s)
    on_curve, _ = before.path(np.linspace(5.0, 6.0, 20_001))
    away = np.linalg.norm(r_I[:, None] - on_curve, axis=2).min(axis=1)
    assert away.max() < 1e-4
    _, along = before.path(np.array([5.5]))
    assert (v_I @ along[0]).min() > -1e-9
    np.testing.assert_allclose(after.path(np.array([7.0]))[0][0], rest_I, atol=1e-12)
    np.testing.assert_allclose(after.path(np.array([7.0]))[1][0], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        after.path(np.array([15.0]))[0][0], np.add(rest_I, [4.0, 3.0, 0.0]), atol=1e-9
    )

    # One that begins later than it was made for still comes to a rest there, without a jump.
    late = before.with_target(replace(target, since_s=5.6))
    sides_s = 7.6 + np.array([-1e-4, 1e-4])
    r_I, v_I = late.path(sides_s)
    np.testing.assert_allclose(r_I, [rest_I, rest_I], atol=1e-6)
    np.testing.assert_allclose(v_I, 0.0, atol=1e-3)


def test_many_braking_targets_take_linear_work() -> None:
    """A path with 60 of them, each along that before, is evaluated at once: it does not double with each."""
    path = Maneuver(
        start_I=(0.0, 0.0, -10.0),
        phases=[Phase(name="h", duration_s=40.0, displacement_I=np.zeros(3))],
    )
    approach = Curve(kind=None, duration_s=2.0, ramp_s=1.0, size_I=(1.0, 0.0, 0.0))
    for number in range(60):
        point_I = np.array([0.01 * number, 0.0, -10.0])
        path = path.with_target(
            PathTarget(since_s=0.5 * number, point_I=point_I, approach=approach, brakes=True)
        )
    r_I, _ = path.path(np.array([0.0, 39.0]))
    np.testing.assert_allclose(r_I[1], [0.59, 0.0, -10.0], atol=1e-9)


def test_a_landing_has_its_own_stages() -> None:
    """On the way and on the ground, each as long as it lasts."""
    down = replace(TO[0], lands=True)  # from 6 s to 10 s
    landing = Maneuver(start_I=RAMPS.start_I, phases=[*RAMPS.phases, *RAMPS.phases], targets=[down])
    names = [name for name, _, _ in landing.stages()]
    assert names == ["hover", "climb", "landing", "landed"]
    assert [landing.phase_at(t_s).name for t_s in (5.5, 7.0, 12.0)] == names[1:]
    assert landing.phase_at(7.0).duration_s == 4.0


def test_a_curve_after_a_rest_is_smooth_by_any_profile() -> None:
    """The rest has no way that could have corners, and nothing on a path that begins in flight is pressed."""
    rest = Phase(name="rest", duration_s=1.0, displacement_I=[0.0, 0.0, 0.0])
    for phases in ([rest, *EIGHT.phases], [*EIGHT.phases, rest]):
        path = replace(EIGHT, phases=tuple(phases), profile="ramp", press_m=0.2)
        assert path.jets(np.array([4.0])).shape == (ORDERS, 1, 3)
        assert not np.any(path.press(np.linspace(0.0, 20.0, 5)))
