"""The changes of a scenario's links that silences make, beside those that it has itself."""

import math
from collections.abc import Sequence

from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.names import agent_name
from transport.search.kinds_of_events import DrawnSilence, Tree

Pair = tuple[int, int]  # sender and receiver, agents

_SLACK = 1e-9  # of a time at a sampling instant, in periods


class OwnLosses:
    """Loss of each link between agents by a scenario without silences."""

    def __init__(self, scenario: Scenario) -> None:
        agents = range(1, len(scenario.owned) + 1)
        self._period_s = scenario.controller.sampling_period_s
        self._changes = scenario.links.change
        self.links = {
            (sender, receiver): Link(
                scenario.links,
                agent_name(sender),
                agent_name(receiver),
                seed=scenario.seed,
                period_s=self._period_s,
            )
            for sender in agents
            for receiver in agents
            if sender != receiver
        }

    def at(self, at_s: float) -> dict[Pair, float]:
        """Return the loss of each link from a time on."""
        tick = math.ceil(at_s / self._period_s - _SLACK)
        return {pair: link.impairments(tick).loss for pair, link in self.links.items()}

    def changed(self, at_s: float) -> set[Pair]:
        """Return the links whose loss the scenario itself sets at a time."""
        given = [
            one for one in self._changes if one.at_s == at_s and "loss" in one.model_fields_set
        ]
        return {
            pair
            for pair, link in self.links.items()
            if any(one.covers(link.sender, link.receiver) for one in given)
        }

    @property
    def times_s(self) -> set[float]:
        """Times at which the scenario itself changes links."""
        return {one.at_s for one in self._changes}


def changes_of_links(silences: Sequence[DrawnSilence], scenario: Scenario) -> list[Tree]:
    """Return the changes of `links` that silences make, which may overlap.

    At each instant a link has the largest loss of the silences that cover it, and of the scenario
    without them. Links that change alike are one entry: all, those from an agent, or those to it.
    """
    if not silences:
        return []
    own = OwnLosses(scenario)
    in_force = own.at(0.0)
    changes: list[Tree] = []

    begins_and_ends = {time for one in silences for time in (one.start_s, one.end_s)}
    for at_s in sorted(begins_and_ends | own.times_s):
        without = own.at(at_s)
        in_force |= {pair: without[pair] for pair in own.changed(at_s)}
        active = [one for one in silences if one.start_s <= at_s < one.end_s]
        new = {
            pair: max([loss, *(one.loss for one in active if one.silences(*pair))])
            for pair, loss in without.items()
        }
        changed = {pair: value for pair, value in new.items() if value != in_force[pair]}
        changes += [{"at_s": at_s, **entry} for entry in _entries(changed, new)]
        in_force = new

    return changes


def _entries(
    changed: dict[tuple[int, int], float], new: dict[tuple[int, int], float]
) -> list[Tree]:
    """Return as few changes as it takes to bring some links to new losses."""
    if not changed:
        return []
    if len(set(new.values())) == 1:
        return [{"loss": next(iter(new.values()))}]
    entries: list[Tree] = []
    left = dict(changed)

    for end, key in ((0, "from"), (1, "to")):
        for agent in sorted({pair[end] for pair in left}):
            links = {pair: value for pair, value in new.items() if pair[end] == agent}
            if links.keys() <= left.keys() and len(set(links.values())) == 1:
                entries.append({key: f"agent{agent}", "loss": next(iter(links.values()))})
                left = {pair: value for pair, value in left.items() if pair not in links}

    for (sender, receiver), value in left.items():
        entries.append({"from": f"agent{sender}", "to": f"agent{receiver}", "loss": value})
    return entries
