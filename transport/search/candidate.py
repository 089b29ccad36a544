"""A candidate of a search: a scenario with events, and its simpler neighbours."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from transport.protocol.scenario.scenario_file import validate
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.teams.team_of_any_size import FEWEST, Team, resized
from transport.search.kinds_of_events import Death, DrawnSilence, Event
from transport.search.silent_links import changes_of_links


@dataclass(frozen=True, kw_only=True)
class Base:
    """The scenario that a search disturbs."""

    scenario: Scenario
    source: str  # its file, for errors

    @cached_property
    def digest(self) -> str:
        """Fingerprint of the scenario, which each case has in its key."""
        return self.scenario.digest()

    def of_size(self, uavs: int) -> "Base":
        """Return the same with a smaller team, each agent with one UAV."""
        smaller = resized(self.scenario, Team(uavs=uavs, group=1), self.source)
        return replace(self, scenario=smaller)


@dataclass(frozen=True, slots=True)
class Candidate:
    """Events, in the order in which they are told."""

    events: tuple[Event, ...]

    def scenario(self, base: Base) -> Scenario:
        """Return the scenario with the events. Raises: ScenarioError: it is impossible."""
        tree = base.scenario.tree()
        source = str(Path(base.source))
        silences = [event for event in self.events if isinstance(event, DrawnSilence)]

        for event in self.events:
            if not isinstance(event, DrawnSilence):
                event.apply(tree)
        tree["faults"]["event"].sort(key=lambda fault: fault["at_s"])
        without_silences = validate(tree, source)

        changes = changes_of_links(silences, without_silences)
        if not changes:
            return without_silences
        tree["links"]["change"] = [*tree["links"]["change"], *changes]
        return validate(tree, source)

    def without(self, index: int) -> "Candidate":
        """Return the candidate without one event."""
        return Candidate(self.events[:index] + self.events[index + 1 :])

    def fewer(self) -> list["Candidate"]:
        """Return the candidates with one event less."""
        return [self.without(index) for index in range(len(self.events))]

    def simpler(self, index: int) -> list["Candidate"]:
        """Return the candidates in which one event is simpler."""
        before, after = self.events[:index], self.events[index + 1 :]
        return [Candidate((*before, simpler, *after)) for simpler in self.events[index].simpler()]

    def smaller_teams(self, base: Base) -> Iterator[Base]:
        """Yield smaller teams in which every agent of the events exists, the smallest first.

        None in which the scenario itself names an agent or a UAV that the team does not have.
        """
        agents = len(base.scenario.owned)
        if agents < len(base.scenario.system.uav):
            return
        for uavs in range(max(FEWEST, self._last_agent()), agents):
            try:
                smaller = base.of_size(uavs)
            except ScenarioError:
                continue
            yield smaller

    def _last_agent(self) -> int:
        """Return the largest number of an agent in the events; 0 without one."""
        numbers = [0]
        for event in self.events:
            if isinstance(event, DrawnSilence):
                numbers += event.agents
            elif isinstance(event, Death):
                numbers.append(event.agent)
        return max(numbers)

    def beyond_network(self) -> "Candidate":
        """Return the events that a centralized controller with perfect information meets, too."""
        return Candidate(tuple(event for event in self.events if not event.of_network))

    def in_words(self) -> str:
        """Return the events as one sentence."""
        return "; ".join(event.in_words() for event in self.events) or "no event"
