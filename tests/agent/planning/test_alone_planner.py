"""The controller "alone": its plans begin where the actuators are, and follow the law of a UAV alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.support import runs
from transport.agent.planning.alone_planner import AlonePlanner
from transport.agent.received import Received
from transport.model import state
from transport.model.arrays import Array
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion, motion_of
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.messages import STAGES, Measurement, Plan, StepReport, Target
from transport.protocol.wire.outbox import Outbox

AGENT = 2
ROUNDING = 1e-12


def _planned(
    run: Setup,
    planner: AlonePlanner,
    k: int,
    x: Array,
    inputs: Array,
    *,
    has_measurement: bool = True,
) -> Array:
    """Return the first inputs, (4,), of a plan of tick k at a state, with inputs applied until then."""
    measured = runs.measurement(run, AGENT, k, x=x)
    measured = structs.replace(measured, inputs=inputs[None])
    received = Received(
        measurement=measured,
        measurements=[measured] if has_measurement else [],
        plans=[],
        lost=0,
        measurements_lost=0,
        agents=set(runs.ALL),
        off=frozenset(),
        released=frozenset(),
        failed_since=0,
        ticks_since_start=k,
        started_ns=0,
    )
    plan, _ = planner.plan(planner.begin(received), Outbox("agent2", 1), 0)
    assert isinstance(plan, Plan)
    assert (plan.inputs == plan.inputs[0]).all()
    first: Array = plan.inputs[0]
    return first


@pytest.mark.parametrize("actuation", ["immediate", "next_tick"])
def test_its_first_plan_starts_from_the_measured_inputs(actuation: str) -> None:
    """After a return the actuators, on their fail-safe until now, move at their rate at most.

    From then on with inputs that act at once from the measured ones, and else from those of the plan
    before, whose inputs are in force when the next plan starts.
    """
    run = runs.ready("alone", "plant.sensors=state", f"clock.actuation={actuation}")
    planner = AlonePlanner(run.run, AGENT, lambda: 0)
    step = run.settings.largest_step(1)
    at_hover = run.hover.u[state.input_slice(AGENT - 1)]

    # Far below its place the UAV asks for as much thrust as there is.
    x = run.hover.x.copy()
    x[state.R0] = [0.0, 0.0, 10.0]
    for _ in range(2):
        applied = at_hover + 2.0 * step
        planned = _planned(run, planner, 5, x, applied)
        assert np.abs(planned - applied).max() > 0.0
        assert (np.abs(planned - applied) <= step + ROUNDING).all()

        later = _planned(run, planner, 6, x, applied)
        before = planned if run.scenario.clock.next_tick else applied
        assert later[0] == pytest.approx(before[0] + step[0], abs=ROUNDING)

        planner.restart()


def test_its_inputs_are_those_of_the_law_of_a_uav_alone() -> None:
    """At the setpoint of its tick, with an integral that grows off its place, (31a)-(31c).

    Without a measurement of the tick they stay, and the integral too; a new start begins without one.
    """
    run = runs.ready("alone", "plant.sensors=state", "clock.actuation=immediate")
    planner = AlonePlanner(run.run, AGENT, lambda: 0)
    uav, period_s = AGENT - 1, run.settings.sampling_period_s
    regulation = Regulation(run.model, run.hover, run.settings, run.reference.sampled)
    team = AloneTeam(run.model, run.hover, run.settings, regulation, run.reference.sampled)
    k = run.ticks // 2  # on its way
    law = team.law(uav)

    integral_I, found, expected = np.zeros(3), [], []
    for tick in (k, k + 1, k + 2):
        x = run.X_ref[tick].copy()
        x[state.R0] += [0.01, -0.02, 0.03]
        motion, setpoint = motion_of(run.system, uav, x), team.setpoint(uav, tick)
        inputs = law.inputs(motion, setpoint, integral_I)
        integral_I = law.integral_after(integral_I, motion, setpoint, period_s)
        found.append(_planned(run, planner, tick, x, inputs))
        expected.append(inputs)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.ptp(np.array(expected)[:, 0]) > 1e-3

    missed = _planned(run, planner, k + 3, run.X_ref[k], expected[-1], has_measurement=False)
    np.testing.assert_array_equal(missed, found[-1])
    planner.restart()
    x = run.X_ref[k].copy()
    x[state.R0] += [0.01, -0.02, 0.03]
    np.testing.assert_allclose(_planned(run, planner, k, x, expected[0]), expected[0], atol=1e-9)


PAIRS = "agents.owned=[[1,2],[3,4]]"
SENSED = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "controller.prediction=closed_loop",
)


def _received(
    run: Setup, agent: int, k: int, *measurements: Measurement, **fields: Any
) -> Received:
    """Return what an agent has at tick k."""
    given: dict[str, Any] = {
        "measurement": runs.measurement(run, agent, k),
        "measurements": list(measurements),
        "plans": [],
        "lost": 0,
        "measurements_lost": 0,
        "agents": set(run.agents),
        "off": frozenset(),
        "released": frozenset(),
        "failed_since": 0,
        "ticks_since_start": k,
        "started_ns": 0,
    }
    return Received(**{**given, **fields})


def _step(planner: AlonePlanner, received: Received) -> tuple[Plan, StepReport]:
    """Return plan and report of a tick."""
    plan, report = planner.plan(planner.begin(received), Outbox("agent2", 1), 7)
    assert isinstance(plan, Plan)
    assert isinstance(report, StepReport)
    return plan, report


def _sensed(run: Setup, k: int, uavs: Sequence[int]) -> Measurement:
    """Return what the sensors of some UAVs measure near the reference, with one of them missing at times."""
    rng = np.random.default_rng(k)
    x = run.X_ref[k]
    rows = np.zeros((run.system.N, state.SENSED))
    applied = run.hover.u.reshape(-1, 4) + rng.uniform(-0.2, 0.2, (run.system.N, 4))
    for uav in range(run.system.N):
        motion = motion_of(run.system, uav, x)
        rows[uav, :3], rows[uav, 3:6] = motion.position_I, motion.velocity_I
        rows[uav, state.SPECIFIC_FORCE] = [0.0, 0.0, -9.0]
    rows += rng.uniform(-0.05, 0.05, rows.shape)
    own = list(uavs)
    return structs.replace(
        runs.measurement(run, 1, k),
        uavs=tuple(uav + 1 for uav in own),
        uav_states=rows[own],
        inputs=applied[own],
        missing=tuple(int(k % 2 and uav == 3) for uav in own),
    )


@pytest.mark.parametrize("actuation", ["immediate", "next_tick"])
def test_uavs_of_one_agent_fly_by_their_own_sensors(actuation: str) -> None:
    """As those of agents of one UAV each, with missing measurements; and by (31d), (31e), (31i), within limits."""
    settings = (
        *SENSED,
        f"clock.actuation={actuation}",
        "controller.limits.thrust_N=[0.0,22.3]",
    )
    single, pairs = (runs.ready("alone", *settings, *more) for more in ((), (PAIRS,)))
    run, k, period_s = single, single.ticks // 2, single.settings.sampling_period_s
    delay = int(run.scenario.clock.next_tick)
    planners = [AlonePlanner(single.run, agent, lambda: 0) for agent in (3, 4)]
    pair = AlonePlanner(pairs.run, 2, lambda: 0)
    regulation = Regulation(run.model, run.hover, run.settings, run.reference.sampled)
    team = AloneTeam(run.model, run.hover, run.settings, regulation, run.reference.sampled)
    law, step = team.law(3), run.settings.largest_step(1)
    ages, tension_N = run.run.sensors.ages, float(run.hover.tensions[3])
    sensors, integral_I = OwnSensors(run.system, 3, tension_N, ages, period_s), np.zeros(3)
    low, high = run.settings.lower(1), run.settings.upper(1)

    def reference(tick: int) -> UavMotion:
        return team.setpoint(3, tick).motion

    before = None
    for tick in range(k, k + 4):
        alone = [
            _step(planner, _received(single, agent, tick, _sensed(single, tick, [agent - 1])))[0]
            for agent, planner in zip((3, 4), planners, strict=True)
        ]
        plan, _ = _step(pair, _received(pairs, 2, tick, _sensed(pairs, tick, [2, 3])))
        np.testing.assert_array_equal(plan.inputs, np.hstack([one.inputs for one in alone]))
        np.testing.assert_array_equal(plan.uav_states, np.vstack([one.uav_states for one in alone]))

        seen, start = _sensed(single, tick, [3]), tick + delay
        values = sensors.completed(seen.uav_states[0], seen.missing[0], tick)
        sensors.observe(values, float(seen.inputs[0][0]), tick, reference)
        motion, setpoint = sensors.motion(values, tick, start, reference), team.setpoint(3, start)
        if before is None or not delay:
            before = seen.inputs[0]
        if delay:
            motion = law.driven(motion, team.setpoint(3, tick), reference(start), before, period_s)
        wanted = law.inputs(motion, setpoint, integral_I)
        integral_I = law.integral_after(integral_I, motion, setpoint, period_s)
        before = np.clip(np.clip(wanted, before - step, before + step), low, high)
        np.testing.assert_allclose(plan.inputs[0, 4:], before, atol=1e-9)

    # Each plan repeats the measurements of the last ticks, the newest first.
    rows = plan.uav_states[1].reshape(state.REPORTS, -1)[:, state.SENSED_VALUES]
    told = [_sensed(single, k + 3 - age, [3]).uav_states[0] for age in range(state.REPORTS)]
    np.testing.assert_array_equal(rows, told)


def test_the_newest_measurement_counts_and_is_told_with_its_age() -> None:
    """A late one changes nothing; before the first the states are those of the reference."""
    run = runs.ready("alone", "plant.sensors=state", PAIRS, "controller.horizon=2")
    planner = AlonePlanner(run.run, 2, lambda: 0)
    plan, report = _step(planner, _received(run, 2, 200))
    np.testing.assert_array_equal(plan.inputs, np.tile(run.hover.u[8:], (2, 1)))
    np.testing.assert_array_equal(plan.uav_states, state.StateView(run.X_ref[200]).uavs[2:])
    assert (report.measurement_age, report.solver) == (-1, "alone")

    older, newer = (runs.measurement(run, 2, k, x=run.X_ref[k] + 1e-3) for k in (201, 202))
    expected, _ = _step(AlonePlanner(run.run, 2, lambda: 0), _received(run, 2, 202, newer))
    found, _ = _step(planner, _received(run, 2, 202, newer, older))
    np.testing.assert_array_equal(found.inputs, expected.inputs)
    np.testing.assert_array_equal(found.uav_states, newer.uav_states)
    _, report = _step(planner, _received(run, 2, 205))
    assert report.measurement_age == 3
    after, _ = _step(AlonePlanner(run.run, 2, lambda: 0), _received(run, 2, run.ticks + 9))
    np.testing.assert_array_equal(after.uav_states, state.StateView(run.X_ref[-1]).uavs[2:])


def test_setpoints_are_those_of_the_team_and_the_path_of_now() -> None:
    """They change with a failure and a target, and are those of the whole team again after a start."""
    run = runs.ready("alone", "plant.sensors=state", "maneuver.profile=smooth")
    k = 40
    measured = runs.measurement(run, AGENT, k + 30, x=run.X_ref[k])
    failed = frozenset({3})

    def planned(planner: AlonePlanner, **fields: Any) -> Array:
        return _step(planner, _received(run, AGENT, k + 30, measured, **fields))[0].inputs

    planner = AlonePlanner(run.run, AGENT, lambda: 0)
    whole = planned(planner)
    planner.restart()
    assert np.abs(planned(planner, off=failed, released=failed) - whole).max() > 1e-3
    planner.restart()
    np.testing.assert_array_equal(planned(planner), whole)

    given = requested(TargetSection, {"points_m": [[2.0, 0.0, -10.0]]})
    fields = target_fields(run, given, k)
    led = run.after([Outbox("coordinator", 0).stamp(Target, number=1, **fields)])
    planner.follow(led.run)
    regulation = Regulation(run.model, run.hover, run.settings, run.reference.sampled)
    team = AloneTeam(run.model, run.hover, run.settings, regulation, run.reference.sampled)
    motion = motion_of(run.system, AGENT - 1, run.X_ref[k])
    law, setpoint = team.law(AGENT - 1), team.setpoint(AGENT - 1, k + 30)
    integral_I = law.integral_after(
        np.zeros(3), motion, setpoint, run.settings.sampling_period_s
    )  # of the plan before
    for each in (regulation, team):
        each.follow(led.reference.sampled)
    expected = law.inputs(motion, team.setpoint(AGENT - 1, k + 30), integral_I)
    assert np.abs(expected - whole[0]).max() > 1e-3
    np.testing.assert_allclose(planned(planner)[0], expected, atol=1e-9)


def test_times_in_the_report_are_those_of_the_step() -> None:
    """Waiting lasts from the end of the step before to the first message, solving from there on."""
    run = runs.ready("alone", "plant.sensors=state")
    now_ns = iter([10, 1000, 1300, 2000, 5000, 5400, 6000])
    planner = AlonePlanner(run.run, AGENT, lambda: next(now_ns))
    for started_ns, wait, solve, total in ((900, 890, 300, 400), (4500, 2500, 400, 900)):
        _, report = _step(planner, _received(run, AGENT, 5, started_ns=started_ns))
        times_ns = {name: round(1e6 * ms) for name, ms in zip(STAGES, report.times_ms, strict=True)}
        assert (times_ns["wait"], times_ns["solve"], times_ns["total"]) == (wait, solve, total)
        assert times_ns["publish"] == 7
