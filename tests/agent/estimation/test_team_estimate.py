"""What an agent's estimate of its team takes from rosters, failures and targets."""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tests.support import runs
from transport.agent.estimation.predicted_motion import Failure
from transport.agent.estimation.team_estimate import Expected, TeamEstimate
from transport.agent.received import Received
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import released_state
from transport.mpc.controller import Controller
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.messages import Target
from transport.protocol.wire.outbox import Outbox

AGENT, UAV = 1, 0
FORCES = "controller.disturbance.estimate=true"
ROUNDING = 1e-12
NO_UAVS: frozenset[int] = frozenset()

# External forces on payload and UAVs, N.
BEFORE, NOW = np.random.default_rng(41).uniform(-1.0, 1.0, (2, 15))


def _team(run: Setup) -> TeamEstimate:
    """Return the estimate of an agent before its first tick."""
    owned = run.owned[AGENT - 1]
    controller = Controller(run.model, run.hover, run.settings, owned, run.reference.sampled)
    return TeamEstimate(run.run, AGENT, controller)


def _received(
    run: Setup,
    k: int,
    *,
    gone: Collection[int] = (),
    off: frozenset[int] = NO_UAVS,
    released: frozenset[int] = NO_UAVS,
    failed_since: int = 0,
    heard: int | None = None,
) -> Received:
    """Return what an agent receives at a tick, without states that are measured.

    `gone` are agents off the roster, `heard` is the tick of the others' plans, if any.
    """
    agents = set(run.agents) - set(gone)
    others = sorted(agents - {AGENT})
    return Received(
        measurement=runs.measurement(run, AGENT, k),
        measurements=[],
        plans=[] if heard is None else [runs.plan(run, agent, heard) for agent in others],
        lost=0,
        measurements_lost=0,
        agents=agents,
        off=off,
        released=released,
        failed_since=failed_since,
        ticks_since_start=k,
        started_ns=0,
    )


def _changed(run: Setup, settings: Mapping[str, object]) -> TeamRun:
    """Return a run with other settings of the controllers."""
    changed = run.settings.model_copy(update=settings)
    return replace(run.run, known=replace(run.run.known, settings=changed))


def _assert_balances(team: TeamEstimate, run: Setup, k: int, forces: Array, carrying: int) -> None:
    """Check that a UAV alone is assumed to balance its part of some forces."""
    x = run.X_ref[k]
    on_uav = forces[3 * (1 + UAV) :][:3]
    expected = team._alone.inputs(UAV, x, k, -on_uav - forces[:3] / carrying)
    np.testing.assert_allclose(team._by_law_alone(UAV, k, x), expected, rtol=0.0, atol=ROUNDING)


def test_uavs_alone_hold_what_was_estimated_with_the_team(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the team the forces are those of the estimate; in a silence they follow it, (32f)."""
    run = runs.ready("resilient", FORCES)
    team = _team(run)
    for k, forces in enumerate((NOW, BEFORE)):
        monkeypatch.setattr(TeamEstimate, "forces", forces)
        team.update(_received(run, k, heard=k - 1 if k else None))
        assert team.share_alone(k) == 0.0
        _assert_balances(team, run, k, forces, run.system.N)

    silent = 60
    monkeypatch.setattr(TeamEstimate, "forces", NOW)
    team.update(_received(run, silent))
    assert team.share_alone(silent) == 1.0
    law, _ = team.alone(UAV, silent)
    step = run.settings.sampling_period_s / law.follows_s
    _assert_balances(team, run, silent, BEFORE + step * (NOW - BEFORE), run.system.N)


def test_uavs_alone_carry_the_mass_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its weight is a force on the payload, down, (63a)."""
    run = runs.ready("resilient", FORCES)
    team = _team(run)
    monkeypatch.setattr(TeamEstimate, "forces", np.append(NOW, 0.3))
    team.update(_received(run, 0))
    weight = np.zeros_like(NOW)
    weight[2] = 0.3 * run.system.gravity
    _assert_balances(team, run, 0, NOW + weight, run.system.N)


def test_drag_is_estimated_with_the_team_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Own measurements do not tell it: in a silence that of the team stays, (32f). Some estimates have none."""
    run = runs.ready("eight", FORCES)
    team = _team(run)
    assumed: list[list[float]] = []
    monkeypatch.setattr(team._alone, "assume_drag", lambda drag: assumed.append(drag.tolist()))
    silent = 60
    for k, drag in ((0, []), (1, [0.1, 0.2]), (silent, [0.3, 0.4])):
        forces = np.append(np.full(4 + 3 * run.system.N, 0.5), drag)
        monkeypatch.setattr(TeamEstimate, "forces", forces)
        team.update(_received(run, k))
    assert team.share_alone(silent) == 1.0
    assert assumed == [[0.1, 0.2]]


def test_forces_on_the_ground_are_those_of_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the ground carries is no force that lasts: from the end of a landing on."""
    run = runs.ready("resilient", "plant.engine=mujoco", "plant.ground_m=0.0")
    given = requested(TargetSection, {"points_m": [[0.5, 0.0, -10.0]]})
    target = Outbox("coordinator", 0).stamp(Target, number=1, **target_fields(run, given, 5))
    first, landing = target, structs.replace(target, number=2, tick=40, lands=True)
    team = _team(run)
    team.update(_received(run, 0))
    landed = run.after([first]).after([landing])
    team.follow(landed.run)
    ends = math.ceil(landed.maneuver.targets[-1].ends_s / run.settings.sampling_period_s)
    found = []
    for k in (ends - 1, ends, ends + 1):
        on_ground = np.full(4 + 3 * run.system.N, float(k))
        monkeypatch.setattr(type(team.estimator), "forces", on_ground)
        team.update(_received(run, k))
        assert team.forces is not None
        found.append(team.forces[0])
    assert found == [ends - 1] * 3

    begins_landed = _team(run)
    begins_landed.follow(landed.run)
    begins_landed.update(_received(run, ends + 2))
    assert begins_landed.forces is on_ground


def test_uavs_that_are_left_hold_the_force_on_the_payload(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failure it is divided among one UAV less, (32f)."""
    run = runs.ready("resilient", FORCES)
    team = _team(run)
    monkeypatch.setattr(TeamEstimate, "forces", NOW)
    team.update(_received(run, 0))
    team.update(_received(run, 1, off=frozenset({3}), failed_since=1, heard=0))
    _assert_balances(team, run, 1, NOW, run.system.N - 1)


@pytest.mark.parametrize(
    ("failed_since", "expected"),
    [
        pytest.param(5, 5, id="the agent starts after the failure"),
        pytest.param(13, 12, id="a roster is here ahead of its tick"),
    ],
)
def test_a_failure_counts_from_its_tick(failed_since: int, expected: int) -> None:
    """What was announced before a failure holds until then; none is in the future."""
    run = runs.ready("resilient")
    team = _team(run)
    team.update(_received(run, 12, off=frozenset({3}), failed_since=failed_since))
    assert team.announced.heard.failed_since == expected


def _with_target(run: Setup, tick: int) -> Setup:
    """Return a run with a target that is given at a tick."""
    given = requested(TargetSection, {"points_m": [[0.5, 0.0, -10.0]]})
    target = Outbox("coordinator", 0).stamp(Target, number=1, **target_fields(run, given, tick))
    return run.after([target])


def test_agents_off_the_roster_are_assumed_on_the_present_fail_safe() -> None:
    """The fail-safe changes with a failure and with a target, and stays at a restart."""
    run = runs.ready("resilient", "maneuver.profile=smooth")
    team = _team(run)

    def is_present() -> bool:
        return team.announced.fail_safe is team._controller.regulation.fail_safe

    first = team.announced.fail_safe
    assert is_present()
    team.update(_received(run, 0))
    failed = frozenset({3})
    team.update(_received(run, 1, off=failed, released=failed, failed_since=1))
    assert is_present()
    after_failure = team.announced.fail_safe
    assert after_failure is not first
    team.restart()
    assert is_present()
    team.follow(_with_target(run, 2).run)
    assert is_present()
    assert team.announced.fail_safe is not after_failure


def test_a_law_whose_gains_are_complete_holds_from_then_on() -> None:
    """Until the gains of a new team are there, those of the meantime hold, (46)."""
    run = runs.ready("eight")
    team = _team(run)
    left = 20
    team.update(_received(run, left))
    team.update(_received(run, left + 1, gone={2}))
    since = []
    for k in range(left + 2, left + 60):
        team.update(_received(run, k, gone={2}))
        since.append(team.announced.law_since)
    complete = since[-1]
    assert complete > left + 2
    assert since == [left + 1 if k < complete else complete for k in range(left + 2, left + 60)]


@pytest.mark.parametrize(("left", "expected"), [(37, 40), (None, 0)])
def test_a_target_completes_the_law_of_a_new_team(left: int | None, expected: int) -> None:
    """A law whose gains were under way holds from the target on; without one all stays, (46)."""
    run = runs.ready("eight")
    team = _team(run)
    if left is not None:
        team.update(_received(run, left - 1))
        team.update(_received(run, left, gone={2}))
        assert team.announced.law_since == left
    team.follow(_with_target(run, 40).run)
    assert team.announced.law_since == expected


@pytest.mark.parametrize(
    ("heard", "alone", "assumed_steps"),
    [(0, 0.0, [5]), (0, 1.0, [0]), (2, 0.0, [5]), (3, 0.0, [])],
)
def test_an_agent_that_leaves_is_assumed_to_have_made_its_last_plan(
    heard: int, alone: float, assumed_steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the last step foresaw, (32b), where that plan is not here; one alone is on its fail-safe at once."""
    run = runs.ready("resilient")
    team = _team(run)
    for k in range(4):
        received = _received(run, k, heard=heard if k == 3 else None)
        plans = [structs.replace(one, alone=alone) for one in received.plans]
        team.update(structs.replace(received, plans=plans))
    foreseen = np.ones((5, run.system.m))
    assumed: list[tuple[int, int, int]] = []
    monkeypatch.setattr(team._controller, "foreseen", lambda *_: foreseen)
    monkeypatch.setattr(
        team.announced, "assume", lambda agent, start, U: assumed.append((agent, start, len(U)))
    )
    team.expected = Expected(start=3, prediction=None, inputs=foreseen)  # type: ignore[arg-type]
    team.update(_received(run, 4, gone=[3]))
    assert assumed == [(3, 3, steps) for steps in assumed_steps]


@pytest.mark.parametrize(
    ("changed", "has_rule", "late_counts", "later_s"),
    [
        ({}, True, False, 0.0),
        ({"silence": "law"}, False, False, 0.0),
        ({"silence": "stop", "estimator": "kalman"}, True, True, 0.0),
        ({"prediction": "open_loop"}, False, False, 0.0),
        ({"share": "on_change", "share_heartbeat_s": 0.7}, True, False, 1.4),
        ({"share_heartbeat_s": 0.7}, True, False, 0.0),
    ],
    ids=str,
)
def test_rule_by_which_the_others_act_alone(
    changed: dict[str, object], has_rule: bool, late_counts: bool, later_s: float
) -> None:
    """They do with closed-loop prediction, unless the setting is the law; late information counts with a filter.

    Where plans are sent on change, overdue is two heartbeats later than 0.5 s beyond the usual, (32c). After a
    failure no information is late.
    """
    run = runs.ready("resilient")
    team = _team(run)
    team._setup = _changed(run, changed)
    law = team._shared_law()
    assert (law.silence is not None) is has_rule
    assert (law.inputs_alone is not None) is has_rule
    if law.silence is None or law.silence_after_failures is None:
        return
    begins_s = law.silence.overdue.begins * run.settings.sampling_period_s
    assert begins_s == pytest.approx(0.5 + later_s)
    assert (law.silence.late is not None) is late_counts
    assert law.silence_after_failures.late is None


def test_share_alone_follows_the_others_and_the_start() -> None:
    """It is 0.2 below the largest that another announces; 1 from a start in mid-run until all are heard, (32c)."""
    run = runs.ready("resilient")
    team = _team(run)
    team.update(_received(run, 0))
    received = _received(run, 1, heard=0)
    said = [structs.replace(one, alone=0.1 * one.agent) for one in received.plans]
    team.update(structs.replace(received, plans=said))
    assert team.share_alone(1) == pytest.approx(0.1 * max(run.agents) - 0.2)

    late = _team(run)
    for k, heard, expected in [(30, None, 1.0), (31, 30, 0.0)]:
        late.update(_received(run, k, heard=heard))
        assert late.share_alone(k) == expected


def test_law_and_uavs_alone_follow_a_further_target() -> None:
    """Inputs by the law are those about the new reference, on which are also UAVs alone after a failure, (46)."""
    run = runs.ready("resilient")
    team = _team(run)
    after = _with_target(run, 2)
    k = 20  # in motion
    x = after.X_ref[k]
    failed = frozenset({3})
    team.update(_received(run, 0, off=failed, released=failed))
    team._by_law(k, x)
    team.follow(after.run)
    np.testing.assert_array_equal(team._reference(k), after.X_ref[k])
    assert not np.array_equal(after.X_ref[k], after.X_ref[k + 1])
    regulation = team._controller.regulation
    expected = regulation.inputs(x, after.X_ref[k], team.forces, k)
    found = team._by_law(k, x)
    assert found is not None
    assert expected is not None
    np.testing.assert_array_equal(found, expected)
    new = AloneTeam(run.model, run.hover, run.settings, regulation, after.reference.sampled)
    new.fail(failed, failed)
    np.testing.assert_array_equal(new.inputs(UAV, x, k), team._alone.inputs(UAV, x, k))


def test_states_as_received_replace_those_of_the_estimate() -> None:
    """Those of each agent that has been heard, as old as they are; else plans tell where the others were."""
    run = runs.ready("resilient")
    moved = run.initial_state().copy()
    places = [state.uav_slice(uav) for uav in run.owned[2]]
    for place in places:
        moved[place][state.OMEGA] = 0.3
    for changed, is_same in (("as_received", True), ("predicted", False)):
        team = _team(run)
        team._setup = _changed(run, {"received_states": changed})
        team.update(_received(run, 0))
        plan = runs.plan(run, 3, 0, x=moved)  # agent 2 has not been heard
        x = team.update(structs.replace(_received(run, 1), plans=[plan]))
        for place in places:
            assert np.array_equal(x[place], moved[place]) is is_same
            assert x[place][state.OMEGA].all()


def test_rosters_change_who_is_without_agent_and_who_is_expected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All that are off, not only the last; the law of the meantime begins at the change, but not at a start, (46)."""
    run = runs.ready("resilient")
    for first in (0, 1):
        team = _team(run)
        left: list[tuple[list[int], int | None]] = []
        failed: list[int | None] = []
        controller = team._controller
        monkeypatch.setattr(
            controller, "without", lambda uavs, since, to=left: to.append((list(uavs), since))
        )
        monkeypatch.setattr(
            controller, "fail", lambda off, released, since, to=failed: to.append(since)
        )
        stopped = frozenset({3})
        for k, gone in enumerate([{2}, {2, 3}, {3}], start=first):
            team.update(_received(run, k, gone=gone, off=stopped))
            assert team.announced.heard.off_roster == gone
        uavs = [[*run.owned[1]], [*run.owned[1], *run.owned[2]], [*run.owned[2]]]
        since = [None if k == 0 else k for k in range(first, first + 3)]
        assert left == list(zip(uavs, since, strict=True))
        assert failed == since[:1]
        assert team.announced.heard.has_returned(2)
        assert not team.announced.heard.has_returned(3)


def test_estimate_alone_and_law_change_as_uavs_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a failure a UAV stops to turn, and one that is released hangs at rest: each once, (50), (51)."""
    run = runs.ready("resilient")
    team = _team(run)
    failures: list[Failure] = []
    monkeypatch.setattr(team.estimator, "change", failures.append)
    x = run.initial_state() + 0.1
    steps: list[tuple[set[int], set[int], list[int], list[int]]] = [
        ({3}, set(), [3], []),
        ({3}, {3}, [], [3]),  # the others carry its load: another hover
        ({3, 2}, {3}, [2], []),
        ({3, 2, UAV}, {3}, [UAV], []),
    ]
    for k, (off, released, stopped, cut) in enumerate(steps, start=1):
        team.update(
            _received(run, k, off=frozenset(off), released=frozenset(released), failed_since=k)
        )
        expected = x.copy()
        for uav in stopped:
            expected[state.uav_slice(uav)][state.OMEGA] = 0.0
        for uav in cut:
            expected = released_state(expected, uav)
        failure = failures[-1]
        np.testing.assert_array_equal(failure.moved(x), expected)
        assert failure.hover is team._controller.regulation.hover
        assert list(failure.own_left) == [uav for uav in (UAV,) if uav not in off]
        assert team._alone._off == off
    assert len(failures) == len(steps)


def test_measurements_before_the_ticks_own_are_taken_in() -> None:
    """The state that the UAV measured a tick before is the estimate of that tick."""
    run = runs.ready("resilient")
    team = _team(run)
    moved = run.initial_state().copy()
    moved[state.POSITION] += 0.2
    team.update(_received(run, 0))
    measured = [runs.measurement(run, AGENT, k, x=moved) for k in (0, 1)]
    x = team.update(structs.replace(_received(run, 1), measurements=measured))
    np.testing.assert_array_equal(x[: state.PAYLOAD], moved[: state.PAYLOAD])


def test_setpoints_alone_are_those_of_their_uav_and_tick() -> None:
    """Each UAV alone has its own law, and its inputs ahead are those of its setpoints tick by tick, (31f)."""
    run = runs.ready("resilient")
    team = _team(run)
    alone = AloneTeam(
        run.model, run.hover, run.settings, team._controller.regulation, run.reference.sampled
    )
    uav, first = 1, 30
    law, _ = team.alone(uav, first)
    assert law is team._alone.law(uav)
    ahead = [alone.setpoint(uav, tick).inputs for tick in range(first, first + 3)]
    np.testing.assert_array_equal(team.alone_ahead(uav, first, 3), ahead)
    assert not np.array_equal(ahead[0], ahead[1])

    # With motor lag a state has actual inputs, too, to which no UAV alone answers.
    x = run.X_ref[first]
    with_lag = team._by_law_alone(uav, first, np.concatenate([x, 2.0 * run.hover.u]))
    np.testing.assert_array_equal(with_lag, team._by_law_alone(uav, first, x))


def test_the_newest_plan_that_has_started_tells_whether_an_agent_left_alone() -> None:
    """A plan that starts later does not count yet; an agent without any plan has none to assume, (32b)."""
    run = runs.ready("resilient")
    team = _team(run)
    team.expected = Expected(start=3, prediction=None, inputs=np.ones((5, 4)))  # type: ignore[arg-type]
    team.announced.add(runs.plan(run, 3, 2))
    team.announced.add(structs.replace(runs.plan(run, 3, 3, delay=6), alone=1.0))
    assert not team._is_alone(3, 6)
    assert team._is_alone(3, 9)
    team._assume_last_plan(2, 6, is_alone=False)
