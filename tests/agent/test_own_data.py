"""Own data, exchanges within a tick and estimates of a controller of the user."""

from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import logs
from tests.support.nodes import AgentNode
from tests.support.own_classes import Chain, Seldom
from tests.support.runs import (
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
from transport.agent.own import checked_controller
from transport.analysis.comparison import Comparison
from transport.analysis.replay import Replay
from transport.model.state import REPORTED, REPORTS
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import MAX_DATA, Message, Note, Plan

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

# Estimate against ground truth with measured states and a perfect network: the other agents' inputs
# are announced, and what is left is the error of two integration steps in place of five.
SAME_STATE = 1e-6
# The same with the sensors of a small autopilot after 1.4 s, in standard deviations that the filter
# claims for the height of the payload.
DEVIATIONS = 5.0


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
    assert len(set(numbers(once, "chain").values())) > 80
    assert str([reproducible(one) for one in once]) == str([reproducible(one) for one in again])
    assert plant_states(once)[-1].x.tobytes() == plant_states(again)[-1].x.tobytes()


@pytest.mark.parametrize("settings", [(*POOR_LINKS, *DEATHS), (THREE, *POOR_LINKS)])
def test_a_replay_has_the_same_data(settings: tuple[str, ...]) -> None:
    """An agent that gets the recorded messages again shares the same numbers, bit for bit."""
    run = setup(SHORT, CHAIN, *settings)
    log = logs.log_of(recorded(run))
    replay = Replay(run, log, 1)
    comparison = Comparison()
    for step in replay.steps():
        comparison.add(step)
    assert replay.notes == []
    assert not comparison.by_field
    assert comparison.plans == comparison.identical == 30 * (3 if THREE in settings else 1)


def test_bytes() -> None:
    """A plan grows by eight bytes a number and the head of the array; without data by nothing."""
    messages = recorded(setup(SHORT, CHAIN))
    one = next(message for message in messages if isinstance(message, Plan))
    bare = replace(one, data=np.zeros(0))
    head = 3 + 16  # extension type, and the lengths of the array
    longer_list = 2  # MessagePack: the header of a list of 16 fields
    assert len(encode(one)) == len(encode(bare)) + longer_list + head + 8 * 4
    built_in = next(message for message in recorded(setup(SHORT)) if isinstance(message, Plan))
    assert not built_in.data.size


def test_a_class_decides_what_it_sends() -> None:
    """Plans are sent when the class says so, and the first one under each roster."""
    messages = recorded(setup(SHORT, SELDOM, *DEATHS))
    plans = [message for message in messages if isinstance(message, Plan)]
    must = {key: bool(value) for key, value in numbers(messages, "must").items()}
    for one in plans:
        assert one.shared == (must[one.agent, one.tick] or one.tick % 5 == 0)
    assert {tick for (agent, tick), is_so in must.items() if is_so and agent == 1} >= {0}
    assert sum(is_so for (agent, _), is_so in must.items() if agent == 1) > 3
    heard = numbers(messages, "heard")
    assert heard[1, 1] == 3
    assert heard[1, 3] == 0
    assert Seldom.version == "1"


def test_data_of_another_shape_are_refused() -> None:
    """The plan is used without them, and a note names its sender; the step has not failed."""
    run = setup(SHORT, CHAIN)
    node = AgentNode(run, 1)
    node.receive(roster(), 0)
    node.receive(measurement(run, 1, 0, shared=()), 0)
    for agent in (2, 3, 4):
        data = np.arange(3.0) if agent == 3 else np.array([0.0, agent, 1.0, 0.0])
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
    plans = [message for message in messages if isinstance(message, Plan) and message.tick == 5]
    assert [one.negotiation for one in plans if one.agent == 2] == [2, 1, 0]
    applied = next(state for state in plant_states(messages) if state.tick == 5).u
    last = {one.agent: one for one in plans if one.negotiation == 0}
    for agent, one in last.items():
        assert applied[4 * (agent - 1)] == one.inputs[0, 0]


@pytest.mark.parametrize("shape", [0, (2, 0), MAX_DATA + 1, (-1,), (2, 300)])
def test_a_share_that_is_too_large(shape: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before anything starts, with the limit."""
    monkeypatch.setattr(Chain, "start", lambda _self, run: run.share(shape))
    with pytest.raises(ScenarioError, match=r"expected a shape of 1 to 512 numbers \(4096 bytes\)"):
        checked_controller(setup(SHORT, CHAIN))


def test_a_class_without_negotiate(monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot take part in several exchanges: refused before anything starts."""
    monkeypatch.delattr(Chain, "negotiate")
    with pytest.raises(ScenarioError, match="got no negotiate"):
        checked_controller(setup(SHORT, CHAIN, THREE))
    assert checked_controller(setup(SHORT, CHAIN)).endswith(":Chain 1")


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
        "self.run.lower[0] = -1e9",
    ],
)
def test_changing_what_it_was_given(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arguments and parameters are shared with others: writing to them is a named failure."""

    def step(self: Chain, measurement: object, messages: Sequence[Plan]) -> object:
        if self.run.tick == 3:
            exec(change, {}, {"self": self, "measurement": measurement, "messages": messages})  # noqa: S102
        return self.result()

    monkeypatch.setattr(Chain, "step", step)
    messages = recorded(setup(SHORT, CHAIN))
    problems = {one.problem for one in messages if isinstance(one, Note) and one.problem}
    assert len(problems) == 1
    assert "step raised ValueError: assignment destination is read-only" in problems.pop()


@pytest.mark.parametrize("settings", [(), ("clock.actuation=next_tick",)])
def test_the_estimate_from_states(settings: tuple[str, ...]) -> None:
    """Over a perfect network it is the state of the plant."""
    messages = recorded(setup(SHORT, ESTIMATING, *settings))
    truth = {state.tick: state.x for state in plant_states(messages)}
    errors = [
        abs(value - truth[tick][i])
        for i in range(60)
        for (_, tick), value in numbers(messages, f"x{i}").items()
    ]
    assert len(errors) == 60 * 4 * 30
    assert max(errors) < SAME_STATE


def test_the_estimate_from_sensors() -> None:
    """A class gets the sensors of its UAVs, shares them as the project does, and has the filter."""
    messages = recorded(setup(SHORT, ESTIMATING, *VEHICLE))
    plans = [message for message in messages if isinstance(message, Plan)]
    assert {one.uav_states.shape for one in plans} == {(1, REPORTS * REPORTED)}
    assert {one.status for one in plans} == {"solved"}
    truth = {state.tick: state.x for state in plant_states(messages)}
    deviation = numbers(messages, "deviation")
    height = numbers(messages, "x2")
    for agent in (1, 2, 3, 4):
        error = abs(height[agent, 28] - truth[28][2])
        assert 0.0 < deviation[agent, 28] < 0.1
        assert error < DEVIATIONS * deviation[agent, 28]
