"""The coordinator's table of transitions: state and event in, messages, state and outcome out."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from tests.support.coordinator_clock import (
    CONTINUE,
    MS,
    START_NS,
    TIMEOUT_S,
    answers,
    at_last_tick,
    coordinator,
    gone,
    kinds,
    ready,
    started,
    tell,
)
from tests.support.nodes import CoordinatorNode
from tests.support.runs import plant_state, setup, ticks
from transport.protocol.wire.messages import Message, Presence

AGENTS = [f"agent{agent}" for agent in (1, 2, 3, 4)]
TOO_LATE_NS = START_NS + round(TIMEOUT_S * 1e9)
DEADLINE_NS = START_NS + 50 * MS
KILLED = (
    "faults.event=[{at_s=0.05,do='kill',target='agent2'},{at_s=0.1,do='restart',target='agent2'}]"
)
REALTIME = ("clock.mode=realtime", "clock.speed=1", "clock.on_overrun=abort")
REASON = "UAV1 roll of 90 deg"


def waiting(*settings: str) -> CoordinatorNode:
    """All processes but agent 4 are ready."""
    node = coordinator(*settings)
    tell(node, [ready(name) for name in ("plant", *AGENTS[:3])])
    return node


def opened(*settings: str) -> CoordinatorNode:
    """Tick 0 is open, agents 1 to 3 have answered."""
    node = started(coordinator(*settings))
    assert tell(node, answers(0, (1, 2, 3))) == []
    return node


def opened_in_real_time(*settings: str) -> CoordinatorNode:
    """Tick 0 is open, no agent has answered, the plant has."""
    node = started(coordinator(*REALTIME, *settings))
    assert tell(node, [plant_state(setup(), 0)]) == []
    return node


def diverged_in_real_time(*settings: str) -> CoordinatorNode:
    """Tick 0 is open, no agent has answered, and the plant has diverged."""
    node = started(coordinator(*REALTIME, *settings))
    assert tell(node, [plant_state(setup(), 0, REASON)]) == []
    return node


def before_held(*settings: str) -> CoordinatorNode:
    """Tick 1 is answered by all but agent 4; agent 2 was killed and is to return at tick 2."""
    node = started(coordinator(CONTINUE, KILLED, *settings))
    tell(node, [*answers(0), gone("agent2"), *answers(1, (1, 3))])
    return node


def held(*settings: str) -> CoordinatorNode:
    """Tick 1 is answered; tick 2 waits for agent 2."""
    node = before_held(*settings)
    assert tell(node, answers(1, (4,))) == []
    return node


def at_the_end(*settings: str) -> CoordinatorNode:
    """The last tick is open and answered by all, the plant's state is outstanding."""
    node = at_last_tick(coordinator(*settings))
    assert tell(node, answers(2)) == []
    return node


def recorded(*settings: str) -> CoordinatorNode:
    """The last tick is open, its plant state is here, agent 4's answer is outstanding."""
    node = at_last_tick(coordinator(*settings))
    assert tell(node, [*answers(2, (1, 2, 3)), plant_state(setup(), 2)]) == []
    return node


def over(*settings: str) -> CoordinatorNode:
    """The run was interrupted."""
    node = opened(*settings)
    node.interrupt("Ctrl-C")
    return node


def tilted(*settings: str) -> CoordinatorNode:
    """Tick 0 is open and the plant has diverged.

    The tick is still answered and the next one opened.
    """
    node = opened(*settings)
    tell(node, [plant_state(setup(), 0, REASON)])
    return node


@dataclass(frozen=True, kw_only=True)
class Case:
    """One line of the table: in this state, after this event, these messages and outcome."""

    state: Callable[..., CoordinatorNode]
    event: Message | Presence | str
    sent: list[str] = field(default_factory=list)
    outcome: tuple[str, int] | None = None
    reason: str = ""
    settings: tuple[str, ...] = ()


ABORTED, DIVERGED, COMPLETED, INTERRUPTED = (
    ("aborted", 4),
    ("diverged", 6),
    ("completed", 0),
    ("aborted", 130),
)
OVERRUN = ("aborted", 5)
LOST, TILTED = plant_state(setup(), 0, REASON), f"{REASON} at t = 0.00 s"
LATE = "agent4 did not answer tick 0 in time at t = 0.00 s"

TABLE = [
    Case(state=waiting, event=ready("agent4"), sent=["roster 0", "tick 0"]),
    Case(state=waiting, event=plant_state(setup(), 0)),
    Case(state=waiting, event="a day passes"),
    Case(
        state=waiting,
        event=gone("agent3"),
        sent=["control 0"],
        outcome=ABORTED,
        reason="agent3 is gone at t = 0.00 s",
    ),
    Case(
        state=waiting,
        event=gone("agent3"),
        sent=["control 0"],
        outcome=ABORTED,
        settings=(CONTINUE,),
    ),
    Case(
        state=waiting,
        event=gone("plant"),
        sent=["control 0"],
        outcome=ABORTED,
        reason="plant is gone",
    ),
    Case(
        state=waiting, event="interrupt", sent=["control 0"], outcome=INTERRUPTED, reason="Ctrl-C"
    ),
    #
    Case(state=opened, event=answers(0)[3], sent=["tick 1"]),
    Case(state=opened, event=answers(0)[0]),
    Case(state=opened, event=plant_state(setup(), 0)),
    Case(state=opened, event="time passes"),
    Case(state=opened, event="timeout", sent=["control 0"], outcome=ABORTED, reason=LATE),
    Case(state=opened, event="timeout", sent=["roster 0", "tick 1"], settings=(CONTINUE,)),
    Case(
        state=opened,
        event=gone("agent4"),
        sent=["control 0"],
        outcome=ABORTED,
        reason="agent4 is gone at t = 0.00 s",
    ),
    Case(state=opened, event=gone("agent4"), sent=["roster 0", "tick 1"], settings=(CONTINUE,)),
    Case(state=opened, event=gone("agent1"), sent=["roster 0"], settings=(CONTINUE,)),
    Case(state=opened, event=gone("agent4", 0)),
    Case(
        state=opened,
        event=gone("plant"),
        sent=["control 0"],
        outcome=ABORTED,
        reason="plant is gone",
    ),
    Case(
        state=opened, event=gone("plant"), sent=["control 0"], outcome=ABORTED, settings=(CONTINUE,)
    ),
    Case(state=opened, event=LOST),
    Case(
        state=tilted,
        event=answers(0)[3],
        sent=["tick 1", "control 1"],
        outcome=DIVERGED,
        reason=TILTED,
    ),
    Case(state=tilted, event="timeout", sent=["control 0"], outcome=DIVERGED, reason=TILTED),
    Case(state=opened, event="interrupt", sent=["control 0"], outcome=INTERRUPTED, reason="Ctrl-C"),
    #
    Case(state=at_the_end, event=plant_state(setup(), 2), sent=["control 2"], outcome=COMPLETED),
    Case(
        state=at_the_end,
        event=plant_state(setup(), 2, "no rods"),
        sent=["control 2"],
        outcome=DIVERGED,
        reason="no rods at t = 0.10 s",
    ),
    Case(state=at_the_end, event=plant_state(setup(), 1)),
    Case(
        state=at_the_end,
        event="timeout",
        sent=["control 2"],
        outcome=ABORTED,
        reason="plant did not answer tick 2 in time",
    ),
    Case(state=recorded, event=answers(2)[3], sent=["control 2"], outcome=COMPLETED),
    Case(
        state=recorded,
        event=gone("agent4"),
        sent=["roster 2", "control 2"],
        outcome=COMPLETED,
        settings=(CONTINUE,),
    ),
    Case(
        state=recorded,
        event="timeout",
        sent=["roster 2", "control 2"],
        outcome=COMPLETED,
        settings=(CONTINUE,),
    ),
    Case(state=recorded, event="interrupt", sent=["control 2"], outcome=INTERRUPTED),
    #
    Case(state=waiting, event=ready("agent4"), sent=["roster 0", "tick 0"], settings=(ticks(1),)),
    Case(state=opened, event=answers(0)[3], sent=["tick 1"], settings=(ticks(2),)),
    Case(state=opened_in_real_time, event="deadline", sent=["control 0"], outcome=OVERRUN),
    Case(
        state=opened_in_real_time,
        event="deadline",
        sent=["control 0"],
        outcome=OVERRUN,
        settings=(ticks(1),),
    ),
    Case(state=diverged_in_real_time, event="deadline", sent=["control 0"], outcome=OVERRUN),
    Case(
        state=tilted,
        event=answers(0)[3],
        sent=["tick 1", "control 1"],
        outcome=DIVERGED,
        settings=(ticks(2),),
    ),
    Case(state=tilted, event=gone("plant"), sent=["control 0"], outcome=ABORTED),
    Case(state=tilted, event="interrupt", sent=["control 0"], outcome=INTERRUPTED),
    #
    Case(state=before_held, event=answers(1, (4,))[0]),
    Case(state=held, event=ready("agent2", 2), sent=["roster 2", "tick 2"]),
    Case(state=held, event=ready("agent2", 2), sent=["roster 2", "tick 2"], settings=(ticks(4),)),
    Case(state=held, event=gone("agent4"), sent=["roster 1"]),
    Case(
        state=held, event=gone("plant"), sent=["control 1"], outcome=ABORTED, reason="plant is gone"
    ),
    Case(state=held, event="interrupt", sent=["control 1"], outcome=INTERRUPTED),
    Case(
        state=held,
        event=plant_state(setup(), 1, REASON),
        sent=["tick 2", "control 2"],
        outcome=DIVERGED,
    ),
    #
    *[
        Case(state=over, event=event, outcome=INTERRUPTED, reason="Ctrl-C")
        for event in (answers(0)[3], ready("agent4"), gone("plant"), "a day passes")
    ],
]


def happen(node: CoordinatorNode, event: Message | Presence | str) -> list[Message]:
    """Let an event of the table happen."""
    match event:
        case "deadline":
            return list(node.poll(DEADLINE_NS))
        case "time passes":
            return list(node.poll(TOO_LATE_NS - 1))
        case "timeout":
            return list(node.poll(TOO_LATE_NS))
        case "a day passes":
            return list(node.poll(START_NS + 86_400 * 10**9))
        case "interrupt":
            return list(node.interrupt("Ctrl-C"))
        case str():
            raise ValueError(event)
    return tell(node, [event])


@pytest.mark.parametrize(
    "case", TABLE, ids=lambda case: f"{case.state.__name__}-{str(case.event)[:45]}"
)
def test_transition(case: Case) -> None:
    """In each state each event causes the messages of the table, and the outcome is the table's."""
    node = case.state(*case.settings)
    assert kinds(happen(node, case.event)) == case.sent
    if case.outcome is None:
        assert node.finished is None
        return
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == case.outcome
    assert case.reason in node.finished.reason
