"""Obstacles that only sight tells (docs/equations.md, "Obstacles seen in flight")."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support import logs, runs
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.physics.obstacles import clearances
from transport.model.state import R0
from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.admission.targets_in_plans import carried_by, check_carried, is_of_sight
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import (
    Measurement,
    Note,
    Plan,
    PlantState,
    Target,
)

# 12 m at 1.5 m/s, along x and y, and time for a way round.
GO = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='go',kind='spline',points_m=[[9.6,7.2,0]],speed_mps=1.5,ramp_s=2.0},"
    "{name='hover',duration_s=%g,displacement_m=[0,0,0]}]"
)
MARGIN_M, LOAD_MARGIN_M, SIGHT_M = 0.4, 0.1, 3.0
LATE = "links.delay_s=0.2", "links.loss=0.3"
ARRIVED_M = 0.1
SEEN_S = 3.9  # instant at which the first agent sees a wall 7 m along the path
TRACKED_M = 0.3  # payload error rms; that towards the path through the wall is 1.7 m


def wall(along_m: float, wide_m: float, heading_deg: float = 0.0, *, seen: bool = True) -> str:
    """Return a wall across the path, along it by a length, turned from square to it."""
    heading = heading_deg + math.degrees(math.atan2(7.2, 9.6))
    sight = f",seen_within_m={SIGHT_M}" if seen else ""
    return (
        f"obstacle=[{{kind='box',at_m=[{0.8 * along_m},{0.6 * along_m},-10],size_m=[0.2,{wide_m},8],"
        f"heading_deg={heading},margin_m={MARGIN_M},load_margin_m={LOAD_MARGIN_M}{sight}}}]"
    )


@lru_cache
def flown(*settings: str) -> tuple[Setup, RunLog]:
    """Return a run of `precise` in memory and its log."""
    run = runs.ready("precise", *settings)
    return run, logs.log_of(runs.recorded(run))


def least(run: Setup, log: RunLog) -> tuple[float, float]:
    """Return the smallest distances of UAVs, and of rods and payload, from the obstacles, m."""
    x = np.array([one.x for one in log.of(PlantState)])
    each = [clearances(run.system, obstacle, x) for obstacle in run.obstacles]
    N = run.system.N
    return min(one[:, :N].min() for one in each), min(one[:, N:].min() for one in each)


def end(log: RunLog) -> Array:
    """Return the last position of the payload, (3,), m."""
    return np.asarray([*log.of(PlantState)][-1].x[R0])


def makers(log: RunLog) -> dict[str, int]:
    """Return the first tick of the targets in plans that each agent made."""
    made: dict[str, int] = {}
    for plan in log.of(Plan):
        for target in carried_by(plan):
            if is_of_sight(target):
                made.setdefault(target.sender, target.tick)
    return made


@pytest.mark.parametrize("network", [(), LATE], ids=["perfect", "late"])
def test_a_wall_is_gone_round_and_the_path_s_end_reached(network: Sequence[str]) -> None:
    """A path through it is not refused; the agents that see it lead the others, and all margins are kept."""
    run, log = flown(GO % 13, wall(6.5, 2.0, 20.0), *network)
    assert run.run.obstacles == ()
    uav_m, load_m = least(run, log)
    assert uav_m > MARGIN_M
    assert load_m > LOAD_MARGIN_M
    np.testing.assert_allclose(end(log), [9.6, 7.2, -10.0], atol=ARRIVED_M)
    (first, tick) = min(makers(log).items(), key=lambda item: item[1])
    # No agent knows it before: no measurement but of those near, none earlier than the target.
    seen = [(one.agent, one.tick) for one in log.of(Measurement) if len(one.seen)]
    assert min(tick for _, tick in seen) == tick
    assert f"agent{min(seen, key=lambda one: one[1])[0]}" in makers(log)
    followed = {plan.agent for plan in log.of(Plan) if plan.targets}
    assert followed == {1, 2, 3, 4}
    assert any("sees obstacle 1: goes round it" in note.problem for note in log.of(Note))
    # Errors are towards the path that the team took.
    errors = summarise(AnalysedRun.of(run, log))["payload_tracking"]
    assert errors["rms_m"] < TRACKED_M
    assert first in {note.sender for note in log.of(Note)}


def test_before_a_wall_without_a_way_round_the_team_rests() -> None:
    """Within the time that is left there is none round 200 m."""
    run, log = flown(GO % 4, wall(6.5, 200.0, -30.0), *LATE)
    uav_m, load_m = least(run, log)
    assert uav_m > MARGIN_M
    assert load_m > LOAD_MARGIN_M
    x = np.array([one.x for one in log.of(PlantState)])
    assert np.linalg.norm(x[-1, R0] - x[-20, R0]) < ARRIVED_M
    assert any("stops before it" in note.problem for note in log.of(Note))


def test_two_walls_of_which_each_hides_behind_the_other() -> None:
    """The second one is seen on the way round the first: neither is touched, and the end is reached."""
    first = wall(5.5, 2.0)[len("obstacle=[") : -1]
    second = first.replace("at_m=[4.4,3.3,-10]", "at_m=[7.6,3.6,-10]")
    assert second != first
    run, log = flown(GO % 14, f"obstacle=[{first},{second}]")
    uav_m, load_m = least(run, log)
    assert uav_m > MARGIN_M
    assert load_m > LOAD_MARGIN_M
    np.testing.assert_allclose(end(log), [9.6, 7.2, -10.0], atol=ARRIVED_M)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["eager", "confirmed"])
def test_a_silence_from_the_moment_of_sight_ends_before_the_wall(rule: str) -> None:
    """No other agent hears of it for 3 s: with a stop all rest before it, and go round it after."""
    settings = GO % 12, wall(7.0, 2.0), f"controller.targets={rule}", "controller.silence=stop"
    silent = f"links.change=[{{at_s={SEEN_S},loss=1.0}},{{at_s={SEEN_S + 3.0},loss=0.0}}]"
    run, log = flown(*settings, silent)
    assert 0.05 * min(makers(log).values()) == pytest.approx(SEEN_S)
    # All have lost the same time by the stop.
    (lag,) = {plan.lag for plan in log.of(Plan) if plan.tick == run.ticks - 1}
    assert lag > 0
    uav_m, load_m = least(run, log)
    assert uav_m > 0.0
    assert load_m > 0.0
    np.testing.assert_allclose(end(log), [9.6, 7.2, -10.0], atol=ARRIVED_M)


def test_a_known_wall_on_the_path_is_refused_and_keys_are_checked() -> None:
    """With the number of the obstacle in the file; sight has to reach beyond the margin."""
    known = wall(6.5, 2.0, seen=False)[len("obstacle=[") : -1]
    hidden = wall(6.5, 2.0)[len("obstacle=[") : -1]
    with pytest.raises(ScenarioError, match=r"obstacle\.2: expected 0\.4 m"):
        runs.ready("precise", GO % 4, f"obstacle=[{hidden},{known}]")
    near = hidden.replace(f"seen_within_m={SIGHT_M}", "seen_within_m=0.3")
    with pytest.raises(ScenarioError, match=r"obstacle\.1\.seen_within_m: expected more than"):
        runs.ready("precise", GO % 4, f"obstacle=[{near}]")


RUN = runs.ready("precise", GO % 4, wall(6.5, 2.0))
SEEN = [1.0, 5.0, 4.0, -10.0, 0.5, 0.1, 1.0, 4.0, 0.0, 0.4, 0.1]
OF_SIGHT = Target(
    sender="agent3",
    incarnation=0,
    sequence=0,
    tick=3,
    number=1003,
    points=np.array([[1.0, 0.0, -10.0]]),
    times=np.zeros(1),
    approach_s=2.0,
    approach_ramp_s=1.0,
    way_s=0.0,
    way_ramp_s=0.0,
    to=(3,),
    brakes=True,
)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sender": "agent2"}, "unknown_agent"),
        ({"sender": "plant"}, "wrong_sender"),
        ({"sender": "coordinator"}, "wrong_sender"),
        ({"brakes": False}, "wrong_sender"),
        ({"to": (2,)}, "unknown_agent"),
        ({"number": 1002}, "unknown_agent"),
        ({"number": 3}, "unknown_agent"),
        ({"number": 2**40, "to": (3,)}, "unknown_agent"),
        ({"tick": 4}, "future"),
        ({"approach_s": 1e9}, "future"),
        ({"points": np.array([[1e9, 0.0, 0.0]])}, "out_of_range"),
    ],
)
def test_a_target_that_no_agent_makes_is_refused(changes: dict[str, Any], reason: str) -> None:
    """With the reason; a genuine one is admitted, but not in a run without obstacles to see."""
    plan = runs.plan(RUN, 2, 3)
    genuine = msgspec.structs.replace(plan, targets=(encode(OF_SIGHT),))
    check_carried(genuine, RUN.rules.shape)
    with pytest.raises(MessageError) as refused:
        check_carried(genuine, runs.ready("precise", GO % 4).rules.shape)
    assert refused.value.reason == "wrong_sender"
    carried = msgspec.structs.replace(OF_SIGHT, **changes)
    with pytest.raises(MessageError) as refused:
        check_carried(msgspec.structs.replace(plan, targets=(encode(carried),)), RUN.rules.shape)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    "rows",
    [
        [[0.5, *SEEN[1:]]],
        [[-1.0, *SEEN[1:]]],
        [[*SEEN[:5], -0.1, *SEEN[6:]]],
        [[1.0, 1e9, *SEEN[2:]]],
        [SEEN] * 65,
    ],
    ids=["no number", "negative", "size", "far", "many"],
)
def test_solids_that_cannot_be_are_refused(rows: Sequence[Sequence[float]]) -> None:
    """And any in a run without obstacles to see; nothing that is seen sizes work."""
    measured = runs.measurement(RUN, 2, 3)
    check_plausible(msgspec.structs.replace(measured, seen=np.array([SEEN])), RUN.rules.shape)
    with pytest.raises(MessageError, match="seen: expected"):
        check_plausible(msgspec.structs.replace(measured, seen=np.array(rows)), RUN.rules.shape)
    without = runs.ready("precise", GO % 4).rules.shape
    with pytest.raises(MessageError, match="none in a run without"):
        check_plausible(msgspec.structs.replace(measured, seen=np.array([SEEN])), without)
    nan = msgspec.structs.replace(measured, seen=np.array([[math.nan, *SEEN[1:]]]))
    with pytest.raises(MessageError, match="finite"):
        decode(encode(nan))
