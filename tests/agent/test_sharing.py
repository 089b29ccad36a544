"""Sharing of plans: the first, on change, at the heartbeat, under a new roster."""

import numpy as np
import pytest
from msgspec.structs import replace

from agent.sharing import Sharing
from protocol.scenario.schema import ControllerSection
from protocol.wire.messages import Message, Plan
from tests.support.nodes import AgentNode
from tests.support.runs import INCARNATION, measurement, plan, roster, setup

STEPS, RANGE = 4, 8.0
ON_CHANGE = (
    "controller.horizon=5",
    "controller.prediction=closed_loop",
    "controller.received_plans=by_age",
    "controller.share=on_change",
)
NEVER_BY_CHANGE = "controller.share_threshold=1e6"


def rule(threshold: float = 0.1, heartbeat_s: float = 1.0, share: str = "on_change") -> Sharing:
    """Return the rule of one UAV whose inputs all have the same range, at 20 Hz."""
    section = ControllerSection.model_validate(
        {"share": share, "share_threshold": threshold, "share_heartbeat_s": heartbeat_s}
    )
    return Sharing(section, np.full(4, -RANGE / 2.0), np.full(4, RANGE / 2.0))


def corrections(*thrusts: float) -> np.ndarray:
    """Return corrections of the first input by step; the others are zero."""
    c = np.zeros((STEPS, 4))
    c[: len(thrusts), 0] = thrusts
    return c


def test_expected_corrections_are_not_shared() -> None:
    """Equation (49): corrections equal to the shared ones, shifted to now and zero after their end, are not shared."""
    sharing = rule(threshold=0.0)
    assert sharing.decide(0, 0, corrections(1.0, 2.0, 3.0, 4.0), 1)
    assert not sharing.decide(1, 1, corrections(2.0, 3.0, 4.0), 1)
    assert not sharing.decide(3, 3, corrections(4.0), 1)
    assert not sharing.decide(9, 9, corrections(), 1)


def test_threshold() -> None:
    """A change is a share of the input's range, the largest over horizon and inputs; more is shared."""
    sharing = rule(threshold=0.25)
    assert sharing.decide(0, 0, corrections(), 1)
    assert sharing.change(1, corrections(0.0, 0.0, -2.0)) == 0.25
    assert not sharing.decide(1, 1, corrections(0.0, 0.0, -2.0), 1)
    assert sharing.decide(2, 2, corrections(0.0, 0.0, 0.0, -2.1), 1)


def test_small_changes_add_up() -> None:
    """The change counts from the last shared plan, not from the plan before, so that a drift is shared."""
    sharing = rule(threshold=0.1)
    # The input for tick 3 grows from plan to plan by a twentieth of the range.
    plans = [corrections(*[0.0] * (3 - k), 0.05 * RANGE * k) for k in range(4)]
    assert [sharing.decide(k, k, c, 1) for k, c in enumerate(plans)] == [True, False, False, True]


def test_each_input_has_its_own_range() -> None:
    """Changes are relative to each input's own range."""
    section = ControllerSection(share="on_change", share_threshold=0.1)
    sharing = Sharing(section, np.array([0.0, -1.0, -1.0, -0.5]), np.array([45.0, 1.0, 1.0, 0.5]))
    sharing.decide(0, 0, np.zeros((STEPS, 4)), 1)
    assert sharing.change(1, np.full((STEPS, 4), 0.5)) == 0.5


@pytest.mark.parametrize(("heartbeat_s", "ticks"), [(1.0, 20), (0.3, 6), (0.35, 7), (0.12, 2), (0.01, 1)])
def test_heartbeat(heartbeat_s: float, ticks: int) -> None:
    """Without any change a plan is shared at least that often, and not more often than the ticks allow."""
    sharing = rule(heartbeat_s=heartbeat_s)
    shared = [k for k in range(3 * ticks + 1) if sharing.decide(k, k, corrections(), 1)]
    assert shared == [0, ticks, 2 * ticks, 3 * ticks]


def test_a_new_roster() -> None:
    """The first plan under each roster is shared: control law or receivers may be new."""
    sharing = rule()
    shared = [sharing.decide(k, k, corrections(), version) for k, version in enumerate([1, 1, 2, 2, 4, 4])]
    assert shared == [True, False, True, False, True, False]


def test_ticks_that_were_skipped() -> None:
    """In real time steps are skipped: the shift is by ticks, and the heartbeat counts them."""
    sharing = rule(heartbeat_s=0.5)
    assert sharing.decide(0, 1, corrections(1.0, 2.0, 3.0, 4.0), 1)
    assert not sharing.decide(2, 3, corrections(3.0, 4.0), 1)
    assert sharing.decide(11, 12, corrections(), 1)


def answered(node: AgentNode, *events: Message) -> list[Plan]:
    """Return the plans of an agent after some messages."""
    return [message for event in events for message in node.receive(event, 0) if isinstance(message, Plan)]


def test_a_tick_waits_for_shared_plans_alone() -> None:
    """Tick k is answered when the shared plans of k - 1 are here; unshared ones are not waited for."""
    run = setup(*ON_CHANGE, NEVER_BY_CHANGE)
    node = AgentNode(run, 1)
    first = answered(node, roster(), measurement(run, 1, 0))
    assert [made.shared for made in first] == [True]
    assert answered(node, measurement(run, 1, 1, shared=(1, 3)), plan(run, 2, 0)) == []
    second = answered(node, plan(run, 3, 0))
    assert [(made.tick, made.shared) for made in second] == [(1, False)]
    third = answered(node, measurement(run, 1, 2, shared=()))
    assert [(made.tick, made.shared) for made in third] == [(2, False)]


def test_a_new_start_shares_its_first_plan() -> None:
    """An agent that returns to the roster shares its first plan, as any new process does."""
    run = setup(*ON_CHANGE, NEVER_BY_CHANGE)
    node = AgentNode(run, 1, INCARNATION)
    made = answered(node, roster(), measurement(run, 1, 0), measurement(run, 1, 1, shared=()))
    assert [m.shared for m in made] == [True, False]
    without = roster({2: 1, 3: 1, 4: 1}, k=1, version=2)
    back = roster({1: 2, 2: 1, 3: 1, 4: 1}, k=2, version=3)
    again = answered(node, without, back, measurement(run, 1, 2, shared=(), version=3))
    assert [(m.incarnation, m.shared) for m in again] == [(2, True)]


def test_proposals_are_always_shared() -> None:
    """Plans of a negotiation are always shared: the others wait for them."""
    run = setup("controller.horizon=5", "controller.negotiation_iterations=2")
    node = AgentNode(run, 1)
    made = answered(node, roster(), measurement(run, 1, 0))
    proposals = [replace(plan(run, agent, 0), negotiation=1) for agent in (2, 3, 4)]
    assert [(m.negotiation, m.shared) for m in [*made, *answered(node, *proposals)]] == [(1, True), (0, True)]
