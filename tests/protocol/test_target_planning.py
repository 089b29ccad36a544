"""Targets are timed by their least duration first and by the motion between the instants, whatever the request."""

import tracemalloc
from typing import Any

import pytest

from tests.support import runs
from tests.support.coordinator_clock import ready
from tests.support.nodes import CoordinatorNode
from transport.protocol.scenario.errors import RequestError, ScenarioError, requested
from transport.protocol.scenario.maneuver_sections import TargetSection
from transport.protocol.scenario.target_planning import target_fields
from transport.protocol.scenario.targets import MOST
from transport.protocol.wire.messages import Request

# Memory that the refusal of a target may take. Two million sampling instants of the path took 500 MB.
MOST_BYTES = 20e6

TOO_LONG = [
    {"points_m": [[1e5, 0.0, -10.0]]},
    {"points_m": [[0.0, 0.0, -10.0], [1e5, 0.0, -10.0]]},
    {"points_m": [[100.0, 0.0, -10.0]], "speed_mps": 1e-3},
    {"points_m": [[0.0, 0.0, -10.0], [9.0, 0.0, -10.0]], "speed_mps": 1e-4},
    # A file with its times in ms.
    {
        "points_m": [[0.0, 0.0, -10.0], [1.0, 0.0, -10.0], [1.0, 1.0, -10.0]],
        "times_s": [0.0, 5e4, 1e5],
    },
]


def plan(setup: Any, tick: int = 10, **given: Any) -> dict[str, Any]:
    """Return the numbers of the message for a target."""
    return target_fields(setup, requested(TargetSection, given), tick)


@pytest.mark.parametrize("given", TOO_LONG)
def test_a_target_beyond_the_run_is_refused_before_its_path_is_sampled(
    given: dict[str, Any],
) -> None:
    """The least duration of a target is compared with the rest of the run first: the refusal takes no memory."""
    setup = runs.ready("resilient")
    node = CoordinatorNode(setup, observers=())
    for name in ("plant", "agent1", "agent2", "agent3", "agent4"):
        node.receive(ready(name), 0)

    replies: list[Any] = []
    tracemalloc.start()
    node.receive(Request("target", given, replies.append), 0)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert "expected a target before the end of the run at t = 24.95 s" in replies[0]["error"]
    assert most_bytes < MOST_BYTES


def test_a_scripted_target_beyond_the_run_is_refused_with_the_scenario() -> None:
    """A target of a scenario is checked in the same order as that of a command."""
    target = "maneuver.target=[{at_s=2,points_m=[[100,0,-10]],speed_mps=0.001}]"
    tracemalloc.start()
    with pytest.raises(ScenarioError, match=r"before the end of the run at t = 24\.95 s"):
        runs.ready("resilient", target)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < 3 * MOST_BYTES  # the scenario and its model besides


def test_the_work_of_a_target_does_not_grow_with_its_duration() -> None:
    """An accepted target far away takes as few instants as a near one: ticks stay open meanwhile."""
    setup = runs.ready("playground")
    plan(setup, points_m=[[1.0, 0.0, -10.0]])  # what is computed once

    tracemalloc.start()
    numbers = plan(setup, points_m=[[0.0, 0.0, -10.0], [800.0, 0.0, -10.0]], speed_mps=0.5)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert numbers["way_s"] > 1600.0
    assert most_bytes < MOST_BYTES


def test_the_number_of_scripted_targets_is_limited() -> None:
    """A scenario has as many targets as a coordinator announces, so a list of any length is refused at once."""
    one = "{at_s=1.0,points_m=[[0,0,-10]]}"
    with pytest.raises(ScenarioError, match=rf"at most {MOST} targets in a run, got {MOST + 1}"):
        runs.ready("resilient", f"maneuver.target=[{','.join([one] * (MOST + 1))}]")


@pytest.mark.parametrize("duration_s", [1e-6, 0.01, 0.04, 0.05, 0.1, 0.11, 0.5])
def test_way_points_within_a_few_sampling_periods_keep_the_limits(duration_s: float) -> None:
    """60 m take several seconds, whatever the number of sampling instants in the time given."""
    times_s = [0.0, duration_s]
    with pytest.raises(RequestError, match=r"^(times_s: .* times the time|points_m: expected)"):
        plan(runs.ready("resilient"), points_m=[[0, 0, -10.0], [60.0, 0, -10.0]], times_s=times_s)


@pytest.mark.parametrize("times_s", [[0.0, 1e-9, 8.0], [0.0, 7.9999999, 8.0]])
def test_way_points_at_the_same_place_of_the_ramp_are_refused(times_s: list[float]) -> None:
    """Times near the rest at both ends, where a way point would need endless speed, are refused in words."""
    points_m = [[0.0, 0.0, -10.0], [1.0, 0.0, -10.0], [2.0, 0.0, -10.0]]
    with pytest.raises(RequestError, match=r"^(points_m|times_s): expected"):
        plan(runs.ready("resilient"), points_m=points_m, times_s=times_s)


WALL = "obstacle=[{kind='box',at_m=[3.0,0.0,-10.0],size_m=[0.01,40.0,40.0],margin_m=0.01}]"


def test_a_way_through_an_obstacle_between_two_instants_is_refused() -> None:
    """A wall thinner than the way of one sampling period is seen."""
    setup = runs.ready("resilient", WALL, "controller.sampling_period_s=0.2")
    with pytest.raises(RequestError, match=r"points_m: expected 0\.01 m between UAV"):
        plan(setup, tick=5, points_m=[[6.0, 0.0, -10.0]], speed_mps=1.0)
    assert plan(setup, tick=5, points_m=[[2.0, 0.0, -10.0]])["approach_s"] > 0.0


def test_a_maneuver_through_a_wall_between_two_instants_is_refused() -> None:
    """The path of the file keeps margins between the instants, also where it jumps over the wall in one period."""
    fast = "maneuver.phase=[{name='dash',duration_s=2.0,displacement_m=[6,0,0]}]"
    period = "controller.sampling_period_s=0.2"
    with pytest.raises(ScenarioError, match=r"obstacle\.1: expected 0\.01 m between"):
        runs.ready("resilient", WALL, fast, period)


def test_a_flat_maneuver_keeps_the_limits_between_the_instants() -> None:
    """A spline of 60 m within one sampling period is refused as one in seconds is."""
    phase = (
        "maneuver.phase=[{name='w',duration_s=2.0,displacement_m=[0,0,0]},"
        "{name='s',kind='spline',points_m=[[60,0,0]],times_s=[%g],ramp_s=%g},"
        "{name='h',duration_s=8.0,displacement_m=[0,0,0]}]"
    )
    for duration_s in (0.04, 0.4):
        with pytest.raises(ScenarioError, match=r"maneuver\.phase.*feasible if|expected"):
            runs.ready("eight", phase % (duration_s, duration_s / 2.0))
