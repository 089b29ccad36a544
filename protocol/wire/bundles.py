"""Bundles: messages that travel together in lockstep.

Receivers check each message of a bundle as if it had come alone; nodes and logs never see bundles.
"""

from typing import ClassVar

from transport.protocol.wire.message_form import Agent, KeyEnds, Message, Parts, Route, kinds_below
from transport.protocol.wire.messages import (
    ActualInputs,
    Airtime,
    Measurement,
    Plan,
    PlantState,
    StepReport,
    Tick,
)
from transport.protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER, WATCHER


class Bundle(Message, frozen=True, kw_only=True):
    """Messages as bytes, each with its key; `carries` has the kinds that a bundle may carry."""

    carries: ClassVar[tuple[type[Message], ...]] = ()
    as_long: ClassVar[tuple[str, ...]] = "keys", "parts"

    keys: KeyEnds  # without the prefix of the run, such as "plan/2"
    parts: Parts  # encoded messages, in the same order

    def may_carry(self, key: str) -> bool:
        """Return whether this bundle may carry a message with a key.

        A bundle that itself has a key for each agent carries messages of its own agent only.
        """
        beginning, _, end = key.partition("/")
        each = self.route.each
        if each and end != str(getattr(self, each)):
            return False
        return any(beginning in (cls.kind, cls.route.unshared_key) for cls in self.carries)


class Answer(Bundle, tag="answer", frozen=True, kw_only=True):
    """Agent to coordinator: the plan and the report of a tick."""

    route: ClassVar[Route] = Route(
        sender=AGENT, receivers=(COORDINATOR,), each="agent", grows="tick"
    )
    carries: ClassVar[tuple[type[Message], ...]] = (Plan, StepReport)

    agent: Agent


class Relay(Bundle, tag="relay", frozen=True, kw_only=True):
    """Coordinator to plant and record: the answers of a tick, and the tick after it when open."""

    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=(PLANT, RECORDER, WATCHER))
    carries: ClassVar[tuple[type[Message], ...]] = (Plan, StepReport, Airtime, Tick)


class Instant(Bundle, tag="instant", frozen=True, kw_only=True):
    """Plant to agents: the shared plans of a tick, and the measurements of the next tick."""

    route: ClassVar[Route] = Route(sender=PLANT, receivers=(AGENT,))
    carries: ClassVar[tuple[type[Message], ...]] = (Plan, Airtime, Measurement)


class Record(Bundle, tag="record", frozen=True, kw_only=True):
    """Plant to record and coordinator: the plant's state, and the measurements it has sent."""

    route: ClassVar[Route] = Route(sender=PLANT, receivers=(COORDINATOR, RECORDER, WATCHER))
    carries: ClassVar[tuple[type[Message], ...]] = (PlantState, ActualInputs, Measurement)


BUNDLES = kinds_below(Bundle)  # by kind
