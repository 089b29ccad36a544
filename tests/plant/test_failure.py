"""Scripted failures in the plant.

Motors off and rods released from their tick on, independent of the plans.
"""

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, VEHICLE, plan, roster, setup, tick
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover_after_failures
from transport.plant.actuator_schedule import FAIL_SAFE, MOTOR_OFF
from transport.plant.inner_loops import RateLoop
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import ActualInputs, Measurement, Message, PlantState

TICKS = 6
UAV = 2
MOTORS_OFF = setup("faults.event=[{at_s=0.1,do='motor_off',target='uav3'}]")
RELEASED = setup("faults.event=[{at_s=0.1,do='release',target='uav3'}]")
AT = 2  # tick of both
# Of a plan by vehicle sensors, without any of their measurements.
NO_REPORTS = np.zeros((1, state.REPORTS * state.REPORTED))


def flown(run: Setup) -> list[Message]:
    """Return the plant's messages while every agent plans hover."""
    node = PlantNode(run)
    messages = list(node.receive(roster(), 0))
    for k in range(TICKS):
        messages += node.receive(tick(k), 0)
        for agent in ALL:
            hovering = plan(run, agent, k)
            if run.sensors.vehicle:
                hovering = replace(hovering, uav_states=NO_REPORTS)
            messages += node.receive(hovering, 0)
    return messages


def plant_states(messages: list[Message]) -> list[PlantState]:
    """Return the plant states, tick by tick."""
    return [message for message in messages if isinstance(message, PlantState)]


@pytest.mark.parametrize("run", [MOTORS_OFF, RELEASED], ids=["motor_off", "release"])
def test_no_wrench_from_the_tick_on(run: Setup) -> None:
    """Thrust and moments are exactly zero from the tick on, and the plant state says that no plan was followed."""
    record = plant_states(flown(run))
    assert len(record) == TICKS
    for k, plant_state in enumerate(record):
        inputs = plant_state.u[state.input_slice(UAV)]
        assert inputs.any() == (k < AT)
        assert plant_state.plan_ticks == ((k,) * 4 if k < AT else (k, k, MOTOR_OFF, k))
        assert np.delete(plant_state.u, state.input_indices([UAV])).any()


def test_a_released_rod_hangs_down() -> None:
    """At its tick the released bob is at rest below its corner.

    Until then it follows the flight without fault.
    """
    record, before = plant_states(flown(RELEASED)), plant_states(flown(setup()))
    for k in range(AT):
        np.testing.assert_array_equal(record[k].x, before[k].x)
    hung = record[AT].x[state.uav_slice(UAV)]
    np.testing.assert_allclose(hung[state.E], [0.0, 0.0, -1.0], atol=1e-9)
    assert not hung[3:].any()
    others = np.delete(np.arange(len(record[AT].x)), np.arange(60)[state.uav_slice(UAV)])
    np.testing.assert_array_equal(record[AT].x[others], before[AT].x[others])
    # Three at the thrust of four sink by (3 - 3 x 7.36 / 9.81) kg g; no roster has told them yet.
    assert record[-1].x[5] > 0.1


def test_no_wind_blows_on_what_is_gone() -> None:
    """Drag acts on payload and attached UAVs only, not on a bob of a millionth of a kilogram."""
    run = setup(
        "faults.event=[{at_s=0.1,do='release',target='uav3'}]", "plant.wind.speed_mps=[5.0,0.0,0.0]"
    )
    node = PlantNode(run)
    node.environment.release(UAV)
    forces = node.environment.forces(0, run.initial_state())
    assert forces is not None
    np.testing.assert_array_equal(
        forces.reshape(-1, 3).any(axis=1), [True, True, True, False, True]
    )


def test_sensors_feel_neither_wind_nor_thrust_of_a_released_uav() -> None:
    """At the tick of the release its wind and thrust were those of a whole UAV, on the bob."""
    run = setup(
        *(*VEHICLE, "plant.wind.speed_mps=[8.0,0.0,0.0]"),
        "faults.event=[{at_s=0.1,do='release',target='uav3'}]",
    )
    measured = [message for message in flown(run) if isinstance(message, Measurement)]
    forces = [one.uav_states[:, state.SPECIFIC_FORCE] for one in measured]
    assert len(forces) == len(ALL) * TICKS
    assert np.abs(forces).max() < 5.0 * run.system.gravity


def test_a_uav_without_motors_turns_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its rotation stops, and neither its agent nor an inner loop turns it; the loop is told that the state jumped."""
    told: list[Array] = []
    monkeypatch.setattr(RateLoop, "reset", lambda _, x: told.append(x))
    event = "faults.event=[{at_s=0.1,do='motor_off',target='uav3'}]"
    run = setup("controller.inputs=rates", "clock.actuation=immediate", event)
    node = PlantNode(run)
    messages = list(node.receive(roster(), 0))
    turning = np.tile([20.0, 0.5, -0.5, 0.3], (20, 1))
    for k in range(TICKS):
        messages += node.receive(tick(k), 0)
        for agent in ALL:
            messages += node.receive(plan(run, agent, k, inputs=turning), 0)
    given = [one.inputs for one in messages if isinstance(one, ActualInputs)]
    rates = [state.uav_blocks(one.x)[:, state.OMEGA] for one in plant_states(messages)]
    np.testing.assert_array_equal(told, [plant_states(messages)[AT].x])
    for k in range(TICKS):
        turned = [True, True, k < AT, True]
        assert given[k].any(axis=1).tolist() == turned
        assert rates[k].any(axis=1).tolist() == (turned if k else [False] * 4)


@pytest.mark.parametrize("do", ["motor_off", "release"])
def test_the_fail_safe_carries_what_remains(do: str) -> None:
    """Without plans the other three hold the payload and, unless it is off its rod, the dead UAV, (51)."""
    run = setup(
        "clock.actuation=immediate",
        "controller.limits.thrust_rate_N_s=2000.0",
        f"faults.event=[{{at_s=0.1,do='{do}',target='uav3'}}]",
    )
    node = PlantNode(run)
    messages = list(node.receive(roster(), 0))
    hover = np.tile(run.hover.u[:4], (AT, 1))  # for the ticks before
    for k in range(AT + 2):
        messages += node.receive(tick(k, answered=()), 0)
        for agent in ALL if k == 0 else ():
            messages += node.receive(plan(run, agent, 0, inputs=hover), 0)
    found = plant_states(messages)[AT]
    assert found.plan_ticks == (FAIL_SAFE, FAIL_SAFE, MOTOR_OFF, FAIL_SAFE)
    released = [UAV] if do == "release" else []
    expected = hover_after_failures(run.system, [UAV], released).u
    np.testing.assert_allclose(found.u, expected, atol=1e-3)
