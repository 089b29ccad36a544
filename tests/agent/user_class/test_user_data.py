"""Own data, exchanges within a tick and estimates of a controller of the user."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import logs
from tests.support.nodes import AgentNode
from tests.support.own_classes import HEIGHT, Chain, Seldom
from tests.support.runs import (
    ALL,
    SHORT,
    VEHICLE,
    measurement,
    plan,
    plant_states,
    recorded,
    reproducible,
    roster,
    setup,
)
from transport.agent.user_class.user_controllers import checked_controller, plan_shapes
from transport.analysis.replay.replay_difference import Comparison
from transport.analysis.replay.replay_of_agent import Replay
from transport.model.state import INPUTS, REPORTED, REPORTS
from transport.protocol.scenario.radio.radio_parameters import PlanShape
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import MAX_DATA, Measurement, Message, Note, Plan

CHAIN = f"agents.controller={Chain.__module__}:Chain"
SELDOM = f"agents.controller={Chain.__module__}:Seldom"
ESTIMATING = f"agents.controller={Chain.__module__}:Estimating"
THREE = "controller.negotiation_iterations=3"
POOR_LINKS = (
    *("links.delay_s=0.06", "links.jitter_s=0.1", "links.loss=0.2"),
    *("links.duplicate=0.2", "links.reorder=0.2"),
)
DEATHS = (
    "clock.on_agent_loss=continue",
    "faults.event=[{at_s=0.2,do='kill',target='agent3'},{at_s=0.5,do='restart',target='agent3'},"
    "{at_s=0.6,do='stop',target='agent2'},{at_s=0.9,do='continue',target='agent2'}]",
)

# A chain changes with each arrival, so that steps have different ones: of 120 steps at least 97 on
# the links and with the failures below. A step without arrivals repeats that before it, and agents
# that are off the roster make no steps.
DIFFERENT_CHAINS = 80

# Estimate against ground truth with measured states and a perfect network: the other agents' inputs
# are announced, and what is left is the error of two integration steps in place of five, measured
# as 1.2e-12 at most.
SAME_STATE = 1e-9
# The same with the sensors of a small autopilot, in standard deviations that the filter claims for the
# height of the payload; measured as 1.8 at most.
DEVIATIONS = 5.0
# Largest deviation that it may claim, m: 2 cm at the start. A filter that claims to know nothing
# would keep within any number of deviations.
LARGEST_DEVIATION_M = 0.1


def numbers(messages: Sequence[Message], name: str) -> dict[tuple[int, int], float]:
    """Return a number for the log by agent and tick."""
    notes = [note for note in messages if isinstance(note, Note) and name in note.names]
    return {(note.agent, note.tick): note.values[note.names.index(name)] for note in notes}


@pytest.mark.parametrize("settings", [(), POOR_LINKS, (*POOR_LINKS, *DEATHS), (THREE, *POOR_LINKS)])
def test_data_arrive_as_they_were_sent(settings: tuple[str, ...]) -> None:
    """Data belong to their plan, whatever the links do, and two runs have the same bits."""
    run = setup(SHORT, CHAIN, *settings)
    once, again = (recorded(run) for _ in range(2))
    assert set(numbers(once, "errors").values()) == {0.0}
    assert len(set(numbers(once, "chain").values())) > DIFFERENT_CHAINS
    assert str([reproducible(one) for one in once]) == str([reproducible(one) for one in again])
    assert plant_states(once)[-1].x.tobytes() == plant_states(again)[-1].x.tobytes()


@pytest.mark.parametrize("settings", [(*POOR_LINKS, *DEATHS), (THREE, *POOR_LINKS)])
def test_a_replay_has_the_same_data(settings: tuple[str, ...]) -> None:
    """An agent that gets the recorded messages again shares the same numbers, bit for bit."""
    run = setup(SHORT, CHAIN, *settings)
    plans_of_a_tick = run.scenario.controller.negotiation_iterations
    log = logs.log_of(recorded(run))
    replay = Replay(run, log, 1)
    comparison = Comparison()
    for step in replay.steps():
        comparison.add(step)
    assert replay.notes == []
    assert not comparison.by_field
    assert comparison.plans == comparison.identical == run.ticks * plans_of_a_tick


def test_bytes() -> None:
    """Data take eight bytes a number and the head of the array; a plan without data has neither."""
    messages = recorded(setup(SHORT, CHAIN))
    one = next(message for message in messages if isinstance(message, Plan))
    bare = replace(one, data=np.zeros(0))
    head = 3 + 16  # extension type, and the lengths of the array
    longer_list = 2  # MessagePack: the header of a list of 16 fields
    data = 8 * math.prod(Chain.shape)
    assert len(encode(one)) == len(encode(bare)) + longer_list + head + data
    built_in = next(message for message in recorded(setup(SHORT)) if isinstance(message, Plan))
    assert not built_in.data.size


def test_a_class_decides_what_it_sends() -> None:
    """Plans are sent when the class says so, and when they have to be; others are kept back."""
    messages = recorded(setup(SHORT, SELDOM, *DEATHS))
    must_send = numbers(messages, "must_send")
    plans = [message for message in messages if isinstance(message, Plan)]
    assert plans
    for one in plans:
        is_wanted = one.tick % Seldom.every == 0
        assert one.shared == (is_wanted or bool(must_send[one.agent, one.tick]))


def test_own_data_are_sent_again_at_each_roster() -> None:
    """Each agent must send its first plan under each roster, and no other one.

    A roster brings agents that may have no plan of it yet. An agent that was off the roster for a
    while first sends under the roster that it returns with.
    """
    messages = recorded(setup(SHORT, SELDOM, *DEATHS))
    must_send = numbers(messages, "must_send")

    rosters = {
        (one.agent, one.tick): one.roster for one in messages if isinstance(one, Measurement)
    }
    seen: set[tuple[int, int]] = set()  # agents and versions of rosters
    expected = {}
    for agent, tick in sorted(must_send):
        under_roster = agent, rosters[agent, tick]
        expected[agent, tick] = under_roster not in seen
        seen.add(under_roster)

    assert must_send == expected
    # Two agents leave and return: five rosters, of which agents 2 and 3 miss the one without them.
    assert Counter(agent for agent, _ in seen) == {1: 5, 2: 4, 3: 4, 4: 5}
    # Were they all at ticks at which the class sends anyhow, the obligation would not show.
    assert any(is_so and tick % Seldom.every for (_, tick), is_so in must_send.items())


def test_plans_that_are_kept_back_do_not_arrive() -> None:
    """The others' plans arrive one tick after those that are sent, at the other ticks none."""
    messages = recorded(setup(SHORT, SELDOM))
    others = len(ALL) - 1
    for (_, tick), count in numbers(messages, "heard").items():
        is_after_send = tick > 0 and (tick - 1) % Seldom.every == 0
        assert count == (others if is_after_send else 0)


def test_a_class_tells_its_version() -> None:
    """The version of a class stands behind its name."""
    assert checked_controller(setup(SHORT, SELDOM).run).endswith(f":Seldom {Seldom.version}")


def test_data_of_another_shape_are_refused() -> None:
    """The plan is used without them, and a note names its sender; the step has not failed."""
    run = setup(SHORT, CHAIN)
    node = AgentNode(run, 1)
    node.receive(roster(), 0)
    node.receive(measurement(run, 1, 0, shared=()), 0)
    for agent in ALL[1:]:
        right = np.array([0.0, agent, 1.0, 0.0])  # tick, agent, chain, errors
        too_few = np.arange(3.0)
        data = too_few if agent == 3 else right
        node.receive(replace(plan(run, agent, 0), data=data), 0)
    answers = node.receive(measurement(run, 1, 1), 0)
    problems = [one.problem for one in answers if isinstance(one, Note) and one.problem]
    expected = "plan of agent3: expected data of shape (2, 2), got 3 numbers"
    assert problems == [f"controller {Chain.__module__}:Chain: {expected}"]
    assert [one.status for one in answers if isinstance(one, Plan)] == ["solved"]
    assert set(numbers(list(answers), "errors").values()) == {0.0}


def test_exchanges_within_a_tick() -> None:
    """A class plans anew after each exchange; its last result is the plan that is applied."""
    messages = recorded(setup(SHORT, CHAIN, THREE))
    tick = 5  # any: the chains of the agents differ by then
    plans = [message for message in messages if isinstance(message, Plan) and message.tick == tick]
    assert [one.negotiation for one in plans if one.agent == 2] == [2, 1, 0]
    applied = next(state for state in plant_states(messages) if state.tick == tick).u
    last = {one.agent: one for one in plans if one.negotiation == 0}
    for agent, one in last.items():
        thrust = INPUTS * (agent - 1)  # each agent owns the UAV of its number
        assert applied[thrust] == one.inputs[0, 0]


@pytest.mark.parametrize("shape", [0, (2, 0), MAX_DATA + 1, (-1,), (2, 300)])
def test_a_share_that_is_too_large(shape: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before anything starts, with the limit."""
    monkeypatch.setattr(Chain, "start", lambda _self, run: run.share(shape))
    with pytest.raises(ScenarioError, match=r"expected a shape of 1 to 512 numbers \(4096 bytes\)"):
        checked_controller(setup(SHORT, CHAIN).run)


def test_a_class_without_negotiate(monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot take part in several exchanges: refused before anything starts."""
    monkeypatch.delattr(Chain, "negotiate")
    with pytest.raises(ScenarioError, match="got no negotiate"):
        checked_controller(setup(SHORT, CHAIN, THREE).run)
    assert checked_controller(setup(SHORT, CHAIN).run).endswith(":Chain 1")


@pytest.mark.parametrize("shape", [np.int64(4), (np.int32(2), 2), np.array([2, 2]), [4]])
def test_numbers_of_numpy_are_a_shape(shape: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A length may be any integer, and a shape any sequence of them."""
    monkeypatch.setattr(Chain, "start", lambda _self, run: run.share(shape))
    assert plan_shapes(setup(SHORT, CHAIN).run)["with the inputs of one tick "].data == 4


def test_the_length_of_plans_is_told_with_the_declared_data() -> None:
    """Plans of a class have its data, with the inputs of one tick or of up to the horizon."""
    run = setup(SHORT, CHAIN)
    one_tick, horizon = plan_shapes(run.run).values()
    assert one_tick == PlanShape(inputs=1, data=math.prod(Chain.shape))
    assert horizon == PlanShape(inputs=run.settings.horizon, data=math.prod(Chain.shape))
    assert list(plan_shapes(setup(SHORT).run).values()) == [PlanShape.of(setup(SHORT).run)]


FAILURES = {
    "lambda inputs, data: inputs": "expected data of shape (2, 2), as declared by run.share, got none",
    "lambda inputs, data: (inputs, data[0])": (
        "expected data of shape (2, 2), as declared by run.share, got (2,)"
    ),
    "lambda inputs, data: (inputs, data * float('nan'))": (
        "expected finite inputs, data and numbers for the log, got data 0, counted row by row = nan"
    ),
    "lambda inputs, data: (inputs, data + 0j)": "expected arrays of real numbers, got tuple",
    "lambda inputs, data: (inputs, data, {}, 4)": "expected arrays of real numbers, got tuple",
}


@pytest.mark.parametrize("method", ["step", "negotiate"])
@pytest.mark.parametrize("returned", FAILURES)
def test_failures_are_named(returned: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is one line, counted once a tick, and the plan is the shifted previous one, without data."""
    give = eval(returned)  # noqa: S307  # a literal of this file
    result = Chain.result
    monkeypatch.setattr(Chain, method, lambda self, *_: give(*result(self)[:2]))
    iterations = (THREE,) if method == "negotiate" else ()
    messages = recorded(setup(SHORT, CHAIN, "agents.failed_share=1", *iterations))
    plans = [one for one in messages if isinstance(one, Plan) and one.negotiation == 0]
    assert {one.status for one in plans} == {"numerical"}
    assert not any(one.data.size for one in plans)
    problems = [one.problem for one in messages if isinstance(one, Note)]
    assert len(problems) == len(plans)
    expected = f"controller {Chain.__module__}:Chain: {method}: {FAILURES[returned]}"
    assert all(problem.startswith(expected) for problem in problems)


@pytest.mark.parametrize(
    "change",
    [
        "measurement.uav_states[0, 0] = 0.0",
        "measurement.payload[0] = 0.0",
        "messages[0].inputs[0, 0] = 0.0",
        "self.run.u_hover[0] = 0.0",
    ],
)
def test_changing_what_it_was_given(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments and parameters are shared with others: writing to them is a named failure."""

    def step(self: Chain, measurement: object, messages: Sequence[Plan]) -> object:
        if self.run.tick == 3:  # any at which messages of the others are here
            exec(change, {}, {"self": self, "measurement": measurement, "messages": messages})  # noqa: S102
        self.hear(messages)
        return self.result()

    monkeypatch.setattr(Chain, "step", step)
    messages = recorded(setup(SHORT, CHAIN))
    problems = {one.problem for one in messages if isinstance(one, Note) and one.problem}
    assert len(problems) == 1
    assert "step raised ValueError: assignment destination is read-only" in problems.pop()


@pytest.mark.parametrize("settings", [(), ("clock.actuation=next_tick",)])
def test_the_estimate_from_states(settings: tuple[str, ...]) -> None:
    """Over a perfect network it is the state of the plant."""
    run = setup(SHORT, ESTIMATING, *settings)
    messages = recorded(run)
    ground_truth = {state.tick: state.x for state in plant_states(messages)}
    n = run.system.n
    errors = [
        abs(value - ground_truth[tick][i])
        for i in range(n)
        for (_, tick), value in numbers(messages, f"x{i}").items()
    ]
    assert len(errors) == n * len(ALL) * run.ticks
    assert max(errors) < SAME_STATE


def test_the_estimate_from_sensors() -> None:
    """A class gets the sensors of its UAVs, shares them as the project does, and has the filter."""
    run = setup(SHORT, ESTIMATING, *VEHICLE)
    messages = recorded(run)
    plans = [message for message in messages if isinstance(message, Plan)]
    assert {one.uav_states.shape for one in plans} == {(1, REPORTS * REPORTED)}
    assert {one.status for one in plans} == {"solved"}
    ground_truth = {state.tick: state.x for state in plant_states(messages)}
    deviation = numbers(messages, "deviation")
    height = numbers(messages, f"x{HEIGHT}")
    assert len(deviation) == len(height) == len(ALL) * run.ticks
    for (agent, tick), deviation_m in deviation.items():
        error_m = abs(height[agent, tick] - ground_truth[tick][HEIGHT])
        assert 0.0 < deviation_m < LARGEST_DEVIATION_M
        assert error_m < DEVIATIONS * deviation_m
