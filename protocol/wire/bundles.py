"""Bundles: messages that travel together in one, in lockstep with `clock.exchange = "relayed"`.

An agent answers a tick with one message to the coordinator, its plan and its report. The coordinator sends the answers
of tick k on with tick k + 1, as they came. The plant sends its state and all measurements to the record in one message.
A receiver checks each message of a bundle as if it had come alone.
"""

from dataclasses import dataclass
from typing import ClassVar

from protocol.wire.control_loop import Measurement, Plan
from protocol.wire.coordination import Tick
from protocol.wire.fields import Agent, KeyEnds, MessageError, Parts
from protocol.wire.message import BUNDLES, Message, Route
from protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER, WATCHER
from protocol.wire.records import ActualInputs, PlantState, StepReport

_ANSWERS = (Plan.kind, Plan.route.unshared_key, StepReport.kind)
# A plan and a report: all answers of a tick must fit into one relay.
_ANSWER_PARTS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Bundle(Message):
    """Messages as bytes, each with its key.

    `carries` has the beginnings of the keys that a kind of bundle may carry.
    """

    register: ClassVar[dict[str, type[Message]]] = BUNDLES
    carries: ClassVar[tuple[str, ...]] = ()

    keys: KeyEnds  # without the prefix of the run, such as "plan/2"
    parts: Parts  # encoded messages, in the same order

    def may_carry(self, key: str) -> bool:
        """Return whether a bundle of this kind may carry a message with a key."""
        return key.split("/", 1)[0] in self.carries

    def _check_relations(self) -> None:
        if len(self.keys) != len(self.parts):
            text = f"parts: expected one for each of {len(self.keys)} keys, got {len(self.parts)}"
            raise MessageError("wrong_shape", text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer(Bundle):
    """Agent to coordinator: the plan and the report of a tick."""

    kind: ClassVar[str] = "answer"
    route: ClassVar[Route] = Route(sender=AGENT, receivers=(COORDINATOR,), each="agent", grows="tick")
    carries: ClassVar[tuple[str, ...]] = _ANSWERS

    agent: Agent

    def may_carry(self, key: str) -> bool:
        """Return whether a key is one of this agent's answer."""
        return key in [f"{beginning}/{self.agent}" for beginning in self.carries]

    def _check_relations(self) -> None:
        Bundle._check_relations(self)  # super() does not work in dataclasses with slots
        if len(self.keys) > _ANSWER_PARTS or len(set(self.keys)) < len(self.keys):
            text = f"keys: expected at most a plan and a report, got {len(self.keys)} keys"
            raise MessageError("wrong_shape", text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Relay(Bundle):
    """Coordinator to all: the answers of a tick, and the tick after it once that is open."""

    kind: ClassVar[str] = "relay"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=(AGENT, PLANT, RECORDER, WATCHER))
    carries: ClassVar[tuple[str, ...]] = (*_ANSWERS, Tick.kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class Record(Bundle):
    """Plant to the record and the coordinator: the plant's state, and the measurements it has sent."""

    kind: ClassVar[str] = "record"
    route: ClassVar[Route] = Route(sender=PLANT, receivers=(COORDINATOR, RECORDER, WATCHER))
    carries: ClassVar[tuple[str, ...]] = (PlantState.kind, ActualInputs.kind, Measurement.kind)
