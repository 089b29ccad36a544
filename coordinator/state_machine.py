"""Machine of a run: its states, the causes that move it, and one table of both.

Everything that changes the state of a run is in this file. A run without vehicles goes

    WAITING  ->  OPEN  ->  OPEN  ->  ...  ->  STOPPED
                  |  ^
                  v  |
                  HELD

one tick open at a time. With vehicles it goes from WAITING through PREPARING and STARTING to the
first tick, since vehicles have clocks of their own and are told ahead when tick 0 is. ENDING is
left only to STOPPED. What does not move the machine is not an event of it: answers to the open tick are
counted by `coordinator.answers_to_open_tick`, and agents come and go on the roster in any state.

What holds in each state:

    WAITING    no tick is open, and the roster is all agents; a lost process ends the run
    PREPARING  likewise; vehicles have joined, their clocks and places are not yet known well enough
    STARTING   likewise; the instant of tick 0 is fixed, and nothing moves it any more
    OPEN       exactly one tick is open; each agent on the roster owes one plan for it
    HELD       the open tick is answered by all; nothing is owed but the agents that are to return
    ENDING     the plant has said that it cannot go on; no tick is held, the roster is as before
    STOPPED    the end has been sent, once; every event is ignored

Two machines are no business of this one: that of the clock (`coordinator.when_ticks_open_and_close`: how long
OPEN and HELD may last), and that of each agent (`coordinator.roster`: on the roster, off it, joining).
"""

from collections.abc import Mapping
from enum import Enum


class State(Enum):
    """State of a run."""

    WAITING = "the processes are joining"
    PREPARING = "the vehicles prepare"
    STARTING = "the vehicles have been told when tick 0 is"
    OPEN = "a tick is open"
    HELD = "the next tick waits for agents that the scenario's faults bring back"
    ENDING = (
        "the plant has diverged, or two UAVs have collided; the run ends when the next tick is open"
    )
    STOPPED = "the run has ended"


class Cause(Enum):
    """Cause of a transition."""

    JOINED = "the last process has joined, in a run with vehicles"
    TOLD = "the instant of tick 0 has been told"
    OPENED = "a tick has been opened"
    AWAITED = "agents are to return at the next tick, and have not"
    PLANT_ENDS = "the plant's state is one after which the run ends"
    ENDED = "the end has been sent"


# Next state by state and cause. A pair that is not here is a defect of the coordinator.
TRANSITIONS: Mapping[State, Mapping[Cause, State]] = {
    State.WAITING: {
        Cause.JOINED: State.PREPARING,
        Cause.OPENED: State.OPEN,
        # A coordinator that was started again hears from a plant that has gone on without it.
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.PREPARING: {
        # Also by the vehicles: they say when tick 0 was to a coordinator that was started again.
        Cause.TOLD: State.STARTING,
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.STARTING: {
        Cause.OPENED: State.OPEN,
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.OPEN: {
        Cause.OPENED: State.OPEN,
        Cause.AWAITED: State.HELD,
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.HELD: {
        # The last agent has returned, or is given up; until then any event may ask again.
        Cause.OPENED: State.OPEN,
        Cause.AWAITED: State.HELD,
        # Nothing is waited for then: the next tick opens at once, and the run ends.
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.ENDING: {
        # The plant's state of tick p may come before the last plan of tick p, or after it. The run
        # ends when tick p + 1 is open in both cases, so that the record is the same.
        Cause.OPENED: State.ENDING,
        Cause.PLANT_ENDS: State.ENDING,
        Cause.ENDED: State.STOPPED,
    },
    State.STOPPED: {},
}

# States without a tick: the loss of any process that takes part ends the run.
BEFORE_TICK_0 = frozenset({State.WAITING, State.PREPARING, State.STARTING})


class MachineError(RuntimeError):
    """A cause in a state in which it cannot be: a defect of the coordinator, not of a message."""


class Machine:
    """State of one run.

    Attributes:
        state: State of the run; `move` alone sets it.
    """

    def __init__(self) -> None:
        self.state = State.WAITING

    def move(self, cause: Cause) -> bool:
        """Go to the state that follows from a cause; return whether it is another one.

        Raises: MachineError: the cause cannot be in this state.
        """
        before = self.state
        following = TRANSITIONS[before].get(cause)
        if following is None:
            raise MachineError(f"{cause.name} in {before.name}: {cause.value}, but {before.value}")
        self.state = following
        return following is not before
