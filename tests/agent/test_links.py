"""Links of an agent: plans are used at their arrival by the link, and are not waited for."""

import pytest

from protocol.scenario.setup import Setup
from protocol.wire.messages import LinkChange, StepReport
from tests.support.nodes import AgentNode
from tests.support.runs import measurement, plan, roster, setup

OTHERS = (2, 3, 4)
TICKS = 7


def reports(run: Setup) -> list[StepReport]:
    """Return agent 1's reports of a run in which every plan is physically here before the next measurement."""
    node = AgentNode(run, 1)
    sent = list(node.receive(roster(), 0))
    for k in range(TICKS):
        for agent in OTHERS if k else ():
            sent += node.receive(plan(run, agent, k - 1), 0)
        sent += node.receive(measurement(run, 1, k), 0)
    found = [message for message in sent if isinstance(message, StepReport)]
    assert [report.tick for report in found] == list(range(TICKS))  # without waiting
    return found


@pytest.mark.parametrize(
    ("delay_s", "age"), [(0.0, 1), (0.02, 1), (0.05, 1), (0.051, 2), (0.1, 2), (0.12, 3), (0.15, 3), (0.2, 4)]
)
def test_delay(delay_s: float, age: int) -> None:
    """A plan of tick k is used from the first tick after k on whose time is >= t_k + delay."""
    for report in reports(setup("controller.horizon=5", f"links.delay_s={delay_s}")):
        arrived = report.tick >= age
        assert report.plan_ages == report.state_ages == ((age if arrived else -1),) * 3
        assert report.delivered == 3 * arrived
        assert report.late == 3 * (arrived and age > 1)
        assert report.lost == 0


def test_loss_of_all() -> None:
    """Lost plans are reported at the tick they would have been used at, and change nothing else."""
    for report in reports(setup("controller.horizon=5", "links.loss=1")):
        assert report.plan_ages == report.state_ages == (-1,) * 3
        assert (report.delivered, report.late, report.lost) == (0, 0, 3 * (report.tick > 0))


def test_partition() -> None:
    """Plans sent across a partition while it lasts are lost, those before and after are not."""
    run = setup("controller.horizon=5", "links.partition=[{between=['agent4'],start_s=0.1,end_s=0.2}]")
    found = reports(run)
    assert [report.lost for report in found] == [0, 0, 0, 1, 1, 0, 0]  # plans of ticks 2 and 3
    assert [report.plan_ages[2] for report in found] == [-1, 1, 1, 2, 3, 1, 1]
    assert all(report.plan_ages[:2] == (1, 1) for report in found[1:])


def change(number: int, k: int, settings: str) -> LinkChange:
    """Return the coordinator's change of all links from a tick on."""
    return LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=100 + number,
        tick=k,
        number=number,
        source="",
        target="",
        settings=settings,
    )


def test_a_change_in_flight() -> None:
    """A change applies to messages sent from its tick on, not to those sent before."""
    run = setup("controller.horizon=5")
    node = AgentNode(run, 1)
    list(node.receive(roster(), 0))
    ages = []
    for k in range(TICKS):
        if k == 3:
            assert list(node.receive(change(1, 4, '{"delay_s": 0.1}'), 0)) == []
        sent = [m for agent in OTHERS if k for m in node.receive(plan(run, agent, k - 1), 0)]
        sent += node.receive(measurement(run, 1, k), 0)
        ages += [report.plan_ages[0] for report in sent if isinstance(report, StepReport)]
    assert ages == [-1, 1, 1, 1, 1, 2, 2]
    assert node.rejected.total == 0
