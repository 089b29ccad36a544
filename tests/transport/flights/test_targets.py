"""Targets given during a run: every process makes the same new reference, and the payload arrives."""

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from tests.coordinator.test_requests import answer_to
from tests.support import logs, runs
from tests.support.coordinator_clock import CONTINUE, answers, gone, ready, started, tell
from tests.support.nodes import CoordinatorNode
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.cost_and_tracking_metrics import SETTLED_S
from transport.analysis.replay.replay_difference import Comparison
from transport.analysis.replay.replay_of_agent import Replay
from transport.analysis.summary_assembly import summarise
from transport.log.run_log import RunLog
from transport.model.state import R0
from transport.mpc.controller import Controller
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import (
    RequestError,
    ScenarioError,
    requested,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.messages import Measurement, Message, Request, Roster, Target
from transport.protocol.wire.outbox import Outbox

REACHED_M = 0.05
HOVER = "maneuver.phase=[{name='hover',duration_s=%g,displacement_m=[0,0,0]}]"
FLAT = ("maneuver.reference=flat", "controller.limits.moments_Nm=[1.0,1.0,0.5]")
PLACES = ((0.5, "0.4,0,-10"), (2.0, "0,0.4,-10.2"), (7.1, "0,0,-10"))
THREE = (
    f"maneuver.target=[{','.join(f'{{at_s={at},points_m=[[{place}]]}}' for at, place in PLACES)}]"
)
POOR = (
    *("links.delay_s=0.2", "links.loss=0.3", "clock.on_agent_loss='continue'"),
    "faults.event=[{at_s=1.0,do='kill',target='agent3'},{at_s=3.0,do='restart',target='agent3'}]",
)


@lru_cache
def flown(name: str, *settings: str) -> RunLog:
    """Return the log of a flight in memory."""
    return logs.log_of(runs.recorded(runs.ready(name, *settings)))


def message(run: Any, tick: int, number: int = 1, **given: Any) -> Target:
    """Return the coordinator's message for a target."""
    return Outbox("coordinator", 0).stamp(
        Target, number=number, **target_fields(run, requested(TargetSection, given), tick)
    )


@pytest.mark.slow
@pytest.mark.parametrize("extra", [(), POOR])
def test_the_payload_arrives_and_the_run_replays(extra: tuple[str, ...]) -> None:
    """The second target replaces the first on its way.

    The payload is at it and the third; replays have equal bits.
    """
    settings = (HOVER % 12.5, THREE, *extra)
    run, log = runs.ready("precise", *settings), flown("precise", *settings)
    first, second, third = summarise(AnalysedRun.of(run, log))["targets"]
    assert first["error_m"] is None
    # And counts at that moment.
    assert second["arrives_s"] < third["t_s"] == 7.1 < second["arrives_s"] + SETTLED_S
    assert third["arrives_s"] < 12.4 < third["arrives_s"] + SETTLED_S  # as this at the end
    assert max(second["error_m"], third["error_m"]) < REACHED_M
    for agent in (1, 3):
        again, comparison = Replay(run, log, agent), Comparison()
        for step in again.steps():
            comparison.add(step)
        assert comparison.plans > 100
        assert comparison.identical == comparison.plans
        assert again.notes == []


@pytest.mark.slow
def test_along_a_flat_reference_to_way_points() -> None:
    """Fast flight leaves its curve for a target and way points, on a late network, and arrives within 2 cm."""
    settings = (
        "maneuver.phase.2.laps=1.0",
        "maneuver.phase.2.speed_mps=3.0",
        "maneuver.target=[{at_s=4,points_m=[[2,1,-11],[3,2,-11],[2,3,-10]],speed_mps=1.5}]",
    )
    log = flown("eight", *settings)
    (found,) = summarise(AnalysedRun.of(runs.ready("eight", *settings), log))["targets"]
    assert found["position_m"] == [2.0, 3.0, -10.0]
    assert found["error_m"] < 0.02


@pytest.mark.parametrize("gone", [(), (2,)], ids=["all", "a death"])
@pytest.mark.parametrize("name", ["resilient", "eight"])
def test_the_law_before_a_target_stays_and_is_new_after_it(
    name: str, gone: tuple[int, ...]
) -> None:
    """Control law and reference are bit for bit the old ones before a target, those of the whole path after it."""
    run = runs.ready(name, HOVER % 9.0, "maneuver.profile=smooth")
    owned = list(range(run.system.N))
    controller = Controller(run.model, run.hover, run.settings, owned, run.reference.sampled)
    controller.without(gone)
    x, c = run.X_ref[40] + 1e-3, np.zeros((10, run.system.m))
    law = controller.law(x, run.X_ref[30:40], c, None, 30)
    led = run.after([message(run, 40, points_m=[[0.5, 0.0, -10.0]])])
    controller.regulation.follow(led.reference.sampled)
    again = controller.law(x, led.X_ref[30:40], c, None, 30)
    assert (led.X_ref[:40] == run.X_ref[:40]).all()
    assert law is not None
    assert again is not None
    assert (again.uncorrected == law.uncorrected).all()
    if gone and not run.reference.is_flat:
        return  # its UAV follows the team's motion until then, which did not know of the target
    # A controller that knows the path from its start has the same law after the target.
    target = message(run, 40, points_m=[[0.5, 0.0, -10.0]])
    whole = Setup.of(run.scenario, name).after([target])
    other = Controller(whole.model, whole.hover, whole.settings, owned, whole.reference.sampled)
    other.without(gone)
    for start in (40, 60, 100, 150):
        laws = [
            of.law(x, led.X_ref[start : start + 10], c, None, start) for of in (controller, other)
        ]
        assert all(law is not None for law in laws)
        assert np.allclose(laws[0].uncorrected, laws[1].uncorrected, rtol=0.0, atol=1e-9)  # type: ignore[union-attr]


def test_a_target_completes_the_law_of_a_team_whose_gains_are_under_way() -> None:
    """A target right after a death: the gains are those of a team that had all of them before it."""
    run = runs.ready("eight")
    owned = list(range(run.system.N))
    at_once, by_parts = (
        Controller(run.model, run.hover, run.settings, owned, run.reference.sampled).regulation
        for _ in range(2)
    )
    death, since = 38, 40
    at_once.form({2}, (), ())
    by_parts.form({2}, (), (), since=death)
    assert not by_parts.advance(death)
    assert not by_parts.advance(death + 1), "the gains are known: nothing is completed"
    unfinished = by_parts.gain(since)

    led = run.after([message(run, since, points_m=[[0.5, 0.0, -10.0]])])
    assert by_parts.follow(led.reference.sampled)
    assert not at_once.follow(led.reference.sampled)
    for k in (death, since - 1, since, since + 20, since + 200):
        np.testing.assert_array_equal(by_parts.gain(k), at_once.gain(k))
    assert (by_parts.gain(since) != unfinished).any()
    assert not by_parts.advance(since), "nothing is under way after the target"


def test_a_team_that_is_whole_again_after_a_target_follows_the_new_path() -> None:
    """Its gains were known along the old path; those along the new one are computed."""
    run = runs.ready("eight")
    owned = list(range(run.system.N))
    target = message(run, 40, points_m=[[0.5, 0.0, -10.0]])
    led = run.after([target])
    one, before, whole = (
        Controller(of.model, of.hover, of.settings, owned, of.reference.sampled).regulation
        for of in (run, run, led)
    )
    one.form({2}, (), ())
    one.follow(led.reference.sampled)
    one.form((), (), ())
    for k in (40, 60, 100, 150):
        np.testing.assert_allclose(one.gain(k), whole.gain(k), rtol=0.0, atol=1e-9)
    assert np.abs(one.gain(60) - before.gain(60)).max() > 1e-3


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({}, "points_m"),
        ({"points_m": [[0.0, 0.0]]}, "points_m.1: expected 3 numbers"),
        ({"points_m": [[0.0, float("nan"), 0.0]]}, "points_m"),
        ({"points_m": [[0.0, 0.0, 2e6]]}, "expected a magnitude of at most 1e+06"),
        ({"points_m": [[0.0, 0.0, -9.0]], "speed_mps": -1.0}, "speed_mps"),
        ({"points_m": [[3.0, 0.0, 2.0]]}, "expected z (down) of at most 0 m, got 2"),
        ({"points_m": [[200.0, 0.0, -9.0]]}, "expected a target before the end of the run"),
        (
            {"points_m": [[0, 0, -9.0], [0, 0, -9.0]]},
            "expected each way point away from the one before",
        ),
        ({"points_m": [[0, 0, -9.0], [1, 0, -9.0]], "times_s": [0.0, 0.5]}, "feasible in"),
        (
            {"points_m": [[0, 0, -9.0], [1, 0, -9.0], [1, 1, -9]], "speed_mps": 20.0},
            "times the time",
        ),
        (
            {"points_m": [[0, 0, -9.0]], "times_s": [0.0, 0.5]},
            "times_s: expected a time for each of 1 way points, got 2",
        ),
        (
            {"points_m": [[0, 0, -9.0], [1, 0, -9.0]], "times_s": [5.0, 5.0]},
            "times_s: expected rising times, got [5.0, 5.0]",
        ),
        (
            {"points_m": [[0, 0, -9.0], [1, 0, -9.0]], "times_s": [0.0, 9.0], "speed_mps": 0.5},
            "speed_mps: expected none next to times_s, which define the speed, got 0.5",
        ),
    ],
)
def test_what_cannot_be_flown_is_refused(given: dict[str, Any], problem: str) -> None:
    """A target that is not valid, not in reach or too fast is refused in words, and changes nothing."""
    node = CoordinatorNode(runs.ready("resilient"), observers=())
    replies: list[Any] = []
    for name in ("plant", "agent1", "agent2", "agent3", "agent4"):
        node.receive(ready(name), 0)
    assert list(node.receive(Request("target", given, replies.append), 0)) == []
    assert problem in replies[0]["error"]


def test_a_target_on_the_ground_or_below_it_is_refused() -> None:
    """No target while the payload takes off, and none below the ground.

    A scenario with one is refused as a whole.
    """
    run = runs.ready("delivery")
    for tick, point, problem in (
        (2, [0.0, 0.0, -3.0], "in flight"),
        (160, [0.0, 0.0, 5.0], r"z \(down\) of at most"),
    ):
        with pytest.raises(RequestError, match=problem):
            target_fields(run, requested(TargetSection, {"points_m": [point]}), tick)
    with pytest.raises(ScenarioError, match=r"maneuver\.target.*before the end of the run"):
        runs.ready("resilient", "maneuver.target=[{at_s=24.0,points_m=[[0,0,-9]]}]")


def test_a_request_is_announced_and_repeated() -> None:
    """A target holds from the next tick on, comes with a roster, and is repeated for an agent that joins."""
    node = started(CoordinatorNode(runs.ready("resilient", CONTINUE)))
    reply, (target, roster) = answer_to(node, "target", points_m=[[1.0, 0.0, -10.0]], speed_mps=0.5)
    assert (reply["tick"], reply["t_s"]) == (1, 0.05)
    assert reply["ends_s"] == reply["reached_s"] > 2.0
    assert isinstance(target, Target)
    assert isinstance(roster, Roster)
    assert roster.reason == "target (1, 0, -10) m, from t = 0.05 s on"
    tell(node, [gone("agent2"), ready("agent2", 2)])
    again: list[Message] = tell(node, answers(0, (1, 3, 4)))
    assert [m.number for m in again if isinstance(m, Target)] == [1]
    assert not [m for m in again if isinstance(m, Measurement)]
    assert R0.stop == 3
