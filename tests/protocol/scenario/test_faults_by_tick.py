"""Scripted faults: the faults made from a scenario's events, and the message on which each happens."""

import pytest

from tests.support.runs import measurement, plan, plant_state, roster, setup, tick
from transport.protocol.scenario.faults.faults_by_tick import Fault, due
from transport.protocol.wire.messages import Message


def scripted(*events: str) -> list[tuple[int, str, str]]:
    """Faults of a scenario with some events, written "at_s do target"."""
    entries = [event.split() for event in events]
    listed = ",".join(
        f"{{at_s={at_s},do='{do}',target='{target}'}}" for at_s, do, target in entries
    )
    return [
        (fault.tick, fault.do, fault.target) for fault in setup(f"faults.event=[{listed}]").faults
    ]


@pytest.mark.parametrize(
    ("at_s", "k"), [("0", 0), ("0.05", 1), ("0.051", 2), ("0.1", 2), ("0.15", 3), ("7.35", 147)]
)
def test_at_the_first_tick_from_its_instant_on(at_s: str, k: int) -> None:
    """A fault happens at the first tick at or after its instant.

    A whole number of periods is not rounded up.
    """
    assert scripted(f"{at_s} kill agent1") == [(k, "kill", "agent1")]


def test_a_restart_is_a_kill_and_a_start() -> None:
    """A restart kills a running process and starts it a tick later; it starts one that is down."""
    assert scripted("0.5 restart agent2") == [(10, "kill", "agent2"), (11, "start", "agent2")]
    assert scripted("0.5 kill agent2", "1.0 restart agent2") == [
        (10, "kill", "agent2"),
        (20, "start", "agent2"),
    ]
    assert scripted("0.5 stop agent2", "1.0 restart agent2") == [
        (10, "stop", "agent2"),
        (20, "start", "agent2"),
    ]


def test_a_process_is_back_a_tick_later_at_the_earliest() -> None:
    """A process killed and restarted within one tick is back at the next."""
    assert scripted("0.5 stop agent2", "0.5 continue agent2") == [
        (10, "stop", "agent2"),
        (11, "continue", "agent2"),
    ]
    assert scripted("0.46 kill agent2", "0.49 restart agent2") == [
        (10, "kill", "agent2"),
        (11, "start", "agent2"),
    ]


FAULTS = (Fault(3, "kill", "agent1"), Fault(3, "stop", "plant"), Fault(4, "start", "agent1"))


@pytest.mark.parametrize(
    ("name", "message", "expected"),
    [
        ("agent1", measurement(setup(), 1, 3), "kill"),
        ("agent1", measurement(setup(), 1, 2), None),
        ("agent1", measurement(setup(), 1, 4), None),  # that it is back, its parent sees to
        ("agent2", measurement(setup(), 2, 3), None),
        ("plant", tick(3), "stop"),
        ("coordinator", tick(3), None),
        ("agent1", plan(setup(), 2, 3), None),
        ("agent1", roster(k=3), None),
        ("plant", plant_state(setup(), 3), None),
    ],
)
def test_on_the_message_that_opens_the_tick(
    name: str, message: Message, expected: str | None
) -> None:
    """A process is killed or stopped on the tick or the measurement that opens its tick, and on nothing else."""
    assert due(FAULTS, name, message) == expected
