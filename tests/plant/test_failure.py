"""Scripted failures in the plant.

Motors off and rods released from their tick on, independent of the plans.
"""

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, VEHICLE, plan, roster, setup, tick
from transport.model import state
from transport.plant.actuator_schedule import MOTOR_OFF
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Message, PlantState

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
