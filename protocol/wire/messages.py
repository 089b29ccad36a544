"""All messages of a run, and the other events that nodes receive.

Per tick: coordinator -> plant `Tick`; plant -> each agent `Measurement`; agent -> plant, coordinator and, when it is
shared, the other agents `Plan`. For the record: plant `PlantState` and `ActualInputs`, agents `StepReport`, any process
`Rejected`. Around them: coordinator `Roster`, `LinkChange` and `Control`. In lockstep most of them travel in bundles:
`Answer`, `Relay` and `Record`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from protocol.wire.bundles import Answer, Bundle, Record, Relay
from protocol.wire.control_loop import Measurement, Plan, PlanStatus
from protocol.wire.coordination import Control, LinkChange, Outcome, Roster, Tick
from protocol.wire.fields import MAX_HORIZON, MAX_NEGOTIATION_ITERATIONS, MAX_TEXT, MAX_TICK, MessageError, Reason
from protocol.wire.message import BUNDLES, KINDS, Message
from protocol.wire.names import MAX_UAVS, agent_name, is_name
from protocol.wire.records import STAGES, ActualInputs, FaultNote, FaultOrigin, PlantState, Rejected, StepReport


@dataclass(frozen=True, slots=True)
class Presence:
    """Event for a node, made from liveliness tokens: a process is there, or gone."""

    name: str
    incarnation: int  # which start of it
    alive: bool  # ready to take part; False when its token is gone


@dataclass(frozen=True, slots=True)
class Request:
    """Event for a node: a client asks for something and waits for the answer."""

    what: str  # such as "status" or "link"
    given: Mapping[str, Any]  # its arguments
    reply: Callable[[Mapping[str, Any]], None]  # to be called once, with the answer


Event = Message | Presence | Request
