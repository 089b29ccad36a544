"""Losses of time along a path: docs/equations.md (77)."""

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
