"""Messages of the coordinator: ticks, the roster, changes of links, the end of a run."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from protocol.wire.fields import Count, Counts, End, Ids, MessageError, Number, Text, integer
from protocol.wire.message import Message, Route
from protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER, WATCHER

Outcome = Literal["completed", "diverged", "aborted"]

_ALL = (AGENT, PLANT, RECORDER, WATCHER)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick(Message):
    """Coordinator to plant: tick k is open.

    Attributes:
        members: Agents whose plans of this tick the clock will wait for.
        answered: Agents whose plans of tick k - 1 count: users of plans of k - 1 wait for these.
        shared: Those of them that sent the plan to the other agents as well.
        roster: Version of the roster in force: a receiver with an older one waits for it.
        late_ns: In real time, how long after its deadline the tick was opened; else 0.
        overrun_ns: In real time, by how much the latest plan that came since the tick before missed its
            deadline, the opening of the tick after its own; else 0.
    """

    kind: ClassVar[str] = "tick"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=(PLANT, RECORDER, WATCHER), grows="tick")

    members: Ids
    answered: Ids
    shared: Ids
    roster: Count
    late_ns: Count
    overrun_ns: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class Roster(Message):
    """Coordinator to all: the agents that take part from this tick on.

    Attributes:
        version: Grows with every change.
        agents: Agents on the roster.
        incarnations: Their incarnations, in the same order; messages of other incarnations are refused.
        off: UAVs whose motors give no thrust and no moments, 1-based ids, ascending; the released ones too.
        released: UAVs that are no longer on their rods, 1-based ids, ascending.
        reason: Why it changed, for people.
    """

    kind: ClassVar[str] = "roster"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL, grows="version")

    version: Count
    agents: Ids
    incarnations: Counts
    off: Ids
    released: Ids
    reason: Text

    def _check_relations(self) -> None:
        if not set(self.released) <= set(self.off):
            text = f"released: expected UAVs among those off {list(self.off)}, got {list(self.released)}"
            raise MessageError("out_of_range", text)
        if len(self.agents) != len(self.incarnations):
            text = f"incarnations: expected one for each of {len(self.agents)} agents, got {len(self.incarnations)}"
            raise MessageError("wrong_shape", text)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkChange(Message):
    """Coordinator to all: from this tick on links treat messages differently.

    Order holds under one key alone, so it has that of the roster: a receiver of the roster that follows has it.

    Attributes:
        number: Of the change in its run, from 1: a process that joins late receives all of them again.
        source, target: Names of the ends; empty for any agent.
        settings: Keys of a link and their new values, a JSON object (docs/scenario.md, `links`).
    """

    kind: ClassVar[str] = "link"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL, key=Roster.kind)

    number: Number
    source: End
    target: End
    settings: Text


@dataclass(frozen=True, slots=True, kw_only=True)
class Control(Message):
    """Coordinator to all: the run ends here.

    Attributes:
        outcome: How.
        reason: Why, for people; empty when completed.
        exit_code: The code every process exits with.
    """

    kind: ClassVar[str] = "control"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL)

    outcome: Outcome
    reason: Text
    exit_code: Annotated[int, integer(0, 255)]
