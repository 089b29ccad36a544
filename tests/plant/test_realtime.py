"""The plant in real time.

A tick is measured and integrated at once, with the plans received by then.
"""

from collections.abc import Sequence

import numpy as np
import pytest

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, plan, roster, setup, tick
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Message, PlantState

S, MS = 10**9, 10**6  # ns
START_NS = 3 * S


def realtime(*settings: str, speed: float = 1.0) -> tuple[Setup, PlantNode]:
    """Return a run in real time and its plant with a roster."""
    run = setup("controller.horizon=5", "clock.mode=realtime", f"clock.speed={speed}", *settings)
    node = PlantNode(run)
    assert list(node.receive(roster(), START_NS)) == []
    return run, node


def flown(node: PlantNode, k: int, now_ns: int) -> PlantState:
    """Open tick k: all agents get a measurement, and the next interval is integrated."""
    *measured, plant_state = node.receive(tick(k), now_ns)
    assert [message.agent for message in measured if isinstance(message, Measurement)] == list(ALL)
    assert isinstance(plant_state, PlantState)
    assert plant_state.tick == k
    return plant_state


def tell(node: PlantNode, events: Sequence[Message], now_ns: int) -> None:
    """Pass plans to the plant, which does not answer them."""
    for event in events:
        assert list(node.receive(event, now_ns)) == []


def test_a_tick_is_flown_at_once() -> None:
    """Each tick is measured and integrated when it opens, without waiting for plans."""
    _, node = realtime()
    assert [flown(node, k, START_NS).plan_ticks for k in range(3)] == [(-1,) * 4] * 3


def test_late_plans() -> None:
    """A plan for tick k that comes after it opened acts from the next one on, with its step for that tick."""
    run, node = realtime()
    made = run.hover.u[:4] + np.arange(5.0)[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
    flown(node, 0, START_NS)
    tell(node, [plan(run, agent, 0, delay=1, inputs=made) for agent in (1, 2)], START_NS + 10 * MS)
    first = flown(node, 1, START_NS + 50 * MS)
    assert first.plan_ticks == (0, 0, -1, -1)
    tell(node, [plan(run, 3, 0, delay=1, inputs=made)], START_NS + 60 * MS)
    second = flown(node, 2, START_NS + 100 * MS)
    assert second.plan_ticks == (0, 0, 0, -1)
    assert second.u[0] == second.u[8] == run.hover.u[0] + 1.0


@pytest.mark.parametrize(("speed", "held_ms"), [(1.0, 120), (2.0, 60)])
def test_a_delayed_plan_is_held_back(speed: float, held_ms: int) -> None:
    """Over an actuation link with delay d a plan can act d / speed seconds after its arrival, not before."""
    run, node = realtime("links.actuation.delay_s=0.12", speed=speed)
    flown(node, 0, START_NS)
    arrived_ns = START_NS + 5 * MS
    tell(node, [plan(run, agent, 0, delay=1) for agent in ALL], arrived_ns)
    assert flown(node, 1, arrived_ns + held_ms * MS - 1).plan_ticks == (-1,) * 4
    assert flown(node, 2, arrived_ns + held_ms * MS).plan_ticks == (0,) * 4
