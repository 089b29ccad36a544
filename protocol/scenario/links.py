"""Impairments of the network, which act at the receiver, in scenario time.

Random numbers come from a counter keyed by seed, link and tick: they do not depend on the order of
    arrivals.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.random import Generator, Philox

from transport.model.arrays import Array
from transport.protocol.scenario.errors import RequestError, requested
from transport.protocol.scenario.keys import UNITS
from transport.protocol.scenario.link_sections import LinkOverrideSection, LinkSection, LinksSection
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import LinkChange, Measurement, Plan
from transport.protocol.wire.names import PLANT

Key = npt.NDArray[np.uint64]


def draw_key(*purpose: object) -> Key:
    """Return the key of an independent stream of random numbers, for the seed of a run and a purpose, (2,) uint64."""
    digest = hashlib.sha256("/".join(map(str, purpose)).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8")


def generator(key: Key, tick: int, stream: int = 0) -> Generator:
    """Return the generator that belongs to a key, a tick and one of the streams of that tick."""
    return Generator(Philox(key=key, counter=np.array([0, 0, stream, tick], dtype=np.uint64)))


# Uniform numbers drawn for each message, by their first use; jitter takes two. A new one goes to
# the end.
_LOSS, _BURST, _JITTER, _DUPLICATE, _ECHO, _REORDER, _DRAWS = 0, 1, 2, 4, 5, 7, 8
_CHAIN = (
    2**32
)  # stream of the burst chain at each tick; those of the message and the negotiation are 0, 1, ...
_SLACK = (
    1e-9  # rounding of a delay that is a whole number of sampling periods must not cost one more
)
*_, _LONGEST_S = UNITS["_s"]  # longest delay: that of a key in seconds
# Settings of a link that make it perfect: the defaults.
PERFECT: Mapping[str, Any] = {key: field.default for key, field in LinkSection.model_fields.items()}


class Link:
    """One link of a run: which messages arrive, and when."""

    def __init__(
        self, links: LinksSection, sender: str, receiver: str, *, seed: int, period_s: float
    ) -> None:
        self.sender, self.receiver = sender, receiver
        chosen: LinkSection = links
        if PLANT in (sender, receiver):
            chosen = links.measurement if sender == PLANT else links.actuation
        for override in links.override:
            if override.covers(sender, receiver):
                chosen = override
        # First tick, impairments from then on, and whether they are none: asked for with every
        # message.
        self._sections = [(0, chosen, chosen.perfect)]
        self._changes: list[tuple[int, dict[str, Any]]] = []  # first tick, keys given
        self._period_s = period_s
        # A partition concerns the plant only if it names it.
        cuts = [p for p in links.partition if PLANT in p.between or PLANT not in (sender, receiver)]
        self._partitions = [
            (p.start_s, p.end_s) for p in cuts if (sender in p.between) != (receiver in p.between)
        ]
        self._key = draw_key(
            seed, sender, receiver, (Measurement if sender == PLANT else Plan).kind
        )
        self._bad: list[bool] = []  # Gilbert-Elliott state by tick
        for change in sorted(links.change, key=lambda change: change.at_s):
            self.change(math.ceil(change.at_s / period_s - _SLACK), change)

    def change(self, tick: int, change: LinkOverrideSection) -> None:
        """Apply the given keys from a tick on, if the change covers this link.

        The latest change is in force.
        """
        if change.covers(self.sender, self.receiver):
            given = {
                key: getattr(change, key)
                for key in change.model_fields_set & LinkSection.model_fields.keys()
            }
            self._changes = sorted([*self._changes, (tick, given)], key=itemgetter(0))
            del self._sections[1:]
            for start, keys in self._changes:
                section = self._sections[-1][1].model_copy(update=keys)
                self._sections.append((start, section, section.perfect))

    def impairments(self, tick: int) -> LinkSection:
        """Return the impairments in force for the message of a tick."""
        return self._in_force(tick)[0]

    def delays(self, tick: int, negotiation: int = 0) -> list[float]:
        """Return the delays of a tick's message, s.

        None if lost, two if duplicated; proposals count from 1.
        """
        section, perfect = self._in_force(tick)
        sent_s = tick * self._period_s
        if any(start <= sent_s + _SLACK < end for start, end in self._partitions):
            return []
        if perfect:
            return [0.0]
        if section.rate_hz is not None and tick > 0:
            per_tick = (
                section.rate_hz * self._period_s
            )  # the messages that the rate leaves room for are evenly spread
            if math.floor(tick * per_tick + _SLACK) == math.floor((tick - 1) * per_tick + _SLACK):
                return []
        draw, bursts = (
            generator(self._key, tick, negotiation).random(_DRAWS),
            section.gilbert_elliott,
        )
        if draw[_LOSS] < section.loss or (
            self._in_burst(tick) and bursts and draw[_BURST] < bursts.loss
        ):
            return []
        delays = [self._delay(section, draw[_JITTER : _JITTER + 2])]
        if draw[_REORDER] < section.reorder:
            delays[0] += section.reorder_s
        if draw[_DUPLICATE] < section.duplicate:
            delays.append(self._delay(section, draw[_ECHO : _ECHO + 2]))
        return [min(delay, _LONGEST_S) for delay in delays]

    def usable_ticks(self, tick: int, after: int = 1) -> list[int]:
        """Return the ticks from which the message of a tick can be used.

        At or after its arrival, and `after` ticks.
        """
        if not self._partitions and self._in_force(tick)[1]:
            return [tick + after]
        return [
            max(tick + after, math.ceil(tick + delay / self._period_s - _SLACK))
            for delay in self.delays(tick)
        ]

    def _in_force(self, tick: int) -> tuple[LinkSection, bool]:
        return next(
            (section, perfect)
            for start, section, perfect in reversed(self._sections)
            if start <= tick
        )

    def _in_burst(self, tick: int) -> bool:
        """Return whether the Gilbert-Elliott chain, which starts in the good state, is in the bad one at a tick."""
        for k in range(len(self._bad), tick + 1):
            was_bad, bursts = k > 0 and self._bad[-1], self.impairments(k).gilbert_elliott
            if bursts is None or not (was_bad or bursts.enter):
                self._bad.append(False)
            else:
                draw = generator(self._key, k, _CHAIN).random()
                self._bad.append(draw >= bursts.leave if was_bad else draw < bursts.enter)
        return self._bad[tick]

    def _delay(self, section: LinkSection, uniform: Array) -> float:
        """Return one delay, s, from two uniform numbers."""
        if section.distribution == "empirical":
            samples_s = section.samples or [0.0]
            return samples_s[int(uniform[0] * len(samples_s))]
        if section.jitter_s == 0.0:
            return section.delay_s
        # Box-Muller: one normal number from two uniform ones.
        normal = math.sqrt(-2.0 * math.log(1.0 - uniform[0])) * math.cos(2.0 * math.pi * uniform[1])
        random: float = {
            "uniform": (uniform[0] - 0.5) * section.jitter_s,
            "normal": normal * section.jitter_s,
            "exponential": -math.log(1.0 - uniform[0]) * section.jitter_s,
            # Its logarithm has unit variance; scaled to the standard deviation asked for.
            "lognormal": math.exp(normal) * section.jitter_s / math.sqrt((math.e - 1.0) * math.e),
        }[section.distribution]
        return max(0.0, section.delay_s + random)


class LinkChanges:
    """Changes of the links of one receiver during a run, each applied once and in order."""

    def __init__(self, links: Iterable[Link]) -> None:
        self._links, self._applied = tuple(links), 0

    def check(self, message: LinkChange) -> LinkOverrideSection:
        """Return a change. Raises.

        MessageError: it is invalid, or neither the next one nor one that is repeated.
        """
        if message.number > self._applied + 1:
            raise MessageError(
                "future", f"change {message.number} of the links after {self._applied}"
            )
        return link_change(message.source, message.target, message.settings)

    def apply(self, message: LinkChange) -> None:
        """Apply a change, unless it was repeated for a process that has just joined."""
        if message.number == self._applied + 1:
            change = self.check(message)
            self._applied += 1
            for link in self._links:
                link.change(message.tick, change)


def link_change(source: str, target: str, settings: str) -> LinkOverrideSection:
    """Return a change of links.

    Ends, empty for any agent, and a JSON object of keys. Raises: RequestError: invalid.
    """
    try:
        given = json.loads(settings)
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict):
        raise RequestError(f"expected a JSON object of a link's keys, got {settings[:60]!r}")
    ends = {key: name for key, name in (("from", source), ("to", target)) if name}
    return requested(LinkOverrideSection, {**given, **ends})


def words_of(change: LinkChange) -> str:
    """Return the change in a message of the coordinator in words.

    Its text as it is if it is no valid change.
    """
    try:
        settings = link_change(change.source, change.target, change.settings).settings()
    except RequestError:
        return f"links: {change.settings}"
    return change_in_words(change.source, change.target, settings)


def change_in_words(source: str, target: str, settings: Mapping[str, Any]) -> str:
    """Return a change in words, such as "links from agent1 to agent2.

    Delay_s 0.2, loss 0.3"; "" is any agent.
    """
    ends = (f" from {source}" if source else "") + (f" to {target}" if target else "")
    links = f"links{ends or ' between agents'}"
    if PERFECT.items() <= settings.items():
        return f"{links} cleared"
    return f"{links}: {', '.join(f'{key} {value!s:.40}' for key, value in settings.items())}"
