"""The controller "alone": its plans begin where the actuators are, and follow the law of a UAV alone."""

import numpy as np
import pytest
from msgspec import structs

from tests.support import runs
from transport.agent.planning.alone_planner import AlonePlanner
from transport.agent.received import Received
from transport.model import state
from transport.model.arrays import Array
from transport.mpc.alone.uav_motion import motion_of
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Plan
from transport.protocol.wire.node_interface import Outbox

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
