"""The agent as a state machine: waiting, answers, refusals."""

import numpy as np
import pytest

from tests.support.nodes import AgentNode, refused
from tests.support.runs import end, integrated, measurement, plan, roster, setup
from transport.model import state
from transport.model.arrays import Array
from transport.mpc.controller import Controller, Horizon
from transport.mpc.program.prediction import Linear
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Plan, Presence, StepReport

SHORT_HORIZON = "controller.horizon=5"  # a step of a millisecond: these tests are about messages
OTHERS = (2, 3, 4)
# Of thrusts and moments, N and N m: the agent's integration steps are its own, 1e-12 apart from those here.
ESTIMATE_TOLERANCE = 1e-8


@pytest.fixture
def run() -> Setup:
    """Return the paper's four agents with a short horizon."""
    return setup(SHORT_HORIZON)


@pytest.fixture
def node(run: Setup) -> AgentNode:
    """Return agent 1 with a roster."""
    node = AgentNode(run, 1)
    assert tell(node, roster()) == []
    return node


def tell(node: AgentNode, *events: Message | Presence) -> list[Message]:
    """Pass events to the agent and return all its messages."""
    return [message for event in events for message in node.receive(event, 0)]


def answer(messages: list[Message]) -> tuple[Plan, StepReport]:
    """Return the one plan and one report of an answer."""
    made, report = messages
    assert isinstance(made, Plan)
    assert isinstance(report, StepReport)
    return made, report


def step(run: Setup, node: AgentNode, k: int) -> tuple[Plan, StepReport]:
    """Run a regular tick: the others' plans of the tick before, then the measurement."""
    plans = [plan(run, agent, k - 1) for agent in OTHERS] if k else []
    assert tell(node, *plans) == []
    return answer(tell(node, measurement(run, 1, k)))


def test_answers_a_measurement(run: Setup, node: AgentNode) -> None:
    """One measurement is answered by one plan and one report."""
    made, report = answer(tell(node, measurement(run, 1, 0)))
    assert (made.sender, made.agent, made.tick, made.start_tick, made.uavs) == (
        "agent1",
        1,
        0,
        0,
        (1,),
    )
    assert (made.sequence, report.sequence) == (0, 1)
    assert made.inputs.shape == (5, 4)
    assert made.status == report.status == "solved"
    np.testing.assert_array_equal(made.uav_states, run.initial_state()[None, state.uav_slice(0)])


def test_report(run: Setup, node: AgentNode) -> None:
    """The report has the ages of plans and states, and counts plans and delayed plans."""
    _, first = step(run, node, 0)
    assert first.plan_ages == first.state_ages == (-1, -1, -1)
    assert (first.delivered, first.late) == (0, 0)
    _, second = step(run, node, 1)
    assert second.plan_ages == second.state_ages == (1, 1, 1)
    assert (second.delivered, second.late) == (3, 0)
    tell(node, plan(run, 2, 1), plan(run, 3, 1))
    _, third = answer(tell(node, measurement(run, 1, 2, answered=(1, 2, 3))))
    assert third.plan_ages == third.state_ages == (1, 1, 2)
    assert (third.delivered, third.late) == (2, 0)
    tell(node, plan(run, 4, 1), *[plan(run, agent, 2) for agent in OTHERS])
    _, fourth = answer(tell(node, measurement(run, 1, 3)))
    assert fourth.plan_ages == (1, 1, 1)
    assert (fourth.delivered, fourth.late) == (4, 1)
    assert fourth.solver == "active_set"
    assert 0.0 <= fourth.residual < 1e-6  # passed the solver's residual check


def test_one_that_joins_waits_for_plans_from_its_first_tick_on(run: Setup) -> None:
    """Plans of the tick before are not for it; a measurement that its start has no part in is refused."""
    node = AgentNode(run, 1, incarnation=2)
    tell(node, roster({2: 1, 3: 1, 4: 1}, k=4, version=2))
    assert tell(node, measurement(run, 1, 4, version=2)) == []
    assert [reason for _, reason, _ in refused(node)] == ["past"]
    assert tell(node, measurement(run, 1, 5, version=3)) == []
    answer(tell(node, roster({1: 2, 2: 1, 3: 1, 4: 1}, k=5, version=3)))

    assert tell(node, measurement(run, 1, 6, version=3)) == []
    assert tell(node, *[plan(run, agent, 5, incarnation=1) for agent in OTHERS[:-1]]) == []
    made, _ = answer(tell(node, plan(run, OTHERS[-1], 5, incarnation=1)))
    assert made.tick == 6
    assert len(refused(node)) == 1


def test_plan_is_the_controllers(run: Setup, node: AgentNode) -> None:
    """The plan is the controller's at the estimate, inputs in force, and announced plans."""
    first, _ = step(run, node, 0)
    shove: Array = np.tile(run.hover.u[:4], (5, 1)) + np.array([2.0, 0.01, 0.0, 0.0])
    made, _ = answer(
        tell(
            node,
            plan(run, 2, 0, inputs=shove),
            plan(run, 3, 0),
            plan(run, 4, 0),
            measurement(run, 1, 1),
        )
    )
    # Payload and UAV 1 are measured to be where they started. The others are predicted: UAV 2 by what
    # it announced.
    u0 = run.hover.u.copy()
    u0[4:8] = shove[0]
    x, _ = run.model.integrate(
        run.initial_state(), np.concatenate([first.inputs[0], u0[4:]]), 0.05, 2
    )
    for measured in (slice(0, state.PAYLOAD), state.uav_slice(0)):
        x[measured] = run.initial_state()[measured]
    U = np.tile(run.hover.u, (5, 1))
    U[:, :4] = np.vstack([first.inputs[1:], first.inputs[-1:]])
    U[:, 4:8] = shove
    y_ref = run.reference.outputs(0.05 * np.arange(1.0, 7.0))
    one = Controller(run.model, run.hover, run.settings, (0,))
    expected = one.step(x, u0, Horizon(U=U, y_ref=y_ref))
    np.testing.assert_allclose(made.inputs, expected.U, rtol=0.0, atol=ESTIMATE_TOLERANCE)


@pytest.mark.parametrize("received", ["predicted", "as_received"])
def test_states_as_received(received: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others' states are predicted from their tick to the present one, or used as received."""
    run, seen = setup("controller.horizon=5", f"controller.received_states={received}"), []
    linearise = Controller.linearise

    def watched(controller: Controller, x0: Array, *rest: Array) -> Linear:
        seen.append(x0)
        return linearise(controller, x0, *rest)

    monkeypatch.setattr(Controller, "linearise", watched)
    node = AgentNode(run, 1)
    assert tell(node, roster()) == []
    x = run.initial_state()
    moving = integrated(run, x, 0.9 * run.hover.u + 0.1)
    tell(node, measurement(run, 1, 0))
    tell(node, plan(run, 2, 0, x=moving), plan(run, 3, 0), plan(run, 4, 0), measurement(run, 1, 1))
    at_0 = x.copy()
    at_0[state.uav_slice(1)] = moving[state.uav_slice(1)]
    expected = at_0 if received == "as_received" else integrated(run, at_0, run.hover.u)
    for block in (slice(0, state.PAYLOAD), state.uav_slice(0)):
        expected[block] = x[block]  # as measured
    np.testing.assert_allclose(seen[-1], expected, rtol=0.0, atol=1e-7)


def test_end_of_the_run(run: Setup, node: AgentNode) -> None:
    """The coordinator's control message ends the run for an agent."""
    assert tell(node, end()) == []
    assert node.finished == end()


@pytest.mark.parametrize("steps", [0, 2])
def test_coordinator_is_gone(run: Setup, node: AgentNode, steps: int) -> None:
    """Without a coordinator the run is aborted with exit code 4, at any tick."""
    for k in range(steps):
        step(run, node, k)
    assert tell(node, Presence("coordinator", 0, alive=False)) == []
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == ("aborted", 4)
    assert node.finished.reason == "coordinator is gone"
    assert node.finished.tick == max(steps - 1, 0)
