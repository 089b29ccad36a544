"""Targets are timed by their least duration first and by the motion between the instants, whatever the request."""

import math
import re
import tracemalloc
from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.support import runs
from tests.support.coordinator_clock import ready
from tests.support.nodes import CoordinatorNode
from transport.model.path.curves import ORDERS
from transport.protocol.scenario.checks.feasibility import exceeded, remaining_teams
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario, with_settings
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.path_instants import curve_instants
from transport.protocol.scenario.sections.scenario_errors import (
    RequestError,
    ScenarioError,
    requested,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.scenario.targets.target_timing import (
    Window,
    fastest_way,
    first_exceeded,
    straight,
    teams_flying,
)
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.message_form import MAX_TARGETS
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
    with pytest.raises(
        ScenarioError, match=rf"at most {MAX_TARGETS} targets in a run, got {MAX_TARGETS + 1}"
    ):
        runs.ready("resilient", f"maneuver.target=[{','.join([one] * (MAX_TARGETS + 1))}]")


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
    """The path of the file keeps margins between the instants, also where it jumps over the wall in one period.

    The refusal has the number of the wall in the file, where obstacles that only sight tells count as well.
    """
    fast = "maneuver.phase=[{name='dash',duration_s=2.0,displacement_m=[6,0,0]}]"
    period = "controller.sampling_period_s=0.2"
    with pytest.raises(ScenarioError, match=r"obstacle\.1: expected 0\.01 m between"):
        runs.ready("resilient", WALL, fast, period)
    seen = "obstacle=[{kind='sphere',at_m=[9.0,9.0,-10.0],radius_m=0.1,margin_m=0.1,seen_within_m=1.0},"
    with pytest.raises(ScenarioError, match=r"obstacle\.2: expected 0\.01 m between"):
        runs.ready("resilient", WALL.replace("obstacle=[", seen), fast, period)


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


# At this tick the payload of `resilient` hovers at its start, and its maneuver ends elsewhere.
HOVERS = 10
START_M = np.array([0.0, 0.0, -10.0])
END_M = np.array([2.5, 0.0, -10.0])

# Ramps of an approach that are tried: the first, and the factor to the next.
FIRST_RAMP_S = 2.0
LONGER = 1.25
INSTANTS = 500


@pytest.mark.parametrize(("way_m", "speed_mps"), [(3.0, 1.0), (5.0, 1.0), (20.0, 2.0), (20.0, 4.0)])
def test_the_shortest_ramp_that_keeps_the_limits_is_taken(way_m: float, speed_mps: float) -> None:
    """The accepted ramp keeps the limits of (69), and the one tried before it does not, (75)."""
    setup = runs.ready("resilient")
    way_I = np.array([way_m, 0.0, 0.0])
    given = {"points_m": [(START_M + way_I).tolist()], "speed_mps": speed_mps}
    ramp_s = plan(setup, HOVERS, **given)["approach_ramp_s"]
    team = next(remaining_teams(setup.system, setup.hover, setup.faults))

    def keeps_limits(ramp_s: float) -> bool:
        duration_s = max(way_m / speed_mps + ramp_s, 2.0 * ramp_s)
        times_s = np.linspace(0.0, duration_s, INSTANTS)
        covered = straight(duration_s, ramp_s).covered(times_s, ORDERS)
        return exceeded(covered[..., None] * way_I, team, setup.settings) is None

    tried = round(math.log(ramp_s / FIRST_RAMP_S, LONGER))
    assert ramp_s == pytest.approx(FIRST_RAMP_S * LONGER**tried)
    assert keeps_limits(ramp_s)
    assert tried == 0 or not keeps_limits(ramp_s / LONGER)


@pytest.mark.parametrize("x_m", [-3.0, 6.0])
def test_an_approach_is_timed_by_the_larger_distance_from_path_and_end(x_m: float) -> None:
    """Its cruise takes the larger distance over the speed, as the old motion goes on in it, (75)."""
    target_m = np.array([x_m, 0.0, -10.0])
    speed_mps = 0.8
    given = {"points_m": [target_m.tolist()], "speed_mps": speed_mps}
    numbers = plan(runs.ready("resilient"), HOVERS, **given)
    distances_m = [np.linalg.norm(target_m - place_m) for place_m in (START_M, END_M)]
    cruise_s = numbers["approach_s"] - numbers["approach_ramp_s"]
    assert cruise_s == pytest.approx(max(distances_m) / speed_mps)


HOVER = "maneuver.phase=[{name='hover',duration_s=25.0,displacement_m=[0,0,0]}]"
SINKS = (
    "maneuver.phase=[{name='sink',duration_s=0.4,displacement_m=[0,0,0.1]},"
    "{name='hover',duration_s=25.0,displacement_m=[0,0,0]}]"
)
ON_GROUND = ("plant.engine=mujoco", "plant.ground_m=-1.0")
ONE_MM = 1e-3


@pytest.mark.parametrize(
    ("settings", "lowest_m"),
    [
        ((HOVER, "maneuver.start_m=[0.0,0.0,-1.0]"), 0.0),
        ((HOVER, "maneuver.start_m=[0.0,0.0,0.5]"), 0.5),
        ((SINKS, "maneuver.start_m=[0.0,0.0,0.0]"), 0.1),
        ((HOVER, *ON_GROUND), -1.0 - 0.25 / 2.0),
    ],
    ids=["origin", "start", "here", "ground"],
)
def test_a_target_is_at_most_as_low_as_the_payload_may_be(
    settings: tuple[str, ...], lowest_m: float
) -> None:
    """On the ground is half a box of 0.25 m above it; else the lowest of origin, start and path."""
    setup = runs.ready("resilient", *settings)
    assert plan(setup, HOVERS, points_m=[[1.0, 0.0, lowest_m]])["approach_s"] > 0.0
    with pytest.raises(RequestError, match=rf"at most {lowest_m:g} m"):
        plan(setup, HOVERS, points_m=[[1.0, 0.0, lowest_m + ONE_MM]])


@pytest.mark.parametrize(
    ("to", "told"),
    [
        ([], ()),
        ([3], (3,)),
        ([3, 1, 3], (1, 3)),
        ([4, 2, 1], (1, 2, 4)),
        ([1, 1, 2, 3], (1, 2, 3)),
        ([4, 2, 1, 3], ()),
    ],
)
def test_the_agents_that_are_told_are_named_once_in_order(
    to: list[int], told: tuple[int, ...]
) -> None:
    """All agents are as none named: they are told at one tick, and no plan has to carry the target."""
    numbers = plan(runs.ready("resilient"), HOVERS, points_m=[[1.0, 0.0, -10.0]], to=to)
    assert numbers["to"] == told


def test_some_agents_alone_are_told_where_there_are_no_vehicles() -> None:
    """The process of a UAV hears all targets, so its agent does; a stranger is refused first."""
    for to, problem in (
        ([1], "expected none with [vehicles]"),
        ([5], "expected agents 1 to 4, got 5"),
    ):
        with pytest.raises(RequestError, match=f"^to: {re.escape(problem)}"):
            plan(runs.ready("flight"), points_m=[[1.0, 0.0, -10.0]], to=to)


def test_outside_a_landing_may_end_after_the_maneuver() -> None:
    """A person ends the run there; other targets are reached before the maneuver ends."""
    setup = runs.ready("flight", "plant.kind=vehicles")
    last = math.ceil(setup.maneuver.duration_s / setup.settings.sampling_period_s) - 1
    assert plan(setup, last, land=True)["tick"] == last
    with pytest.raises(RequestError, match="before the end of the maneuver at t = "):
        plan(setup, last, points_m=[[1.0, 0.0, -10.0]])


@pytest.mark.parametrize(
    ("at_s", "phase"), [(0.95, "stands"), (3.05, "up"), (6.0, None), (13.05, "down")]
)
def test_a_target_is_for_a_payload_in_flight(at_s: float, phase: str | None) -> None:
    """None is given while the payload stands, takes off or lands; the refusal has the phase and the time."""
    phases = (
        "maneuver.phase=[{name='stands',duration_s=1,displacement_m=[0,0,0]},"
        "{name='up',kind='take_off',duration_s=4,displacement_m=[0,0,-2]},"
        "{name='hovers',duration_s=8,displacement_m=[0,0,0]},"
        "{name='down',kind='land',duration_s=4,displacement_m=[0,0,2]},"
        "{name='rests',duration_s=9,displacement_m=[0,0,0]}]"
    )
    setup = runs.ready("resilient", phases, "maneuver.start_m=[0.0,0.0,-1.125]", *ON_GROUND)
    tick = round(at_s / setup.settings.sampling_period_s)
    if phase is None:
        assert plan(setup, tick, points_m=[[0.5, 0.0, -3.0]])["approach_s"] > 0.0
        return
    problem = rf"^expected a payload in flight, got phase '{phase}' at t = {at_s:.2f} s$"
    with pytest.raises(RequestError, match=problem):
        plan(setup, tick, points_m=[[0.5, 0.0, -3.0]])


LAST_S = 24.95  # the last sampling instant of a run of 25 s
TO_THE_GROUND_S = 2.0  # in which the ground takes over the weight of the payload


@pytest.mark.parametrize(
    ("given", "more_s"),
    [({"land": True}, TO_THE_GROUND_S), ({"points_m": [[1.0, 0.0, -1.0]]}, 0.0)],
)
def test_a_target_is_reached_at_the_last_instant_at_the_latest(
    given: dict[str, Any], more_s: float
) -> None:
    """A landing needs the time in which its load is handed over to the ground, too."""
    setup = runs.ready("resilient", HOVER, "maneuver.start_m=[0.0,0.0,-1.0]")
    takes_s = plan(setup, HOVERS, **given)["approach_s"] + more_s
    latest = math.floor((LAST_S - takes_s) / setup.settings.sampling_period_s + 1e-6)
    assert plan(setup, latest, **given)["tick"] == latest
    with pytest.raises(RequestError, match=r"before the end of the run at t = 24\.95 s"):
        plan(setup, latest + 1, **given)


@pytest.mark.parametrize("z_m", [0.5, -0.125])
def test_a_payload_at_or_below_the_ground_cannot_land(z_m: float) -> None:
    """It would have to rise to where it would rest; that is half a box of 0.25 m above z = 0."""
    setup = runs.ready("resilient", HOVER, f"maneuver.start_m=[0.0,0.0,{z_m}]")
    with pytest.raises(
        RequestError, match=rf"land: expected a payload above z = -0\.125 m, .*got {z_m}"
    ):
        plan(setup, HOVERS, land=True)


def test_times_of_way_points_count_from_the_first() -> None:
    """The message has a time for each point, that of the first one zero."""
    points_m = [[0.0, 0.0, -10.0], [1.0, 0.0, -10.0], [1.5, 0.0, -10.0]]
    numbers = plan(runs.ready("resilient"), points_m=points_m, times_s=[2.0, 8.0, 12.0])
    assert numbers["times"].tolist() == [0.0, 6.0, 10.0]
    assert numbers["way_s"] == 10.0


@cache
def losing() -> Setup:
    """Return a run of six UAVs of which one is released at 5 s, and one at 10 s."""
    six = resized(read_scenario(find_scenario("resilient")), Team(uavs=6), "six")
    releases = [
        f"{{at_s={at_s},do='release',target='uav{uav}'}}" for at_s, uav in ((5, 6), (10, 3))
    ]
    scenario = with_settings(six.tree(), [HOVER, f"faults.event=[{','.join(releases)}]"], "six")
    return Setup.of(scenario, "six")


@pytest.mark.parametrize(
    ("since_s", "ticks"),
    [(1.0, [0, 100, 200]), (5.0, [100, 200]), (9.95, [100, 200]), (10.0, [200])],
)
def test_a_target_is_checked_for_the_teams_from_then_on(since_s: float, ticks: list[int]) -> None:
    """The team that flies when it is given, and those after later releases; none before."""
    teams = teams_flying(losing(), Window(since_s=since_s, last_s=LAST_S))
    assert [team.tick for team in teams] == ticks


def test_times_are_feasible_by_the_factor_told() -> None:
    """The refusal has the least factor on the times with which each of the teams keeps the limits."""
    points_m = [[0.0, 0.0, -10.0], [0.7, 0.0, -10.0]]
    with pytest.raises(RequestError, match="times_s: expected a thrust") as refused:
        plan(losing(), HOVERS, points_m=points_m, times_s=[0.0, 1.0])
    factor = float(str(refused.value).rpartition("feasible in ")[2].split()[0])
    assert plan(losing(), HOVERS, points_m=points_m, times_s=[0.0, 1.002 * factor])["way_s"] > 1.0
    with pytest.raises(RequestError, match="times_s: expected"):
        plan(losing(), HOVERS, points_m=points_m, times_s=[0.0, 0.98 * factor])


def test_a_speed_that_is_too_large_is_refused_with_a_longer_time() -> None:
    """The factor on the time is above 1; a speed below the usual one is taken."""
    setup = runs.ready("resilient")
    way = {"points_m": [[0.0, 0.0, -10.0], [4.0, 0.0, -10.0], [4.0, 4.0, -10.0]]}
    with pytest.raises(RequestError, match=r"^speed_mps: expected .* times the time$") as refused:
        plan(setup, HOVERS, **way, speed_mps=8.0)
    assert float(str(refused.value).rpartition("feasible in ")[2].split()[0]) > 1.0
    assert plan(setup, HOVERS, **way, speed_mps=0.8)["way_s"] > 0.0


def test_a_short_approach_has_two_ramps() -> None:
    """It never reaches its speed, and takes as long as both ramps."""
    numbers = plan(runs.ready("resilient", HOVER), HOVERS, points_m=[[0.1, 0.0, -10.0]])
    assert numbers["approach_s"] == 2.0 * numbers["approach_ramp_s"] == 2.0 * FIRST_RAMP_S


def test_a_way_with_tight_corners_is_slowed_as_a_whole() -> None:
    """Without times and speed the way that the limits allow is taken, ramps included."""
    setup = runs.ready("resilient")
    zigzag_m = [[0.3 * number, 0.3 * (number % 2), -10.0] for number in range(6)]
    section = requested(TargetSection, {"points_m": zigzag_m})
    window = Window(since_s=0.5, last_s=LAST_S)
    way = fastest_way(setup, section, window)
    assert way.ramp_s > FIRST_RAMP_S
    path = way.path(curve_instants(way))
    assert first_exceeded(path, teams_flying(setup, window), setup) is None


def test_the_way_down_has_half_the_speed() -> None:
    """To a place at 1 m/s at most, then down at 0.5 m/s at most, in cruise between the ramps."""
    setup = runs.ready("resilient", HOVER, "maneuver.start_m=[0.0,0.0,-3.125]")
    numbers = plan(setup, HOVERS, land=True, land_at_m=[4.0, 0.0])
    assert numbers["lands"]
    assert numbers["points"].tolist() == [[4.0, 0.0, -3.125], [4.0, 0.0, -0.125]]
    assert numbers["approach_s"] - numbers["approach_ramp_s"] == pytest.approx(4.0 / 1.0)
    assert numbers["way_s"] - numbers["way_ramp_s"] == pytest.approx(3.0 / 0.5)


FAR = [[float(number), 0.0, -10.0] for number in range(255)]
HERE_AND_THERE = [[0.0, 0.0, -10.0], [1.0, 0.0, -10.0]]


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"times_s": [3.0, 3.0]}, "times_s: expected rising times"),
        ({"times_s": [3.0]}, "times_s: expected a time for each of 2 way points, got 1"),
        ({"times_s": [0.0, 9.0], "speed_mps": 1.0}, "speed_mps: expected none next to times_s"),
        ({"points_m": [HERE_AND_THERE[0]] * 2}, "points_m: expected each way point away from the"),
        ({"points_m": []}, "points_m: expected at least one point, or land = true"),
        ({"land_at_m": [1.0, 2.0]}, "land_at_m: expected none without land = true, got a place"),
        ({"land": True, "times_s": [0.0, 1.0]}, "times_s: expected speed_mps with land = true"),
        ({"points_m": FAR[:255]}, "points_m: expected a list of at most 254"),
    ],
)
def test_requests_that_contradict_themselves_are_refused(
    given: dict[str, Any], problem: str
) -> None:
    """Whatever the run, points differ and times rise, one for each point, without a speed."""
    with pytest.raises(RequestError, match=problem):
        requested(TargetSection, {"points_m": HERE_AND_THERE} | given)
    requested(TargetSection, {"points_m": FAR[:254]})


# The parabola through three points at equal distances, the first one higher by h than the others,
# is lower than them by h / 8 between the second and the third.
HIGHER_M = 0.3
DEEPER_M = HIGHER_M / 8.0
DISTANCE_M = 0.5


def test_a_curve_is_above_the_ground_between_its_points() -> None:
    """Points are refused for the depth of the curve through them, until they are raised by it."""
    setup = runs.ready("resilient", HOVER, "maneuver.start_m=[0.0,0.0,-1.0]")
    x_m = math.sqrt(DISTANCE_M**2 - HIGHER_M**2)
    points_m = np.array([[0.0, 0.0, -HIGHER_M], [x_m, 0.0, 0.0], [x_m + DISTANCE_M, 0.0, 0.0]])
    with pytest.raises(RequestError, match="at most 0 m") as refusal:
        plan(setup, HOVERS, points_m=points_m.tolist())
    got_m = float(str(refusal.value).rpartition("got ")[2])
    assert got_m == pytest.approx(DEEPER_M, rel=1e-3)  # at the instants checked

    raised_m = points_m - [0.0, 0.0, DEEPER_M]
    assert plan(setup, HOVERS, points_m=raised_m.tolist())["way_s"] > 0.0


def test_a_way_is_judged_with_the_formation_that_goes_on() -> None:
    """UAVs that move apart along a way may turn faster than their limits, though the way is slow."""
    formation = "[[0.12,1,1],[0.15,1,2.6],[0.9,1,2.6],[1,1,1]]"
    phase = f"name='hover',duration_s=40,displacement_m=[0,0,0],formation={formation}"
    gap = read_scenario(find_scenario("gap"), ["obstacle=[]", f"maneuver.phase=[{{{phase}}}]"])
    setup = Setup.of(gap, "gap")
    way = [[0.0, 0.0, -10.0], [0.0, -6.0, -10.0]]
    with pytest.raises(RequestError, match="points_m: expected a commanded rate"):
        plan(setup, points_m=way, speed_mps=5.0)
