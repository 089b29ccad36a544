"""Limits of a team along a path: extremes and where they are, and the least slowing that keeps limits."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.support import runs
from transport.protocol.scenario.checks import feasibility
from transport.protocol.scenario.checks.feasibility import (
    Extreme,
    extremes,
    least_factor,
    remaining_teams,
)
from transport.protocol.scenario.checks.reference_limits import checked_instants

ACCURACY = 1e-3  # of the least factor, relative
ROUNDING = 1e-9


@pytest.mark.parametrize("needed", [1.0, 1.5, 2.0, 3.7, 63.9])
def test_the_least_factor_is_found_from_above(needed: float) -> None:
    """The factor found keeps the limits, and is at most a thousandth larger than it has to be."""
    found = least_factor(lambda factor: factor >= needed)
    assert found is not None
    assert needed <= found <= (1.0 + ACCURACY) * needed


def test_a_path_is_slowed_64_times_at_most() -> None:
    """Beyond that no factor is found."""
    assert least_factor(lambda factor: factor >= 64.1) is None


def extreme(value: float, *, is_upper: bool, instant: int = 0) -> Extreme:
    """Return an extreme of UAV2 with the bound 10."""
    return Extreme(
        quantity="a thrust of at most",
        unit=" N",
        bound=10.0,
        is_upper=is_upper,
        value=value,
        uavs=(1,),
        instant=instant,
    )


@pytest.mark.parametrize(("is_upper", "sign"), [(True, 1.0), (False, -1.0)])
def test_an_extreme_has_room_up_to_its_bound(is_upper: bool, sign: float) -> None:
    """Room is a share of the bound, on the admitted side; the bound itself is kept, no number is not."""
    inside, beyond = (
        extreme(10.0 - sign, is_upper=is_upper),
        extreme(10.0 + sign, is_upper=is_upper, instant=3),
    )
    assert (inside.room, beyond.room) == pytest.approx((0.1, -0.1))
    assert (inside.holds, beyond.holds) == (True, False)
    assert extreme(10.0, is_upper=is_upper).holds
    assert inside.joined(beyond) is beyond.joined(inside) is beyond

    nothing = extreme(math.nan, is_upper=is_upper)
    assert not nothing.holds
    assert nothing.joined(beyond) is beyond.joined(nothing) is nothing
    zero = replace(inside, bound=0.0, value=sign)
    assert zero.room == -1.0
    assert beyond.names == "UAV2"


def test_the_extremes_of_a_long_path_are_at_their_instants(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are those of the whole path, computed in parts, and the path has them at the instants told."""
    setup = runs.ready("eight")
    path = setup.maneuver.jets(checked_instants(setup.reference)[::9])
    team = next(remaining_teams(setup.system, setup.hover, setup.faults))
    whole = extremes(path, team, setup.settings)
    monkeypatch.setattr(feasibility, "_AT_ONCE", path.shape[1] // 3)
    for one, told in zip(whole, extremes(path, team, setup.settings), strict=True):
        assert (told.quantity, told.uavs, told.instant) == (one.quantity, one.uavs, one.instant)
        assert told.value == pytest.approx(one.value, rel=ROUNDING)
        there = extremes(path[:, [told.instant]], team, setup.settings)
        (alone,) = [each for each in there if each.quantity == told.quantity]
        assert alone.value == pytest.approx(told.value, rel=ROUNDING)
    assert len({one.instant for one in whole}) > 1
    assert np.isfinite([one.value for one in whole]).all()
