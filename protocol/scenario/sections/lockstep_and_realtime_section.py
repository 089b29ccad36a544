"""The sampling clock of a run: its section in a scenario, and the tick of an instant."""

import math
from typing import Annotated, Any, Literal

from annotated_types import Interval
from pydantic import Field, model_validator

from transport.model.section import Key, NotNegative, Positive, Section
from transport.protocol.wire.names import MAX_UAVS

LONGEST_WAIT_S = 1e6  # of wall time, for a process
_WAIT_S = (1e-3, LONGEST_WAIT_S)
# Rounding of a number of periods or steps, absolute, and relative for the duration of a run: a whole
# number must not become one more.
ROUNDING = 1e-9


class ClockSection(Section):
    """Sampling clock and membership."""

    mode: Literal["lockstep", "realtime"] = "lockstep"
    """a tick opens when all agents have answered the one before, or at its deadline"""
    speed: Annotated[NotNegative, Key(within=(1e-4, 1e4))] = 0.0
    """scenario seconds per second. 0: as fast as possible, in lockstep only. The default of real
    time is 1, also where `--set clock.mode=realtime` alone changes a scenario of speed 0"""
    actuation: Literal["immediate", "next_tick"] | None = None
    """a plan acts from its own tick on, or from the next; real time needs next_tick, lockstep
    prefers immediate"""
    offsets_s: Annotated[list[float], Field(max_length=MAX_UAVS)] | None = None
    """by how much the clock of each agent is ahead, in lockstep: it follows the maneuver at the time that it
    believes, and stamps measurements and plans with it ([time.md](../time.md#clocks-that-differ)). They differ
    by less than a sampling period; none: all clocks agree"""
    barrier_timeout_s: Annotated[Positive, Key(within=_WAIT_S)] = 5.0
    """wall time after which a silent agent counts as lost, in real time also the plant"""
    join_timeout_s: Annotated[Positive, Key(within=_WAIT_S)] = 30.0
    """wall time the processes wait for each other at the start, in lockstep also a tick for a
    restarted agent"""
    on_agent_loss: Annotated[Literal["abort", "continue"], Key(short="on_agent_loss")] = "abort"
    """end the run with exit code 4, or continue without the agent, which may return"""
    on_coordinator_loss: Literal["end", "continue"] = "end"
    """end the run when the coordinator is gone, or with vehicles go on with the roster in force: each
    knows the instants of the ticks, and a coordinator that is started again takes over
    ([flight.md](../flight.md))"""
    on_overrun: Literal["continue", "hold", "abort"] = "continue"
    """in real time, when plans are missing at a deadline: open the next tick, hold it for them, or
    end the run"""
    overrun_limit: Annotated[int, Interval(ge=0)] = 0
    """with abort: number of plans that may miss their deadline"""
    overrun_limit_s: Annotated[Positive | None, Key(within=(1e-9, 1e6))] = None
    """with abort: largest delay of a plan after its deadline, and of the opening of a tick; wall
    time"""

    @model_validator(mode="before")
    @classmethod
    def _paced(cls, value: Any) -> Any:
        """Fill in the speed of real time, whose default cannot be that of lockstep.

        `--set clock.mode=realtime` replaces a speed of 0 that the file has (`scenario.file`).
        """
        if isinstance(value, dict) and value.get("mode") == "realtime":
            return {"speed": 1.0, **value}
        return value

    @property
    def next_tick(self) -> bool:
        """Return whether inputs act one tick after their state, as on hardware and in real time."""
        if self.actuation is None:
            return self.mode == "realtime"
        return self.actuation == "next_tick"


def first_tick(at_s: float, period_s: float) -> int:
    """Return the first tick not before a time of the run."""
    return math.ceil(at_s / period_s - ROUNDING)
