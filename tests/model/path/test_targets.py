"""Targets given during the flight: the path leads to them smoothly, and stays as it was before."""

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
        [target(8.0, [1.0, 0.0, -10.0])],  # ends after it
        [target(2.0, [1.0, 0.0, -10.0]), target(4.0, [2.0, 0.0, -10.0], 3.0)],  # on the way
        [target(1.0, [1.0, 0.0, -10.0], 3.0), target(6.0, [2.0, 0.0, -10.0], 3.0)],  # at rest
    ],
    ids=["none", "within", "boundary", "beyond", "replaced", "two"],
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
