"""Steps of an agent's planner: what a proposal of another agent changes in its problem (47)."""

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from transport.agent.planning.mpc_planner import Planner
from transport.agent.received import Received
from transport.model.state import input_indices
from transport.protocol.wire.messages import Plan
from transport.protocol.wire.node_interface import Outbox

SETTINGS = (
    "controller.horizon=5",
    "controller.negotiation_iterations=3",
    "controller.prediction=closed_loop",
    "controller.terminal=riccati",
)
OPEN_LOOP = SETTINGS[:2]
NO_UAVS: frozenset[int] = frozenset()


@pytest.mark.parametrize("settings", [SETTINGS, OPEN_LOOP], ids=["closed loop", "open loop"])
def test_a_proposal_replaces_the_columns_of_its_agent(settings: tuple[str, ...]) -> None:
    """Inputs and corrections each where they cover the horizon; the own ones are those of the last solve."""
    run = runs.setup(*settings)
    planner = Planner(run.run, 1, lambda: 0)
    step = planner.begin(
        Received(
            measurement=runs.measurement(run, 1, 0),
            measurements=[runs.measurement(run, 1, 0)],
            plans=[],
            lost=0,
            measurements_lost=0,
            agents=frozenset(run.agents),
            off=NO_UAVS,
            released=NO_UAVS,
            failed_since=0,
            ticks_since_start=0,
            started_ns=0,
        )
    )
    (own,) = planner.plan(step, Outbox("agent1", 0), 0)
    assert isinstance(own, Plan)
    assert (step.negotiation, own.negotiation) == (2, 2)
    before = step.problem
    steps = len(before.U)

    def proposal(agent: int, rows: int, corrections: int) -> Plan:
        given = runs.plan(run, agent, 0, inputs=np.full((rows, 4), 10.0 + agent))
        return replace(given, corrections=np.full((corrections, 4), 0.1 * agent), negotiation=2)

    planner.adopt(
        step, [proposal(2, steps, steps), proposal(3, steps - 1, steps), proposal(4, steps, 0)]
    )
    columns = {agent: input_indices(run.owned[agent - 1]) for agent in run.agents}
    assert step.result is not None
    expected = before.U.copy()
    expected[:, columns[1]] = step.result.U
    expected[:, columns[2]] = 12.0
    expected[:, columns[4]] = 14.0
    np.testing.assert_array_equal(step.problem.U, expected)
    assert (before.U[:, columns[2]] != 12.0).all()

    if before.law is None:
        assert step.problem.law is None
        return
    assert step.problem.law is not None
    c = before.law.c.copy()
    c[:, columns[1]] = step.result.c
    c[:, columns[2]] = 0.2
    c[:, columns[3]] = 0.3 + 0.0
    np.testing.assert_allclose(step.problem.law.c, c)
    assert not before.law.c[:, columns[2]].any()
