"""Impairments of the network, which act at the receiver, in scenario time."""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import Any

from transport.model.arrays import Array
from transport.protocol.scenario.links.random_streams import Draw, Streams, draw_key
from transport.protocol.scenario.sections.link_sections import (
    GilbertElliottSection,
    LinkOverrideSection,
    LinkSection,
    LinksSection,
    PartitionSection,
)
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.wire.messages import Measurement, Plan
from transport.protocol.wire.names import PLANT

# Stream of the burst chain at each tick; those of the message and the negotiation are 0, 1, ...
_CHAIN = 2**32

# Rounding of a delay that is a whole number of sampling periods must not cost one more.
_SLACK = 1e-9


@dataclass(frozen=True, slots=True)
class Epoch:
    """Impairments in force from a tick on."""

    first_tick: int
    section: LinkSection
    is_perfect: bool  # asked for with every message


@dataclass(frozen=True, slots=True)
class Change:
    """Keys of a link that were changed from a tick on."""

    first_tick: int
    keys: Mapping[str, Any]


class Link:
    """One link of a run, which decides whether and when each message arrives."""

    def __init__(
        self, links: LinksSection, sender: str, receiver: str, *, seed: int, period_s: float
    ) -> None:
        self.sender = sender
        self.receiver = receiver
        self._period_s = period_s

        kind = Measurement.kind if sender == PLANT else Plan.kind
        self._streams = Streams(draw_key(seed, sender, receiver, kind))

        section = _section_of(links, sender, receiver)
        self._epochs = [Epoch(0, section, section.perfect)]
        self._changes: list[Change] = []
        self._partitions = [cut for cut in links.partition if _separates(cut, sender, receiver)]
        self._was_bad: list[bool] = []  # Gilbert-Elliott state by tick, as far as it was needed

        for change in sorted(links.change, key=attrgetter("at_s")):
            self.change(first_tick(change.at_s, period_s), change)

    def change(self, tick: int, change: LinkOverrideSection) -> None:
        """Apply the given keys from a tick on, if the change covers this link.

        The latest change is in force.
        """
        if not change.covers(self.sender, self.receiver):
            return

        names = change.model_fields_set & LinkSection.model_fields.keys()
        keys = {name: getattr(change, name) for name in names}
        self._changes.append(Change(tick, keys))
        self._changes.sort(key=attrgetter("first_tick"))  # equal ones in the order given

        # Each change keeps the keys that it does not give from the epoch before.
        del self._epochs[1:]
        for one in self._changes:
            before = self._epochs[-1].section
            section = before.model_copy(update={**_ended(before, one.keys), **one.keys})
            self._epochs.append(Epoch(one.first_tick, section, section.perfect))

    def impairments(self, tick: int) -> LinkSection:
        """Return the impairments in force for the message of a tick."""
        return self._in_force(tick).section

    def delays(self, tick: int, negotiation: int = 0) -> list[float]:
        """Return the delays of a tick's message, s: none if it is lost, two if it is duplicated.

        Plans are message 0 of a tick, proposals of a negotiation count from 1.
        """
        epoch = self._in_force(tick)
        section = epoch.section
        if self._is_cut(tick):
            return []
        if epoch.is_perfect:
            return [0.0]
        if self._exceeds_rate(section, tick):
            return []

        draw = Draw(self._streams.at(tick, negotiation).random(Draw.COUNT))
        if draw.loss < section.loss or self._is_lost_in_burst(section, tick, draw):
            return []

        if section.trace is not None:
            traced_s = traced_delay_s(section.trace, tick * self._period_s)
            if traced_s < 0.0:
                return []
            recorded = {"delay_s": traced_s, "jitter_s": 0.0, "distribution": "uniform"}
            section = section.model_copy(update=recorded)

        delay_s = _delay(section, draw.jitter)
        if draw.reorder < section.reorder:
            delay_s += section.reorder_s

        delays_s = [delay_s]
        if draw.duplicate < section.duplicate:
            delays_s.append(_delay(section, draw.echo_jitter))
        return delays_s

    def usable_ticks(self, tick: int, after: int = 1, air_s: float = 0.0) -> list[int]:
        """Return the ticks from which on the message of a tick can be used.

        They are those at or after its arrival, and at least `after` ticks later. It enters the link
        `air_s` after its tick, when the radio of the team has carried it.
        """
        earliest = tick + after
        is_perfect = not self._partitions and self._in_force(tick).is_perfect
        if is_perfect and air_s == 0.0:
            return [earliest]

        delays_s = [0.0] if is_perfect else self.delays(tick)
        arrivals = [
            math.ceil(tick + (air_s + delay_s) / self._period_s - _SLACK) for delay_s in delays_s
        ]
        return [max(earliest, arrival) for arrival in arrivals]

    def _in_force(self, tick: int) -> Epoch:
        """Return the epoch that a tick belongs to."""
        for epoch in reversed(self._epochs):
            if epoch.first_tick <= tick:
                return epoch
        return self._epochs[0]

    def _is_cut(self, tick: int) -> bool:
        """Return whether a partition separates the ends when the message of a tick is sent."""
        sent_s = tick * self._period_s + _SLACK
        return any(cut.start_s <= sent_s < cut.end_s for cut in self._partitions)

    def _exceeds_rate(self, section: LinkSection, tick: int) -> bool:
        """Return whether the rate of the link leaves no room for the message of a tick."""
        if section.rate_hz is None or tick == 0:
            return False

        # Message k passes when floor(k r T_s) grows: those that pass are evenly spread.
        per_tick = section.rate_hz * self._period_s
        passed = math.floor(tick * per_tick + _SLACK)
        passed_before = math.floor((tick - 1) * per_tick + _SLACK)
        return passed == passed_before

    def _is_lost_in_burst(self, section: LinkSection, tick: int, draw: Draw) -> bool:
        """Return whether the message of a tick is lost by the Gilbert-Elliott chain."""
        bursts = section.gilbert_elliott
        if bursts is None:
            return False
        return self._is_bad(tick) and draw.burst < bursts.loss

    def _is_bad(self, tick: int) -> bool:
        """Return whether the Gilbert-Elliott chain is bad at a tick, starting in the good state."""
        for k in range(len(self._was_bad), tick + 1):
            was_bad = k > 0 and self._was_bad[-1]
            bursts = self.impairments(k).gilbert_elliott
            self._was_bad.append(self._becomes_bad(k, bursts, was_bad=was_bad))
        return self._was_bad[tick]

    def _becomes_bad(
        self, tick: int, bursts: GilbertElliottSection | None, *, was_bad: bool
    ) -> bool:
        """Return the next state of the Gilbert-Elliott chain."""
        if bursts is None or not (was_bad or bursts.enter):
            return False

        draw = self._streams.at(tick, _CHAIN).random()
        return bool(draw >= bursts.leave) if was_bad else bool(draw < bursts.enter)


def traced_delay_s(trace: Sequence[Sequence[float]], sent_s: float) -> float:
    """Return the delay in a trace for a message sent at a time of the run, s; negative if lost.

    The last row, which has the same distance from its end as from the row before, is followed by
    the first.
    """
    begin_s = trace[0][0]
    duration_s = 2.0 * trace[-1][0] - trace[-2][0] - begin_s
    at_s = begin_s + sent_s % duration_s
    row = bisect_right(trace, at_s + _SLACK, key=itemgetter(0)) - 1
    return trace[row][1]


def _ended(before: LinkSection, keys: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the keys that end recorded or measured delays, where a change gives others."""
    ended: dict[str, Any] = {}
    if keys.keys() & {"delay_s", "jitter_s", "distribution", "samples_s"}:
        ended["trace"] = None
    if before.distribution == "empirical" and keys.keys() & {"delay_s", "jitter_s"}:
        ended["distribution"] = "uniform"
    return ended


def _section_of(links: LinksSection, sender: str, receiver: str) -> LinkSection:
    """Return the impairments of a link at the start: those of the last exception that covers it."""
    section: LinkSection = links
    if sender == PLANT:
        section = links.measurement
    elif receiver == PLANT:
        section = links.actuation

    for override in links.override:
        if override.covers(sender, receiver):
            section = override
    return section


def _separates(cut: PartitionSection, sender: str, receiver: str) -> bool:
    """Return whether a partition separates two processes; the plant only if it is named."""
    is_of_plant = PLANT in (sender, receiver)
    if is_of_plant and PLANT not in cut.between:
        return False
    return (sender in cut.between) != (receiver in cut.between)


def _delay(section: LinkSection, uniform: Array) -> float:
    """Return one delay, s, from two uniform numbers, (2,)."""
    if section.distribution == "empirical":
        samples_s = section.samples_s or [0.0]
        return samples_s[int(uniform[0] * len(samples_s))]
    if section.jitter_s == 0.0:
        return section.delay_s
    return max(0.0, section.delay_s + _jitter(section, uniform))


def _jitter(section: LinkSection, uniform: Array) -> float:
    """Return the random part of a delay, s."""
    first, second = uniform
    scale_s = section.jitter_s
    if section.distribution == "uniform":
        return float((first - 0.5) * scale_s)
    if section.distribution == "exponential":
        return float(-math.log(1.0 - first) * scale_s)

    # Box-Muller: one normal number from two uniform ones, n = sqrt(-2 ln(1 - a)) cos(2 pi b).
    normal = math.sqrt(-2.0 * math.log(1.0 - first)) * math.cos(2.0 * math.pi * second)
    if section.distribution == "normal":
        return normal * scale_s

    # Lognormal: the logarithm has unit variance, the delay then sqrt((e - 1) e).
    return math.exp(normal) * scale_s / math.sqrt((math.e - 1.0) * math.e)
