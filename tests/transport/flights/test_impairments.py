"""Flights over bad links.

What every node works with is what the links let through, in any order of delivery.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import pytest

from tests.support.runs import SHORT, plant_states, recorded, reproducible, setup
from tests.support.shuffled import fly_shuffled
from tests.support.troubles import FAULTS, HEAVY, ITERATIONS, NEXT_TICK, RESILIENT
from transport.model import state
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Measurement, Message, Plan, StepReport, agent_name

TICKS = 30
FAIL_SAFE = -2

# The model alone predicts over a delay: agents and plant integrate with steps of their own, 1e-11
# apart per period.
PREDICTION_TOLERANCE = 1e-8


@lru_cache
def flight(*settings: str) -> tuple[Message, ...]:
    """Every message of a short flight."""
    return tuple(recorded(setup(SHORT, *RESILIENT, *settings)))


def reports(messages: Sequence[Message], agent: int) -> list[StepReport]:
    """An agent's reports, in order of their ticks."""
    found = [
        message
        for message in messages
        if isinstance(message, StepReport) and message.agent == agent
    ]
    assert [report.tick for report in found] == list(range(len(found)))
    return found


def newest(run: Setup, ends: tuple[str, str], tick: int, after: int) -> int:
    """The newest message that a link has let through by a tick; -1 for none.

    `after`: ticks from sending until a message without delay can be used.
    """
    link = run.rules.link(*ends)
    usable = [k for k in range(tick + 1) if min(link.usable_ticks(k, after), default=TICKS) <= tick]
    return max(usable, default=-1)


@pytest.mark.parametrize("settings", [(HEAVY,), (HEAVY, NEXT_TICK), (HEAVY, ITERATIONS, NEXT_TICK)])
def test_agents_use_exactly_the_messages_that_links_deliver(settings: tuple[str, ...]) -> None:
    """Ages of plans, states and measurements in every report follow from the links alone."""
    run, messages = setup(SHORT, *RESILIENT, *settings), flight(*settings)
    ages = []
    for agent in run.agents:
        found = reports(messages, agent)
        assert len(found) == TICKS  # no lost or delayed message stops the clock
        for report in found:
            k = report.tick
            sent = {
                name: newest(run, (name, agent_name(agent)), k, 1)
                for name in map(agent_name, report.peers)
            }
            assert report.plan_ages == tuple(-1 if at < 0 else k - at for at in sent.values())
            assert report.state_ages == report.plan_ages
            seen = newest(run, ("plant", agent_name(agent)), k, 0)
            assert report.measurement_age == (-1 if seen < 0 else k - seen)
            ages += [*report.plan_ages, report.measurement_age]
    assert {-1, 0, 1, 2, 3, 4} <= set(ages)


@pytest.mark.parametrize(("settings", "after"), [((HEAVY,), 0), ((HEAVY, NEXT_TICK), 1)])
def test_the_plant_uses_exactly_the_plans_that_links_deliver(
    settings: tuple[str, ...], after: int
) -> None:
    """`PlantState.plan_ticks` names the newest plan that reached the plant for each UAV, -1 before the first."""
    run, messages = setup(SHORT, *RESILIENT, *settings), flight(*settings)
    for plant_state in plant_states(messages):
        expected = tuple(
            newest(run, (agent_name(agent), "plant"), plant_state.tick, after)
            for agent in run.agents
        )
        assert plant_state.plan_ticks == expected


@pytest.mark.parametrize(("delay_s", "age"), [(0.01, 1), (0.05, 1), (0.06, 2), (0.15, 3)])
def test_a_delayed_measurement_is_predicted_over(delay_s: float, age: int) -> None:
    """A measurement delayed by d is used from d later on.

    What happened since is known from the plans, exactly.
    """
    messages = flight(f"links.measurement.delay_s={delay_s}")
    for report in reports(messages, 1):
        assert report.measurement_age == (age if report.tick >= age else -1)
    x = {plant_state.tick: plant_state.x for plant_state in plant_states(messages)}
    for plan in messages:
        if isinstance(plan, Plan):
            estimate, true = plan.uav_states[0], x[plan.tick][state.uav_slice(plan.agent - 1)]
            np.testing.assert_allclose(estimate, true, rtol=0.0, atol=PREDICTION_TOLERANCE)


def test_lost_measurements_leave_the_clock_ticking() -> None:
    """Without a single measurement after the start agents go on by prediction, every tick, and say how old it is."""
    messages = flight("links.change=[{at_s=0.05,from='plant',loss=1.0}]")
    assert [plant_state.tick for plant_state in plant_states(messages)] == list(range(TICKS))
    for agent in (1, 2, 3, 4):
        assert [report.measurement_age for report in reports(messages, agent)] == list(range(TICKS))
    # Physically all are sent.
    assert sum(isinstance(message, Measurement) for message in messages) == 4 * TICKS


@pytest.mark.parametrize(
    ("delay_s", "settings", "age"),
    [
        (0.0, (), 0),
        (0.01, (), 1),
        (0.1, (), 2),
        (0.12, (), 3),
        (0.0, (NEXT_TICK,), 1),
        (0.05, (NEXT_TICK,), 1),
        (0.06, (NEXT_TICK,), 2),
        (0.15, (NEXT_TICK,), 3),
    ],
)
def test_actuation_delay(delay_s: float, settings: tuple[str, ...], age: int) -> None:
    """A plan acts from the first tick at or after its arrival at the plant.

    Till then an older one does.
    """
    messages = flight(f"links.actuation.delay_s={delay_s}", *settings)
    followed = [plant_state.plan_ticks for plant_state in plant_states(messages)]
    assert followed == [(max(k - age, -1),) * 4 for k in range(TICKS)]


def test_late_plans_are_played_at_their_own_instant() -> None:
    """A plan that comes late is not played late: the plant goes on with its step for now."""
    messages = flight("links.actuation.delay_s=0.1")
    plans = {(plan.agent, plan.tick): plan for plan in messages if isinstance(plan, Plan)}
    for plant_state in plant_states(messages)[2:]:
        for agent in (1, 2, 3, 4):
            step = plans[agent, plant_state.tick - 2].inputs[2]
            np.testing.assert_array_equal(plant_state.u[state.input_slice(agent - 1)], step)


def test_one_uav_cut_off_from_its_controller() -> None:
    """Over a partition between plant and agent its UAV plays its last plan to the end, then the fail-safe, then a new.

    The other UAVs are not concerned, nor are the plans between agents.
    """
    own_section = "links.override=[{from='agent2',to='plant'}]"
    changes = "links.change=[{at_s=0.5,from='agent2',to='plant',loss=1.0},{at_s=1.0,from='agent2',to='plant',loss=0.0}]"
    messages = flight("controller.horizon=5", own_section, changes)
    assert [plant_state.plan_ticks[1] for plant_state in plant_states(messages)] == [
        *range(10),
        *[9] * 4,  # 5 steps from tick 9 on
        *[FAIL_SAFE] * 6,
        *range(20, 30),
    ]
    assert all(
        plant_state.plan_ticks[::2] == (plant_state.tick,) * 2
        for plant_state in plant_states(messages)
    )
    assert all(report.plan_ages == (1, 1, 1) for report in reports(messages, 1)[1:])


def test_a_partition_of_agents_leaves_the_links_of_the_plant() -> None:
    """Where it does not name the plant, plans still act at once; those between the parts stop."""
    messages = flight("links.partition=[{between=['agent2'],start_s=0.5,end_s=1.0}]")
    for plant_state in plant_states(messages):
        assert plant_state.plan_ticks == (plant_state.tick,) * 4
    # Of agent 2 the last plan before the partition is that of tick 9, the first one after it of 20.
    ages = [report.plan_ages for report in reports(messages, 1)]
    assert [age[0] for age in ages[1:]] == [*[1] * 9, *range(1, 12), *[1] * 9]
    assert all(age[1:] == (1, 1) for age in ages[1:])


def said(messages: Sequence[Message]) -> dict[tuple[str, int, int], bytes]:
    """Return the encoded messages by sender, incarnation and sequence number, without wall-clock times."""
    return {(m.sender, m.incarnation, m.sequence): encode(reproducible(m)) for m in messages}


@pytest.mark.slow
def test_order_of_delivery_does_not_matter() -> None:
    """With any links and faults, the order of arrival does not change a bit of any process's messages."""
    settings = (HEAVY, ITERATIONS, NEXT_TICK, *FAULTS)
    in_order = flight(*settings)
    for seed in range(2):
        run = setup(SHORT, *RESILIENT, *settings)
        shuffled = recorded(run, lambda run, record, seed=seed: fly_shuffled(run, record, seed))  # type: ignore[misc]
        assert [(m.kind, m.sender) for m in shuffled] != [(m.kind, m.sender) for m in in_order]
        assert said(shuffled) == said(in_order)
