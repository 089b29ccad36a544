"""The path by which a payload is judged, and that of the fail-safe, which follows what the whole team knows."""

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.nodes import PlantNode
from tests.support.runs import plan, roster, setup, tick
from transport.plant.team_paths import TeamPaths
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Plan, Target

ROSTER = (1, 2, 3, 4)
TOLD_TICK = 20
AWAY_M = 0.4
ARRIVED_TICK = 200  # 5 s of approach after it was told
TOLERANCE_M = 1e-9


@pytest.fixture
def run() -> Setup:
    """Return a team in hover for 12 s whose fail-safe follows the reference."""
    hover = "maneuver.phase=[{name='hover',duration_s=12,displacement_m=[0,0,0]}]"
    return setup("controller.horizon=5", "controller.fail_safe=follow", hover)


def target(*to: int) -> Target:
    """Return a target of tick 20 that some agents, or all, are told."""
    fields: dict[str, Any] = {"approach_s": 5.0, "approach_ramp_s": 2.0}
    return Target(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=TOLD_TICK,
        number=1,
        points=np.array([[AWAY_M, 0.0, -10.0]]),
        times=np.zeros(1),
        way_s=0.0,
        way_ramp_s=0.0,
        to=to,
        **fields,
    )


def carrying(run: Setup, sender: int, k: int) -> Plan:
    """Return a plan that carries the target that agent 2 was told."""
    return replace(plan(run, sender, k), targets=(encode(target(2)),))


def shared_m(run: Setup, paths: TeamPaths) -> float:
    """Return how far the fail-safe leads UAV 1 in the end, x, m."""
    end = paths.fail_safe.setpoint(0, ARRIVED_TICK).motion.position_I[0]
    begin = paths.fail_safe.setpoint(0, 0).motion.position_I[0]
    return float(end - begin)


def test_a_target_that_all_are_told_is_on_both_paths(run: Setup) -> None:
    """From its tick on; the places before stay, bit for bit."""
    paths = TeamPaths(run.run)
    before_I = paths.given_I.copy()
    assert paths.tell(target(), TOLD_TICK - 1)
    np.testing.assert_array_equal(paths.given_I[:TOLD_TICK], before_I[:TOLD_TICK])
    assert paths.given_I[ARRIVED_TICK][0] == pytest.approx(AWAY_M, abs=TOLERANCE_M)
    assert shared_m(run, paths) == pytest.approx(AWAY_M, abs=TOLERANCE_M)


def test_a_target_that_one_is_told_is_shared_once_all_plans_have_carried_it(run: Setup) -> None:
    """The payload is judged by it at once; the fail-safe follows when the last agent on the roster knows it."""
    paths = TeamPaths(run.run)
    assert not paths.tell(target(2), TOLD_TICK - 1)
    assert paths.given_I[ARRIVED_TICK][0] == pytest.approx(AWAY_M, abs=TOLERANCE_M)
    for k, sender in enumerate((2, 1, 3), start=TOLD_TICK):
        assert not paths.hear([carrying(run, sender, k)], k, ROSTER)
    assert shared_m(run, paths) == pytest.approx(0.0, abs=TOLERANCE_M)
    assert paths.hear([carrying(run, 4, TOLD_TICK + 3)], TOLD_TICK + 3, ROSTER)
    assert shared_m(run, paths) == pytest.approx(AWAY_M, abs=TOLERANCE_M)
    assert not paths.hear([carrying(run, 1, TOLD_TICK + 4)], TOLD_TICK + 4, ROSTER)


def test_an_agent_off_the_roster_need_not_know_it(run: Setup) -> None:
    """The roster of the tick decides."""
    paths = TeamPaths(run.run)
    paths.tell(target(2), TOLD_TICK - 1)
    heard = [carrying(run, sender, TOLD_TICK) for sender in (1, 2, 3)]
    assert paths.hear(heard, TOLD_TICK, (1, 2, 3))


@pytest.mark.parametrize("to", [(), (2,)])
def test_uavs_without_a_plan_are_led_along_the_shared_path(run: Setup, to: tuple[int, ...]) -> None:
    """The plant renews their fail-safe when all are told a target, or when plans of all have carried it."""
    node = PlantNode(run)
    node.receive(roster(), 0)
    begin = node._schedule.fail_safe.setpoint(0, 0).motion.position_I[0]
    led_m = []
    for k in range(TOLD_TICK + 2):
        node.receive(tick(k), 0)
        if k == TOLD_TICK - 1:
            node.receive(target(*to), 0)
        for sender in ROSTER:
            make = carrying if k >= TOLD_TICK else plan
            node.receive(make(run, sender, k), 0)
        end = node._schedule.fail_safe.setpoint(0, ARRIVED_TICK).motion.position_I[0]
        led_m.append(end - begin)
    since = TOLD_TICK if to else TOLD_TICK - 1
    expected = [AWAY_M if k >= since else 0.0 for k in range(TOLD_TICK + 2)]
    assert led_m == pytest.approx(expected, abs=TOLERANCE_M)
