"""All messages of a run, and the other events that nodes receive.

Per tick: coordinator -> plant `Tick`; plant -> each agent `Measurement`; agent -> plant, coordinator and, when it is
shared, the other agents `Plan`. For the record: plant `PlantState`, agents `StepReport`, any process `Rejected`.
Around them: coordinator `Roster`, `LinkChange` and `Control`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from protocol.wire.control_loop import Measurement, Plan, PlanStatus
from protocol.wire.coordination import Control, LinkChange, Outcome, Roster, Tick
from protocol.wire.fields import (
    MAX_HORIZON,
    MAX_NEGOTIATION_ITERATIONS,
    MAX_TEXT,
    MAX_TICK,
    MessageError,
    Reason,
)
from protocol.wire.message import KINDS, Message
from protocol.wire.names import MAX_UAVS, agent_name, is_name
from protocol.wire.records import STAGES, FaultNote, FaultOrigin, PlantState, Rejected, StepReport


@dataclass(frozen=True, slots=True)
class Presence:
    """Event for a node, made from liveliness tokens: a process is there, or gone.

    Attributes:
        name: Process name.
        incarnation: Which start of it.
        alive: True when it is ready to take part, False when its token is gone.
    """

    name: str
    incarnation: int
    alive: bool


@dataclass(frozen=True, slots=True)
class Request:
    """Event for a node: a client asks for something and waits for the answer.

    Attributes:
        what: Such as "status" or "link".
        given: Its arguments.
        reply: To be called once, with the answer.
    """

    what: str
    given: Mapping[str, Any]
    reply: Callable[[Mapping[str, Any]], None]


Event = Message | Presence | Request
