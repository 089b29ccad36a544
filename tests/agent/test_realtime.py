"""An agent in real time.

It does not wait, uses the newest measurement, and applies delays by its own clock.
"""

from collections.abc import Sequence

import pytest

from tests.support.nodes import AgentNode
from tests.support.runs import measurement, plan, roster, setup
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Plan, StepReport

S, MS = 10**9, 10**6  # ns
START_NS = 3 * S  # a steady clock starts anywhere
REALTIME = ("controller.horizon=5", "clock.mode=realtime")


def realtime(*settings: str, speed: float = 1.0) -> tuple[Setup, AgentNode]:
    """Return a run in real time and its agent 1 with a roster."""
    run = setup(*REALTIME, f"clock.speed={speed}", *settings)
    node = AgentNode(run, 1)
    assert list(node.receive(roster(), START_NS)) == []
    return run, node


def tell(node: AgentNode, events: Sequence[Message], now_ns: int) -> None:
    """Pass events to the agent at one time; it answers only after all are taken in."""
    for event in events:
        assert list(node.receive(event, now_ns)) == []


def answer(node: AgentNode, now_ns: int) -> tuple[Plan, StepReport]:
    """Return the one plan and one report of an answer, which is due."""
    assert node.wake_ns == 0
    made, report = node.poll(now_ns)
    assert isinstance(made, Plan)
    assert isinstance(report, StepReport)
    assert list(node.poll(now_ns)) == []  # one answer, then nothing to do
    wake_ns: int | None = node.wake_ns
    assert wake_ns is None
    return made, report


def test_does_not_wait() -> None:
    """A measurement is answered although no other plan is here, for the next tick."""
    run, node = realtime()
    assert node.wake_ns is None
    tell(node, [measurement(run, 1, 0)], START_NS)
    made, report = answer(node, START_NS)
    assert (made.tick, made.start_tick) == (0, 1)
    tell(node, [measurement(run, 1, 1), plan(run, 2, 0, delay=1)], START_NS + 50 * MS)
    made, report = answer(node, START_NS + 50 * MS)
    assert (made.tick, made.start_tick) == (1, 2)
    assert (report.plan_ages, report.measurement_age) == ((1, -1, -1), 0)


def test_a_measurement_waits_for_its_roster() -> None:
    """The roster comes from another process, and may come later: without it all agents were off."""
    run = setup(*REALTIME, "clock.speed=1.0")
    node = AgentNode(run, 1)
    tell(node, [measurement(run, 1, 0)], START_NS)
    assert node.wake_ns is None
    assert list(node.poll(START_NS)) == []
    tell(node, [roster()], START_NS + MS)
    made, _ = answer(node, START_NS + MS)
    assert made.tick == 0


def test_others_may_be_ahead() -> None:
    """Plans of later ticks are kept until the agent reaches them."""
    run, node = realtime()
    ahead = [plan(run, 2, 7, delay=1), plan(run, 3, 5, delay=1), plan(run, 4, 3, delay=1)]
    tell(node, [measurement(run, 1, 4), *ahead], START_NS)
    ages = []
    for k in (4, 5, 6, 7, 8):
        tell(node, [measurement(run, 1, k)] if k > 4 else [], START_NS)
        _, report = answer(node, START_NS)
        ages.append((report.plan_ages, report.state_ages, report.delivered))
    assert ages == [
        ((-1, -1, 1), (-1, -1, 1), 1),
        ((-1, -1, 2), (-1, 0, 2), 1),  # the state at this very tick is known, the plan is for later
        ((-1, 1, 3), (-1, 1, 3), 0),
        ((-1, 2, 4), (0, 2, 4), 1),
        ((1, 3, 5), (1, 3, 5), 0),
    ]


@pytest.mark.parametrize(("speed", "held_ms"), [(1.0, 120), (2.0, 60), (0.5, 240)])
def test_a_delayed_plan_is_held_back(speed: float, held_ms: int) -> None:
    """A plan over a link with delay d is used d / speed seconds after its arrival, not before."""
    run, node = realtime("links.delay_s=0.12", speed=speed)
    arrived_ns = START_NS + 3 * MS
    tell(node, [measurement(run, 1, 0)], START_NS)
    answer(node, START_NS)
    tell(node, [plan(run, 2, 0, delay=1)], arrived_ns)
    # Measurements come as fast as the test likes; the clock decides and not their tick.
    for k, now_ns in enumerate((arrived_ns + 1, arrived_ns + held_ms * MS - 1), start=1):
        tell(node, [measurement(run, 1, k)], now_ns)
        _, report = answer(node, now_ns)
        assert (report.plan_ages, report.delivered) == ((-1, -1, -1), 0)
    tell(node, [measurement(run, 1, 3)], arrived_ns + held_ms * MS)
    _, report = answer(node, arrived_ns + held_ms * MS)
    assert (report.plan_ages, report.delivered, report.late) == ((3, -1, -1), 1, 1)


def test_a_delayed_measurement_is_held_back() -> None:
    """A measurement opens its tick at once; its content counts after the delay of its link."""
    run, node = realtime("links.measurement.delay_s=0.08")
    ages = []
    for k in range(5):
        now_ns = START_NS + 50 * MS * k
        tell(node, [measurement(run, 1, k)], now_ns)
        made, report = answer(node, now_ns)
        assert made.tick == k
        ages.append(report.measurement_age)
    assert ages == [-1, -1, 2, 2, 2]


def test_an_agent_off_the_roster_begins_anew() -> None:
    """A live agent taken off the roster starts anew with a higher incarnation."""
    run, node = realtime("clock.on_agent_loss=continue")
    node = AgentNode(run, 1, incarnation=1)
    tell(node, [roster(), measurement(run, 1, 0)], START_NS)
    answer(node, START_NS)
    tell(
        node,
        [measurement(run, 1, 1), roster({2: 1, 3: 1, 4: 1}, k=1, version=2)],
        START_NS + 50 * MS,
    )
    assert node.incarnation == 2
    assert list(node.poll(START_NS + 50 * MS)) == []  # it is off the roster
    tell(node, [roster({1: 2, 2: 1, 3: 1, 4: 1}, k=2, version=3)], START_NS + 100 * MS)
    tell(node, [measurement(run, 1, 2, version=3)], START_NS + 100 * MS)
    made, report = answer(node, START_NS + 100 * MS)
    assert (made.tick, made.incarnation, made.sequence) == (2, 2, 0)
    assert report.plan_ages == (-1, -1, -1)
