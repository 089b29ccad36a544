"""What an agent's node gives its planner, and when: by a planner that only notes it."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.nodes import AgentNode
from tests.support.runs import ALL, end, measurement, plan, roster, setup
from transport.agent import node as agent_node
from transport.agent.planning.followed_path import FollowedPath
from transport.agent.received import Received
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Airtime, Message, Plan
from transport.protocol.wire.outbox import Outbox

RUN = setup()
NOW_NS = 77
OTHERS = (2, 3, 4)
PROPOSALS = (4, 3, 2)  # in the order in which they come

# Inputs of a plan whose thrust grows from step to step, N.
GROWS_N = 0.1
RAMP = np.tile(RUN.hover.u[:4], (20, 1))
RAMP[:, 0] += GROWS_N * np.arange(20)


class Noting:
    """A planner that notes its calls, with some iterations of negotiation."""

    share_alone = 0.0

    def __init__(self, iterations: int) -> None:
        self.setup: Any = None
        self.iterations = iterations
        self.begun: list[Received] = []
        self.adopted: list[list[Plan]] = []
        self.others: list[Any] = []

    def begin(self, received: Received) -> SimpleNamespace:
        """Note what is received."""
        self.begun.append(received)
        return SimpleNamespace(received=received, negotiation=self.iterations)

    def plan(self, step: Any, _out: Outbox, _publish_ns: int) -> list[Message]:
        """Return a plan or a proposal."""
        step.negotiation -= 1
        return [replace(plan(RUN, 1, step.received.tick), negotiation=step.negotiation)]

    def adopt(self, _step: Any, proposals: Sequence[Plan]) -> None:
        """Note proposals."""
        self.adopted.append(list(proposals))

    def restart(self) -> None:
        """Note it."""
        self.others.append("restart")

    def end(self, tick: int, _out: Outbox) -> list[Message]:
        """Return a last message."""
        self.others.append(("end", tick))
        return [end(tick)]


def noting(
    monkeypatch: pytest.MonkeyPatch, run: Setup = RUN, incarnation: int = 1
) -> tuple[AgentNode, Noting]:
    """Return agent 1, which is on no roster yet, and its planner."""
    planner = Noting(run.settings.negotiation_iterations)

    def made(seen: Any, *_: Any) -> Noting:
        planner.setup = seen
        return planner

    monkeypatch.setattr(agent_node, "planner_of", made)
    return AgentNode(run, 1, incarnation, lambda: NOW_NS), planner


def tell(node: AgentNode, *events: Message) -> list[Message]:
    """Pass events to the agent and return all its messages."""
    return [message for event in events for message in node.receive(event, 0)]


def plans(k: int, agents: Sequence[int] = OTHERS) -> list[Plan]:
    """Return plans of the others."""
    return [plan(RUN, agent, k) for agent in agents]


def proposals(k: int) -> list[Plan]:
    """Return proposals of the others, the last before the plan."""
    return [replace(one, negotiation=1) for one in plans(k, PROPOSALS)]


def agents_of(given: Sequence[Plan]) -> list[int]:
    """Return the senders of plans."""
    return [one.agent for one in given]


def test_failures_and_ticks_count_from_the_roster(monkeypatch: pytest.MonkeyPatch) -> None:
    """UAVs are numbered from 0; a roster ahead of the tick does not count, nor do plans before it took part."""
    node, planner = noting(monkeypatch, incarnation=2)
    failed = replace(roster({1: 2, 2: 1, 3: 1, 4: 1}, k=5, version=3), off=(2, 4), released=(4,))
    ahead = replace(roster({1: 2, 2: 1, 3: 1}, k=6, version=4), off=(2, 4), released=(4,))
    tell(node, failed, *plans(4), ahead, measurement(RUN, 1, 5, version=3))
    tell(node, *plans(5), measurement(RUN, 1, 6, version=4))
    first, second = planner.begun
    assert (set(first.off), set(first.released)) == ({1, 3}, {3})
    assert (first.failed_since, first.ticks_since_start, first.started_ns) == (5, 0, NOW_NS)
    assert (first.agents, second.agents) == ({1, 2, 3, 4}, {1, 2, 3})
    assert (second.failed_since, second.ticks_since_start) == (5, 1)
    assert [agents_of(one.plans) for one in planner.begun] == [[], [2, 3, 4]]
    assert tell(node, end(6)) == [end(6)]
    assert planner.others == [("end", 6)]


@pytest.mark.parametrize(
    ("shared", "departed", "awaited"),
    [((1, 2, 3, 4), (), (2, 3, 4)), ((1, 3), (), (3,)), ((1, 2, 3, 4), (2,), (3, 4)), ((), (), ())],
)
def test_a_tick_waits_for_the_shared_plans_of_the_tick_before(
    shared: tuple[int, ...],
    departed: tuple[int, ...],
    awaited: tuple[int, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of all others that took part in it, in lockstep without an alarm; those of its own tick may be here before."""
    node, planner = noting(monkeypatch)
    tell(node, roster(), measurement(RUN, 1, 0))
    left = {agent: 1 for agent in ALL if agent not in departed}
    tell(node, roster(left, k=0, version=2), measurement(RUN, 1, 1, shared=shared, version=2))
    for agent in awaited:
        assert len(planner.begun) == 1
        assert node.wake_ns is None
        tell(node, *plans(0, (agent,)))
    assert [one.tick for one in planner.begun] == [0, 1]

    others = [agent for agent in OTHERS if agent in left]
    early = [*plans(1, others), *plans(2, others)]
    assert tell(node, *early) == []
    tell(node, measurement(RUN, 1, 2, version=2), measurement(RUN, 1, 3, version=2))
    assert [one.tick for one in planner.begun] == [0, 1, 2, 3]


def test_lost_messages_are_counted_by_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans of two agents are lost on their links, and no measurement; and the other way round."""
    two = (
        "links.override=[{from='agent2',to='agent1',loss=1.0},{from='agent3',to='agent1',loss=1.0}]"
    )
    for settings, lost in [(two, (2, 0)), ("links.measurement.loss=1.0", (0, 1))]:
        run = setup(settings)
        node, planner = noting(monkeypatch, run)
        tell(node, roster(), measurement(run, 1, 0), *plans(0), measurement(run, 1, 1))
        assert (planner.begun[1].lost, planner.begun[1].measurements_lost) == lost


def test_one_that_was_off_the_roster_starts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planner and path do, under a higher incarnation; before any tick the run ends at tick 0."""
    node, planner = noting(monkeypatch)
    monkeypatch.setattr(
        FollowedPath, "return_to_roster", lambda _self, tick: planner.others.append(("path", tick))
    )
    tell(node, roster(), roster({2: 1, 3: 1, 4: 1}, k=7, version=2))
    assert (node.incarnation, planner.others) == (2, ["restart", ("path", 7)])
    assert tell(node, end()) == [end()]
    assert planner.others[2:] == [("end", 0)]


TWO = setup("controller.negotiation_iterations=2")


@pytest.mark.parametrize(
    ("delays_s", "passes"),
    [([], False), ([0.1], False), ([0.0], True), ([0.1, 0.0], True), ([0.0, 0.1], True)],
)
def test_a_proposal_counts_if_a_copy_of_it_has_no_delay(
    delays_s: list[float], passes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the others are taken once all are here, by agent; meanwhile no other tick begins."""
    node, planner = noting(monkeypatch, TWO)
    of_plans = {0: [0.0] if not passes else []}  # of the tick's plan, which is another message
    link = SimpleNamespace(delays=lambda _tick, left=0: of_plans.get(left, delays_s))
    monkeypatch.setitem(node._plans.links, "agent3", link)
    tell(node, roster(), measurement(TWO, 1, 0))
    tell(node, measurement(TWO, 1, 1, shared=()), *proposals(0)[:-1])
    assert (len(planner.begun), planner.adopted) == (1, [])
    made = tell(node, *proposals(0)[-1:])
    assert [agents_of(given) for given in planner.adopted] == [[2, 3, 4] if passes else [2, 4]]
    assert isinstance(made[0], Plan)
    assert made[0].negotiation == 0


def test_proposals_may_be_here_before_the_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of agents that were faster are kept for it."""
    node, planner = noting(monkeypatch, TWO)
    tell(node, roster(), *proposals(0), measurement(TWO, 1, 0))
    assert [agents_of(given) for given in planner.adopted] == [[2, 3, 4]]


def test_plans_and_proposals_are_seen_by_the_own_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """What agent 2 says is of another instant by the clock of agent 1, and so is the reference."""
    run = setup("clock.offsets_s=[0.01,0.0,0.01,0.01]", "controller.negotiation_iterations=2")
    node, planner = noting(monkeypatch, run)
    assert planner.setup.X_ref is not run.X_ref
    by_2 = plan(run, 2, 0, inputs=RAMP)
    tell(node, roster(), measurement(run, 1, 0))
    tell(node, *[replace(one, negotiation=1) for one in (by_2, *plans(0, (3, 4)))])
    tell(node, by_2, *plans(0, (3, 4)), measurement(run, 1, 1))
    for seen in (planner.adopted[0], planner.begun[1].plans):
        # Its clock is a fifth of a period behind: of each period the last fifth is of the next one.
        np.testing.assert_allclose(seen[0].inputs[:3, 0], RAMP[:3, 0] + 0.2 * GROWS_N)
        assert seen[1].inputs[0, 0] == plans(0)[1].inputs[0, 0]


def air(k: int, left: int, arrivals_s: dict[int, float]) -> Airtime:
    """Return a report of the radio on messages of tick 0, which all agents have got at the same time."""
    agents = tuple(arrivals_s)
    return Airtime(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=k,
        negotiation=left,
        agents=agents,
        plan_ticks=(0,) * len(agents),
        exchanges=(left,) * len(agents),
        receivers=ALL,
        sent=np.zeros(len(agents)),
        arrivals=np.tile(np.array(list(arrivals_s.values()))[:, None], len(ALL)),
        busy_s=0.0,
        transmissions=0,
        repetitions=0,
    )


def test_on_a_radio_the_report_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Proposals that came through the air count once it is here; a tick waits for that of the plans before."""
    run = setup(
        "radio={inputs='first'}",
        "controller.prediction=closed_loop",
        "controller.received_plans=by_age",
        "controller.negotiation_iterations=2",
    )
    node, planner = noting(monkeypatch, run)
    tell(node, roster(), measurement(run, 1, 0), *proposals(0))
    assert planner.adopted == []
    tell(node, air(0, 1, {2: 0.01, 3: -1.0, 4: 0.02}))
    assert [agents_of(given) for given in planner.adopted] == [[2, 4]]
    tell(node, plan(run, 2, 0, inputs=RAMP), *plans(0, (3, 4)), measurement(run, 1, 1))
    assert len(planner.begun) == 1
    tell(node, air(1, 0, {2: 0.01, 3: -1.0, 4: 0.02}))
    assert [agents_of(one.plans) for one in planner.begun] == [[], [2, 4]]
    np.testing.assert_array_equal(planner.begun[1].plans[0].inputs, np.tile(RAMP[0], (20, 1)))
