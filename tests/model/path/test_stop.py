"""Losses of time along a path: docs/equations.md (77)."""

from dataclasses import replace

import numpy as np
import pytest

from transport.model.path.curves import Curve
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.path.target_and_stop import PathTarget, Slowing

STEP_S = 1e-4
TOLERANCE = 1e-5  # of finite differences


def along() -> Maneuver:
    """Return a smooth path to a target, on the way of which time may be lost."""
    go = Phase(name="go", duration_s=10.0, displacement_I=np.array([6.0, 2.0, -1.0]))
    straight = Curve(kind=None, duration_s=6.0, ramp_s=2.0, size_I=(1.0, 0.0, 0.0))
    path = Maneuver(start_I=(0.0, 0.0, -10.0), phases=(go,), profile="smooth")
    return path.with_target(
        PathTarget(since_s=4.0, point_I=np.array([3.0, 3.0, -9.0]), approach=straight)
    )


@pytest.mark.parametrize("lost_s", [0.3, 2.0, 5.0])
def test_the_path_is_the_same_later(lost_s: float) -> None:
    """Before it as it was, bit for bit; afterwards by the loss later; both smooth in all derivatives used."""
    path = along()
    slowed = path.with_slowing(Slowing(since_s=5.0, lost_s=lost_s, ramp_s=2.0))
    before = np.linspace(0.0, 5.0, 51)
    assert (slowed.jets(before)[0] == path.jets(before)[0]).all()
    after = np.linspace(9.0 + lost_s, 25.0, 60)
    assert np.allclose(slowed.jets(after), path.jets(after - lost_s), atol=1e-10)

    t_s = np.linspace(4.5, 12.0, 200)
    derivative = (slowed.jets(t_s + STEP_S) - slowed.jets(t_s - STEP_S)) / (2.0 * STEP_S)
    for order in range(3):
        expected = (order + 1) * slowed.jets(t_s)[order + 1]
        assert np.abs(derivative[order] - expected).max() < TOLERANCE * 10**order


def test_it_rests_within_the_ramp() -> None:
    """A loss of more than a ramp stops the path until it goes on."""
    slowed = along().with_slowing(Slowing(since_s=5.0, lost_s=6.0, ramp_s=2.0))
    r, v = slowed.path(np.array([7.0, 9.0, 11.0]))
    assert np.abs(v).max() < 1e-12
    assert (np.abs(r - r[0]) < 1e-12).all()


def test_losses_add_up() -> None:
    """One after the other, and one while another is under way."""
    path = along()
    for since_s in (6.0, 20.0):
        slowed = path.with_slowing(Slowing(since_s=5.0, lost_s=1.0, ramp_s=2.0))
        slowed = slowed.with_slowing(Slowing(since_s=since_s, lost_s=3.0, ramp_s=2.0))
        after = np.linspace(30.0, 35.0, 11)
        assert np.allclose(slowed.jets(after), path.jets(after - 4.0), atol=1e-10)
        # The second one is by the clock: from its begin on the time along the path with the first is behind.
        once = path.with_slowing(slowed.slowings[0])
        t_s = np.array([since_s, since_s + 0.5, since_s + 1.5])
        behind = slowed.slowings[1].warped(t_s, 1)[0]
        found = [slowed.progress(float(each_s)) for each_s in t_s]
        assert found == pytest.approx([once.progress(float(each_s)) for each_s in behind])


@pytest.mark.parametrize("ahead_s", [0.0, 0.4, -0.4])
def test_path_formation_and_ground_load_follow_one_time(ahead_s: float) -> None:
    """With losses and another clock each is, at any time, what it is without losses at the progress of then.

    Before the begin of that clock it is that of the begin.
    """
    up = Phase(name="up", kind="take_off", duration_s=4.0, displacement_I=[0.0, 0.0, -2.0])
    wide = [[0.5, 1.2, 0.9], [1.0, 1.1, 1.3]]
    go = Phase(name="go", duration_s=6.0, displacement_I=[3.0, 1.0, 0.0], formation=wide)
    before = Maneuver(
        start_I=(0.0, 0.0, 0.0), phases=(up, go), profile="min_jerk", press_m=0.2, ahead_s=ahead_s
    )
    slowed = before.with_slowing(Slowing(since_s=0.5, lost_s=0.7, ramp_s=1.0))
    slowed = slowed.with_slowing(Slowing(since_s=6.0, lost_s=1.5, ramp_s=1.0))
    t_s = np.array([0.0, 0.2, 0.6, 1.0, 2.0, 5.0, 6.5, 7.0, 9.0, 14.0])
    along_s = np.array([slowed.progress(float(each_s)) for each_s in t_s])
    begins_s = max(ahead_s, 0.0)
    assert slowed.progress(0.0) + ahead_s == begins_s
    assert along_s[-1] == pytest.approx(t_s[-1] - 2.2)

    np.testing.assert_allclose(slowed.path(t_s)[0], before.path(along_s)[0], atol=1e-12)
    np.testing.assert_allclose(slowed.press(t_s)[0], before.press(along_s)[0], atol=1e-12)
    clock_s = np.maximum(t_s + ahead_s, 0.0)
    sizes, expected = slowed.formation(clock_s)[0], before.formation(along_s + ahead_s)[0]
    np.testing.assert_allclose(sizes, expected, atol=1e-12)
    ends = before.formation(np.array([4.0, 7.0, 10.0]))[0]
    np.testing.assert_allclose(ends, [[1.0, 1.0], [1.2, 0.9], [1.1, 1.3]], atol=1e-12)

    # Rates are the derivatives, losses included.
    inside = t_s[2:]
    for value in (slowed.path, slowed.press):
        slope = (value(inside + STEP_S)[0] - value(inside - STEP_S)[0]) / (2.0 * STEP_S)
        np.testing.assert_allclose(value(inside)[1], slope, atol=TOLERANCE)
    slope = (slowed.formation(inside + STEP_S) - slowed.formation(inside - STEP_S)) / (2.0 * STEP_S)
    np.testing.assert_allclose(slowed.formation(inside)[1], slope[0], atol=TOLERANCE)


@pytest.mark.parametrize("ahead_s", [0.4, -0.4])
@pytest.mark.parametrize("slows", [False, True])
def test_by_a_clock_that_is_ahead_all_is_earlier(ahead_s: float, *, slows: bool) -> None:
    """Path, formation and load of the ground at t are those of t + ahead, and of the begin before that."""
    wide = np.array([[0.5, 1.2, 0.9], [1.0, 1.1, 1.3]])
    path = along()
    (go,) = path.phases
    path = replace(path, phases=(replace(go, formation=wide),))
    straight = path.targets[0].approach
    down = PathTarget(since_s=3.0, point_I=np.zeros(3), approach=straight, lands=True)
    landing = replace(path, press_m=0.2, targets=(down,))
    if slows:
        loss = Slowing(since_s=5.0, lost_s=1.0, ramp_s=2.0)
        path, landing = path.with_slowing(loss), landing.with_slowing(loss)

    t_s = np.linspace(0.0, 14.0, 57)
    clock_s = np.maximum(t_s + ahead_s, 0.0)
    for by_clock, expected in (
        (replace(path, ahead_s=ahead_s).jets(t_s), path.jets(clock_s)),
        (replace(path, ahead_s=ahead_s).path(t_s), path.path(clock_s)),
        (replace(landing, ahead_s=ahead_s).press(t_s), landing.press(clock_s)),
    ):
        np.testing.assert_array_equal(by_clock, expected)
        assert np.ptp(expected[0], axis=0).max() > 0.1
