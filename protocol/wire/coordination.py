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
    """Coordinator to plant: tick k is open."""

    kind: ClassVar[str] = "tick"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=(PLANT, RECORDER, WATCHER), grows="tick")

    members: Ids  # agents whose plans of this tick the clock will wait for
    answered: Ids  # agents whose plans of tick k - 1 count: users of plans of k - 1 wait for these
    shared: Ids  # those of them that sent the plan to the other agents as well
    roster: Count  # version of the roster in force: a receiver with an older one waits for it
    late_ns: Count  # in real time, how long after its deadline the tick was opened; else 0
    # In real time, by how much the latest plan received since the last tick missed its deadline, the opening of the
    # tick after its own; else 0.
    overrun_ns: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class Roster(Message):
    """Coordinator to all: the agents that take part from this tick on."""

    kind: ClassVar[str] = "roster"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL, grows="version")

    version: Count  # grows with every change
    agents: Ids  # agents on the roster
    incarnations: Counts  # their incarnations, in the same order; messages of other incarnations are refused
    off: Ids  # UAVs whose motors give no thrust and no moments, 1-based ids, ascending; the released ones too
    released: Ids  # UAVs that are no longer on their rods, 1-based ids, ascending
    reason: Text  # why it changed, for people

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

    Messages keep their order within one key only. The key is that of the roster, so a change arrives before the next
    roster.
    """

    kind: ClassVar[str] = "link"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL, key=Roster.kind)

    number: Number  # of the change in its run, from 1: a process that joins late receives all of them again
    source: End  # name of an end; empty for any agent
    target: End  # the same
    settings: Text  # keys of a link and their new values, a JSON object (docs/keys.md, `links`)


@dataclass(frozen=True, slots=True, kw_only=True)
class Control(Message):
    """Coordinator to all: the run ends here."""

    kind: ClassVar[str] = "control"
    route: ClassVar[Route] = Route(sender=COORDINATOR, receivers=_ALL)

    outcome: Outcome
    reason: Text  # why, for people; empty when completed
    exit_code: Annotated[int, integer(0, 255)]  # the code every process exits with
