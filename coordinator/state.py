"""States of a run, and the table of transitions between them."""

from enum import Enum

from protocol.wire.exit_codes import EXIT_DIVERGED, EXIT_INTERRUPTED, EXIT_OVERRUN, EXIT_UNREACHABLE
from protocol.wire.messages import Outcome


class State(Enum):
    """State of a run."""

    WAITING = "the processes are joining"
    OPEN = "a tick is open"
    HELD = "the next tick waits for agents that the scenario's faults bring back"
    LAST = "the last tick is open"
    DIVERGED = "the plant has diverged; the run ends when the next tick is open"
    STOPPED = "the run has ended"


class Trigger(Enum):
    """Cause of a transition."""

    TICK_OPENED = "a tick was opened that is not the last"
    LAST_TICK_OPENED = "the last tick was opened"
    TICK_HELD = "the next tick is due, but an agent is not back yet"
    DIVERGENCE_REPORTED = "the plant reported that it has diverged"
    COMPLETED = "the last tick is answered and recorded"
    DIVERGENCE_RECORDED = "the record of the divergence is complete"
    UNREACHABLE = "the plant or too many agents are gone or silent"
    OVERRUN = "more deadlines were missed than allowed"
    INTERRUPTED = "a signal ended the run"


# Triggers that end a run, with its outcome and exit code.
ENDS: dict[Trigger, tuple[Outcome, int]] = {
    Trigger.COMPLETED: ("completed", 0),
    Trigger.DIVERGENCE_RECORDED: ("diverged", EXIT_DIVERGED),
    Trigger.UNREACHABLE: ("aborted", EXIT_UNREACHABLE),
    Trigger.OVERRUN: ("aborted", EXIT_OVERRUN),
    Trigger.INTERRUPTED: ("aborted", EXIT_INTERRUPTED),
}

_ABORTS = {Trigger.UNREACHABLE: State.STOPPED, Trigger.INTERRUPTED: State.STOPPED}
_OPENS = {Trigger.TICK_OPENED: State.OPEN, Trigger.LAST_TICK_OPENED: State.LAST}
_DIVERGES = {Trigger.DIVERGENCE_REPORTED: State.DIVERGED}
_OVERRUNS = {Trigger.OVERRUN: State.STOPPED}

# Every other pair of state and trigger is an error of the coordinator.
TRANSITIONS: dict[State, dict[Trigger, State]] = {
    State.WAITING: {**_OPENS, **_ABORTS},
    State.OPEN: {**_OPENS, Trigger.TICK_HELD: State.HELD, **_DIVERGES, **_OVERRUNS, **_ABORTS},
    State.HELD: {**_OPENS, **_DIVERGES, **_ABORTS},
    State.LAST: {Trigger.COMPLETED: State.STOPPED, **_DIVERGES, **_OVERRUNS, **_ABORTS},
    State.DIVERGED: {
        **dict.fromkeys(_OPENS, State.DIVERGED),
        Trigger.DIVERGENCE_RECORDED: State.STOPPED,
        **_OVERRUNS,
        **_ABORTS,
    },
    State.STOPPED: {},
}
