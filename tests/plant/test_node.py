"""The plant as a state machine: measures each tick once, integrates when the inputs are decided, refuses, ends."""

import numpy as np
import pytest
from msgspec.structs import replace

from model import state
from plant.schedule import BEFORE_ANY_PLAN, FAIL_SAFE
from protocol.scenario.setup import Setup
from protocol.wire.messages import Measurement, Message, PlantState, Presence
from tests.support.nodes import PlantNode, refused
from tests.support.runs import ALL, end, integrated, measurement, plan, roster, setup, tick

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


def test_measures_a_tick_once() -> None:
    """An open tick is measured once for every agent: its own UAVs, the payload, and its inputs."""
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
    assert tell(node, tick(0, members=(1, 2, 3))) == []


def test_forwards_who_answered() -> None:
    """The agents that answered and the roster in force are forwarded with the measurements."""
    node = ready(setup())
    run = setup()
    tell(node, tick(0), *[plan(run, agent, 0) for agent in ALL])
    found = tell(node, roster({1: 1, 2: 1, 3: 1}, version=2), tick(1, answered=(1, 3), members=(1, 2, 3), version=2))
    assert kinds(found) == measured(1, 3)
    assert {(m.answered, m.roster) for m in found if isinstance(m, Measurement)} == {((1, 3), 2)}


@pytest.mark.parametrize("last", ALL)
def test_immediate_integrates_with_all_plans(last: int) -> None:
    """Actuation "immediate": [t_k, t_k+1) is integrated once the last member's plan of tick k is in."""
    run = setup(IMMEDIATE)
    node = ready(run)
    tell(node, tick(0))
    for agent in ALL:
        if agent != last:
            assert tell(node, plan(run, agent, 0)) == []
    assert tell(node, tick(1)) == []
    assert kinds(tell(node, plan(run, last, 0))) == ["plant_state 0", *measured(1)]


def test_next_tick_integrates_while_agents_plan() -> None:
    """Actuation "next_tick": [t_k, t_k+1) needs the plans of k - 1 alone, so it is integrated as tick k is measured."""
    run = setup(NEXT_TICK)
    node = ready(run)
    assert kinds(tell(node, tick(0))) == [*measured(0), "plant_state 0"]
    assert tell(node, plan(run, 1, 0, delay=1), plan(run, 2, 0, delay=1), plan(run, 3, 0, delay=1)) == []
    assert tell(node, plan(run, 4, 0, delay=1)) == []
    assert kinds(tell(node, tick(1))) == [*measured(1), "plant_state 1"]


def test_next_tick_waits_for_plans_on_their_way() -> None:
    """A plan the clock has seen and the plant has not is waited for before the interval it decides."""
    run = setup(NEXT_TICK)
    node = ready(run)
    tell(node, tick(0))
    for agent in (1, 2, 4):
        tell(node, plan(run, agent, 0, delay=1))
    assert kinds(tell(node, tick(1))) == measured(1)
    assert kinds(tell(node, plan(run, 3, 0, delay=1))) == ["plant_state 1"]


@pytest.mark.parametrize("actuation", [IMMEDIATE, NEXT_TICK])
def test_who_left_is_not_waited_for(actuation: str) -> None:
    """A roster without the missing agent lets the interval be integrated; its UAV continues its last plan."""
    run = setup(actuation)
    delay = int(actuation == NEXT_TICK)
    node = ready(run)
    tell(node, tick(0), *[plan(run, agent, 0, delay=delay) for agent in (1, 2, 3)])
    tell(node, tick(1))
    found = tell(node, roster({1: 1, 2: 1, 3: 1}, version=2), tick(1, answered=(1, 2, 3), version=2))
    plant_states = [message for message in found if isinstance(message, PlantState)]
    assert [message.tick for message in plant_states] == [delay]
    assert plant_states[0].plan_ticks == (0, 0, 0, BEFORE_ANY_PLAN)


def test_an_answer_that_was_lost_with_its_agent() -> None:
    """An agent that answered and then left is not waited for: its plan may never arrive."""
    run = setup(IMMEDIATE)
    node = ready(run)
    tell(node, tick(0), *[plan(run, agent, 0) for agent in (1, 3, 4)])
    found = tell(node, tick(1, members=(1, 3, 4), version=2), roster({1: 1, 3: 1, 4: 1}, version=2))
    assert kinds(found) == ["plant_state 0", *measured(1, 3)]


def test_the_end_of_an_agent_that_answered() -> None:
    """The plan of an agent that answered and then left is waited for: the coordinator relays it."""
    run = setup(NEXT_TICK)
    node = ready(run)
    tell(node, tick(0), *[plan(run, agent, 0, delay=1) for agent in (1, 3, 4)])
    assert kinds(tell(node, roster({1: 1, 3: 1, 4: 1}, k=1, version=2), tick(1, version=2))) == measured(1, 3)
    assert tell(node, Presence("agent2", 1, alive=False)) == []
    (record,) = tell(node, plan(run, 2, 0, delay=1))
    assert isinstance(record, PlantState)
    assert record.plan_ticks == (0, 0, 0, 0)


def test_waits_for_the_roster_of_a_tick() -> None:
    """A tick that names a roster not yet here is measured when it is."""
    run = setup()
    node = PlantNode(run)
    assert tell(node, tick(0)) == []
    assert kinds(tell(node, roster())) == measured(0)


def test_truth_is_the_integrated_state() -> None:
    """PlantState k holds the state at t_k and the inputs from there; measurement k + 1 the state they lead to."""
    run = setup(IMMEDIATE)
    node = ready(run)
    tell(node, tick(0))
    x, u = run.initial_state(), run.hover.u + np.tile([1.0, 0.1, -0.1, 0.05], 4) * np.repeat([1.0, 2.0, 3.0, 0.5], 4)
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


def test_lost_agents_uav_plays_on() -> None:
    """The UAV of an agent that left follows its last plan to the end, then the fail-safe."""
    run = setup(IMMEDIATE, "controller.horizon=3")
    node = ready(run)
    tell(node, tick(0), *[plan(run, agent, 0) for agent in ALL])
    tell(node, roster({1: 1, 2: 1, 3: 1}, version=2))
    sources = []
    for k in range(1, 5):
        found = tell(node, tick(k, answered=(1, 2, 3), version=2), *[plan(run, agent, k) for agent in (1, 2, 3)])
        sources += [message.plan_ticks for message in found if isinstance(message, PlantState)]
    assert sources == [(1, 1, 1, 0), (2, 2, 2, 0), (3, 3, 3, FAIL_SAFE), (4, 4, 4, FAIL_SAFE)]


@pytest.mark.parametrize(
    ("actuation", "changes", "reason"),
    [
        (IMMEDIATE, {"incarnation": 0}, "wrong_incarnation"),
        (IMMEDIATE, {"tick": 1, "start_tick": 1}, "future"),
        (NEXT_TICK, {"tick": 1, "start_tick": 2}, "future"),
        (IMMEDIATE, {"inputs": np.array([[22.0, 0.0, 0.0, 0.0], [45.001, 0.0, 0.0, 0.0]])}, "outside_limits"),
    ],
)
def test_refused_plans(actuation: str, changes: dict[str, object], reason: str) -> None:
    """An implausible plan is not followed, is counted, and does not end the wait."""
    run = setup(actuation)
    delay = int(actuation == NEXT_TICK)
    node = ready(run)
    tell(node, tick(0))
    forged = replace(plan(run, 2, 0, delay=delay), **changes)
    assert tell(node, forged) == []
    assert refused(node) == [(forged.sender, reason, 1)]
    tell(node, *[plan(run, agent, 0, delay=delay) for agent in (1, 3, 4)])
    assert kinds(tell(node, tick(1))) == measured(1) * delay
    found = tell(node, plan(run, 2, 0, delay=delay))
    assert kinds(found)[0] == f"plant_state {delay}"


def test_end_of_the_run() -> None:
    """The coordinator's control message ends the run for the plant; without a coordinator it ends with exit code 4."""
    node = ready(setup())
    assert tell(node, end()) == []
    assert node.finished == end()
    node = ready(setup())
    assert tell(node, tick(0), Presence("coordinator", 0, alive=False))[4:] == []
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == ("aborted", 4)
    assert node.finished.reason == "coordinator is gone"
