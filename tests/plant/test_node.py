"""The plant as a state machine.

Measures each tick once, integrates when the inputs are decided, refuses, ends.
"""

import numpy as np
from msgspec.structs import replace

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, VEHICLE, end, integrated, measurement, plan, roster, setup, tick
from transport.flight.roles import plant_run
from transport.model import state
from transport.plant.actuator_schedule import BEFORE_ANY_PLAN, FAIL_SAFE
from transport.plant.wind_and_noise import Environment
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Message, PlantState, Presence

NOISES = ("position_m", "velocity_mps", "attitude_rad", "rate_rads", "specific_force_mps2")
IMMEDIATE, NEXT_TICK = "clock.actuation=immediate", "clock.actuation=next_tick"


def ready(run: Setup) -> PlantNode:
    """Return a plant with a roster."""
    node = PlantNode(run)
    assert tell(node, roster()) == []
    return node


def tell(node: PlantNode, *events: Message | Presence) -> list[Message]:
    """Pass events to the plant and return all its messages."""
    return [message for event in events for message in node.receive(event, 0)]


def kinds(messages: list[Message]) -> list[str]:
    """Return kinds and ticks of messages, in order."""
    return [f"{message.kind} {message.tick}" for message in messages]


def measured(k: int, agents: int = 4) -> list[str]:
    """Return the measurements among messages."""
    return [f"measurement {k}"] * agents


def test_measures_a_tick() -> None:
    """An open tick is measured for every agent: its own UAVs, the payload, and its inputs."""
    run = setup("agents.owned=[[1],[2,4],[3]]")
    node = PlantNode(run)
    tell(node, roster({1: 1, 2: 1, 3: 1}))
    found = tell(node, tick(0, members=(1, 2, 3)))
    assert kinds(found) == measured(0, 3)
    for message, agent in zip(found, (1, 2, 3), strict=True):
        assert isinstance(message, Measurement)
        expected = measurement(run, agent, 0)
        assert (message.agent, message.uavs, message.answered) == (agent, expected.uavs, ())
        for field in ("payload", "uav_states", "inputs"):
            np.testing.assert_array_equal(getattr(message, field), getattr(expected, field))


def test_measurements_tell_who_answered_and_who_shared_their_plans() -> None:
    """As the tick says of the one before; with the roster that it names."""
    node = ready(setup(NEXT_TICK))
    tell(node, tick(0))
    said = replace(tick(1, answered=(1, 2, 4)), shared=(2, 4))
    found = [one for one in tell(node, said) if isinstance(one, Measurement)]
    told = {(one.answered, one.shared, one.roster) for one in found}
    assert (len(found), told) == (4, {((1, 2, 4), (2, 4), 1)})


def test_a_tick_waits_for_its_roster() -> None:
    """Agents are measured by the roster that the tick names, which may come after it."""
    node = ready(setup(NEXT_TICK))
    assert tell(node, tick(0, members=(1, 2, 3), version=2)) == []
    found = tell(node, roster({1: 1, 2: 1, 3: 1}, version=2))
    assert kinds(found) == [*measured(0, 3), "plant_state 0"]


def test_vehicle_sensors_measure_the_motion_under_actual_inputs_and_wind() -> None:
    """Of the actual centre of mass, at the end of the period before; outages are told until their end."""
    outage = "do='sensors_off',target='uav3',sensors=['position','rate'],duration_s=0.1"
    run = setup(
        *VEHICLE,
        *(f"plant.noise.{name}=0.0" for name in NOISES),
        "plant.uav=[{id=2,thrust_factor=0.9}]",
        "plant.payload_centre_m=[0.3,-0.2,0.1]",
        "plant.wind.gust_mps=[5.0,5.0,5.0]",
        f"faults.event=[{{at_s=0.1,{outage}}}]",
        IMMEDIATE,
    )
    node = ready(run)
    found = tell(node, tick(0))
    for k in range(1, 5):
        reports = np.zeros((1, state.REPORTS * state.REPORTED))
        shove = np.tile([25.0, 0.5, -0.5, 0.2], (20, 1))
        plans = [plan(run, agent, k - 1, inputs=shove) for agent in ALL]
        found += tell(node, *(replace(one, uav_states=reports) for one in plans), tick(k))
    states = [one for one in found if isinstance(one, PlantState)]
    by_agent = [one for one in found if isinstance(one, Measurement) and one.agent == 2]
    environment = Environment(plant_run(run))
    factors = np.repeat([1.0, 0.9, 1.0, 1.0], 4)
    for before, now, one in zip(states, states[1:], by_agent[1:], strict=False):
        x = environment.of_centre(now.x)
        forces = environment.forces(before.tick, before.x)
        expected = environment.model.sensed(x, factors * before.u, forces=forces)
        np.testing.assert_allclose(one.uav_states[0], expected.reshape(4, -1)[1], atol=1e-9)
    lacking = [one.missing for one in found if isinstance(one, Measurement) and one.agent == 3]
    assert lacking == [(), (), (0b01001,), (0b01001,), ()]


def test_truth_is_the_integrated_state() -> None:
    """PlantState k holds the state at t_k and the inputs from there.

    Measurement k + 1 the state they lead to.
    """
    run = setup(IMMEDIATE)
    node = ready(run)
    tell(node, tick(0))
    x, u = (
        run.initial_state(),
        run.hover.u + np.tile([1.0, 0.1, -0.1, 0.05], 4) * np.repeat([1.0, 2.0, 3.0, 0.5], 4),
    )
    plans = [plan(run, a, 0, inputs=np.tile(u[4 * a - 4 : 4 * a], (20, 1))) for a in ALL]
    (record,) = tell(node, *plans)
    assert isinstance(record, PlantState)
    np.testing.assert_array_equal(record.x, x)
    np.testing.assert_array_equal(record.u, u)
    assert record.plan_ticks == (0, 0, 0, 0)
    assert record.diverged == ""
    assert 0.0 < record.local_error < 1e-9
    ahead = integrated(run, x, u)
    for message, agent in zip(tell(node, tick(1)), ALL, strict=True):
        assert isinstance(message, Measurement)
        np.testing.assert_array_equal(message.payload, ahead[:12])
        np.testing.assert_array_equal(message.uav_states, ahead[None, state.uav_slice(agent - 1)])
        np.testing.assert_array_equal(message.inputs, u[None, 4 * agent - 4 : 4 * agent])


def test_plans_that_come_early_are_not_forgotten() -> None:
    """Plans of tick 1 decide the inputs of tick 2, also if they overtook those of tick 0."""
    run = setup(NEXT_TICK)
    node = ready(run)
    assert kinds(tell(node, tick(0))) == [*measured(0), "plant_state 0"]
    assert kinds(tell(node, tick(1))) == measured(1)
    early = [plan(run, agent, 1, delay=1) for agent in ALL]
    assert tell(node, *early) == []
    found = tell(node, *[plan(run, agent, 0, delay=1) for agent in ALL])
    assert kinds(found) == ["plant_state 1"]
    found = tell(node, tick(2))
    assert kinds(found) == [*measured(2), "plant_state 2"]
    assert isinstance(found[-1], PlantState)
    assert found[-1].plan_ticks == (1, 1, 1, 1)


def test_lost_plans_are_counted_and_not_followed() -> None:
    """By the UAVs that do not follow the plan of the tick; the count is that of the period."""
    run = setup(IMMEDIATE, "links.actuation.loss=0.4")
    node = ready(run)
    found = []
    for k in range(12):
        found += tell(node, tick(k), *[plan(run, agent, k) for agent in ALL])
    states = [one for one in found if isinstance(one, PlantState)]
    missed = [sum(source != one.tick for source in one.plan_ticks) for one in states]
    assert [one.plans_lost for one in states] == missed
    assert len(set(missed)) > 2


def test_an_agent_is_told_what_its_own_uavs_see() -> None:
    """A sphere of 0.1 m, whose surface is 1.9 m from the first UAV and farther from the others."""
    x, y, z = plant_run(setup()).run.positions_I(setup().initial_state())[0]
    where = [float(x + 2.0 * np.sign(x)), float(y), float(z)]
    sphere = f"kind='sphere',at_m={where},radius_m=0.1,margin_m=0.1,seen_within_m=1.95"
    run = setup(f"obstacle=[{{{sphere}}}]", "agents.owned=[[3],[1,2],[4]]")
    node = PlantNode(run)
    tell(node, roster({1: 1, 2: 1, 3: 1}))
    found = [one for one in tell(node, tick(0, members=(1, 2, 3))) if isinstance(one, Measurement)]
    assert [len(one.seen) for one in found] == [0, 1, 0]
    np.testing.assert_allclose(found[1].seen[0, 1:4], where)


def test_plans_of_a_tick_are_awaited_whatever_a_later_tick_says() -> None:
    """The clock tells with tick 2 who answered tick 1; inputs from tick 1 on are those of tick 0, of all agents."""
    run = setup(NEXT_TICK)
    node = ready(run)
    tell(node, tick(0), tick(1))
    assert tell(node, tick(2, answered=(1, 2, 3))) == []
    assert tell(node, *[plan(run, agent, 0, delay=1) for agent in (1, 2, 3)]) == []
    found = tell(node, plan(run, 4, 0, delay=1))
    assert kinds(found) == ["plant_state 1", *measured(2)]


def test_lost_agents_uav_plays_on() -> None:
    """The UAV of an agent that left follows its last plan to the end, then the fail-safe."""
    run = setup(IMMEDIATE, "controller.horizon=3")
    node = ready(run)
    tell(node, tick(0), *[plan(run, agent, 0) for agent in ALL])
    tell(node, roster({1: 1, 2: 1, 3: 1}, version=2))
    sources = []
    for k in range(1, 5):
        found = tell(
            node,
            tick(k, answered=(1, 2, 3), version=2),
            *[plan(run, agent, k) for agent in (1, 2, 3)],
        )
        sources += [message.plan_ticks for message in found if isinstance(message, PlantState)]
    assert sources == [(1, 1, 1, 0), (2, 2, 2, 0), (3, 3, 3, FAIL_SAFE), (4, 4, 4, FAIL_SAFE)]


def test_an_agent_that_has_not_answered_is_not_waited_for_any_longer() -> None:
    """Its plan of a tick may still come until the next tick names those that have answered."""
    run = setup(IMMEDIATE)
    node = ready(run)
    tell(node, tick(0))
    assert tell(node, *[plan(run, agent, 0) for agent in (1, 2, 3)]) == []
    assert tell(node, roster({1: 1, 2: 1, 3: 1}, k=1, version=2)) == []
    found = tell(node, tick(1, answered=(1, 2, 3), members=(1, 2, 3), version=2))
    assert kinds(found) == ["plant_state 0", *measured(1, 3)]
    assert isinstance(found[0], PlantState)
    assert found[0].plan_ticks == (0, 0, 0, BEFORE_ANY_PLAN)


def test_end_of_the_run() -> None:
    """The coordinator's control message ends the run for the plant.

    Without a coordinator it ends with exit code 4.
    """
    node = ready(setup())
    assert tell(node, end()) == []
    assert node.finished == end()
    node = ready(setup())
    assert tell(node, tick(0), Presence("coordinator", 0, alive=False))[4:] == []
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == ("aborted", 4)
    assert node.finished.reason == "coordinator is gone"
