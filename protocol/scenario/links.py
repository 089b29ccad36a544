"""What the network does to messages: delay, jitter, loss, bursts, duplication, reordering, partitions.

Impairments act at the receiver, on messages, in scenario time. Every random number is drawn from a counter
(Philox) keyed by seed, sender, receiver, kind and the message's tick, so that what happens to a message does
not depend on when or in which order anything arrives.
"""

import hashlib
import json
import math
from bisect import insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.random import Generator, Philox
from pydantic import ValidationError

from model.arrays import Array
from protocol.scenario.schema import LinkOverrideSection, LinkSection, LinksSection
from protocol.wire.messages import LinkChange, MessageError

# Random numbers a message may need: loss, burst, jitter (two), duplicate, its jitter (two), reorder.
_DRAWS = 8
_LOSS, _BURST, _JITTER, _DUPLICATE, _ECHO, _REORDER = 0, 1, 2, 4, 5, 7

# Streams of them at each tick: of the burst chain, and of the message (and those of the negotiation before it).
_CHAIN, _MESSAGE = 2**32, 0

# A delay of decades is one without end, and can still be counted in ticks and nanoseconds.
_LONGEST_S = 1e9

# Rounding of a delay that is a whole number of sampling periods must not cost one more.
_SLACK = 1e-9


class LinkError(ValueError):
    """A change of links that is none; the text names the key, what was expected and what came."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkModel:
    """Impairments of one directed link.

    Attributes:
        delay_s: Fixed part of the delay.
        jitter_s: Scale of the random part: width (uniform), standard deviation (normal, lognormal), mean
            (exponential). The delay is never negative.
        distribution: Of the random part.
        samples_s: Measured delays that replace fixed and random part with distribution "empirical", sorted.
        loss: Probability that a message is lost, independent of the others.
        burst_enter, burst_leave: Gilbert-Elliott: probability per tick to enter and to leave the bad state.
        burst_loss: Probability of loss in the bad state.
        duplicate: Probability that a message arrives twice, each time with a delay of its own.
        reorder: Probability that a message is held back by `reorder_s` more.
        rate_hz: Messages per second of scenario time the link carries at most; those beyond are dropped.
        partitions: Intervals [start, end) of scenario time in which nothing sent gets through, s.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    distribution: str = "uniform"
    samples_s: tuple[float, ...] = ()
    loss: float = 0.0
    burst_enter: float = 0.0
    burst_leave: float = 1.0
    burst_loss: float = 1.0
    duplicate: float = 0.0
    reorder: float = 0.0
    reorder_s: float = 0.0
    rate_hz: float = math.inf
    partitions: tuple[tuple[float, float], ...] = ()

    @property
    def perfect(self) -> bool:
        """Whether every message arrives at once, once."""
        return self == _PERFECT


_PERFECT = LinkModel()


class Link:
    """One directed link of a run: decides the fate of each message.

    Args:
        model: Its impairments from the beginning.
        seed: Of the run.
        sender, receiver: Process names.
        kind: Message kind.
        period_s: Sampling period, s.
    """

    def __init__(self, model: LinkModel, *, seed: int, sender: str, receiver: str, kind: str, period_s: float) -> None:
        self.sender, self.receiver = sender, receiver
        self._models = [(0, model)]  # from which tick on
        self._changes: list[tuple[int, dict[str, Any]]] = []  # the same as they are asked for: fields of a model
        self._period_s = period_s
        digest = hashlib.sha256(f"{seed}/{sender}/{receiver}/{kind}".encode()).digest()
        self._key = np.frombuffer(digest[:16], dtype="<u8").copy()
        self._bad: list[bool] = []  # Gilbert-Elliott state by tick

    def change(self, tick: int, change: LinkOverrideSection, samples_s: Mapping[str, tuple[float, ...]]) -> None:
        """Treat the messages of a tick and later ones by the keys given, if they concern this link.

        Of changes of one key the one of the latest tick is in force, and of one tick the one told last.

        Args:
            tick: From which on.
            change: Ends and keys.
            samples_s: Measured delays by file name.
        """
        if change.covers(self.sender, self.receiver):
            fields = _fields(change, samples_s)
            given = {field: fields[field] for name in change.settings() for field in _FIELDS.get(name, (name,))}
            insort(self._changes, (tick, given), key=itemgetter(0))
            del self._models[1:]
            for start, changed in self._changes:
                self._models.append((start, replace(self._models[-1][1], **changed)))

    def model(self, tick: int) -> LinkModel:
        """The impairments in force for the message of a tick."""
        return next(model for start, model in reversed(self._models) if start <= tick)

    def delays(self, tick: int, negotiation: int = 0) -> list[float]:
        """Delays with which the message of a tick arrives, s: none if it is lost, two if it is duplicated.

        Args:
            tick: The message's.
            negotiation: 0 for the message a tick ends with; 1, 2, ... for those exchanged within it before.
        """
        model = self.model(tick)
        if model.perfect:
            return [0.0]
        sent_s = tick * self._period_s
        if any(start <= sent_s + _SLACK < end for start, end in model.partitions):
            return []
        if model.rate_hz < math.inf and not self._within_rate(tick, model.rate_hz):
            return []
        draw = self._draw(tick, stream=_MESSAGE + negotiation)
        if draw[_LOSS] < model.loss:
            return []
        if self._in_burst(tick) and draw[_BURST] < model.burst_loss:
            return []
        delays = [_delay(model, draw[_JITTER : _JITTER + 2])]
        if draw[_REORDER] < model.reorder:
            delays[0] += model.reorder_s
        if draw[_DUPLICATE] < model.duplicate:
            delays.append(_delay(model, draw[_ECHO : _ECHO + 2]))
        return [min(delay, _LONGEST_S) for delay in delays]

    def usable_ticks(self, tick: int, after: int = 1) -> list[int]:
        """Ticks from which the message of a tick can be used: the first at or after its arrival.

        Args:
            tick: The message's.
            after: Ticks that a message needs over a perfect link: 1 for what is used at the next tick.
        """
        return [max(tick + after, math.ceil(tick + delay / self._period_s - _SLACK)) for delay in self.delays(tick)]

    def _within_rate(self, tick: int, rate_hz: float) -> bool:
        """Whether a rate leaves room for the message of a tick: for as many of all ticks, evenly spread."""
        per_tick = rate_hz * self._period_s
        return tick == 0 or math.floor(tick * per_tick + _SLACK) > math.floor((tick - 1) * per_tick + _SLACK)

    def _draw(self, counter: int, stream: int) -> Array:
        """Uniform numbers in [0, 1) that belong to a counter, (8,)."""
        generator = Generator(Philox(key=self._key, counter=np.array([0, 0, stream, counter], dtype=np.uint64)))
        return generator.random(_DRAWS)

    def _in_burst(self, tick: int) -> bool:
        """State of the Gilbert-Elliott chain at a tick, from its beginning in the good state."""
        while len(self._bad) <= tick:
            k = len(self._bad)
            model = self.model(k)
            was_bad = self._bad[-1] if self._bad else False
            if model.burst_enter == 0.0 and not was_bad:
                self._bad.append(False)
                continue
            step = self._draw(k, stream=_CHAIN)[0]
            self._bad.append(bool(step >= model.burst_leave if was_bad else step < model.burst_enter))
        return self._bad[tick]


def link(
    section: LinksSection,
    sender: str,
    receiver: str,
    *,
    kind: str,
    seed: int,
    period_s: float,
    samples_s: Mapping[str, tuple[float, ...]],
) -> Link:
    """One directed link of a scenario: the general keys, the last override that names it, partitions, changes.

    Args:
        section: Links of the scenario.
        sender: Process name.
        receiver: Process name.
        kind: Message kind.
        seed: Of the run.
        period_s: Sampling period, s.
        samples_s: Measured delays by file name.
    """
    chosen: LinkSection = section
    if sender == "plant":
        chosen = section.measurement
    elif receiver == "plant":
        chosen = section.actuation
    for override in section.override:
        if override.covers(sender, receiver):
            chosen = override
    # A partition concerns the plant only when it says so.
    partitions = [
        (p.start_s, p.end_s)
        for p in section.partition
        if (sender in p.between) != (receiver in p.between)
        and ("plant" in p.between or "plant" not in (sender, receiver))
    ]
    found = Link(
        LinkModel(**_fields(chosen, samples_s), partitions=tuple(partitions)),
        seed=seed,
        sender=sender,
        receiver=receiver,
        kind=kind,
        period_s=period_s,
    )
    for change in sorted(section.change, key=lambda change: change.at_s):
        found.change(math.ceil(change.at_s / period_s - _SLACK), change, samples_s)
    return found


class LinkChanges:
    """Changes of links in flight, each applied once and in order.

    Args:
        links: The links of one receiver.
        samples_s: Measured delays by file name.
    """

    def __init__(self, links: Iterable[Link], samples_s: Mapping[str, tuple[float, ...]]) -> None:
        self._links, self._samples_s = tuple(links), samples_s
        self._applied = 0

    def apply(self, message: LinkChange) -> None:
        """Apply a change, unless it is told again for somebody who has just joined.

        Raises: MessageError: it is none, or not the next one.
        """
        if message.number > self._applied + 1:
            raise MessageError("future", f"change {message.number} of the links after {self._applied}")
        if message.number == self._applied + 1:
            change = told_change(message, self._samples_s)
            self._applied += 1
            for link in self._links:
                link.change(message.tick, change, self._samples_s)


def told_change(message: LinkChange, samples_s: Mapping[str, tuple[float, ...]]) -> LinkOverrideSection:
    """The change of links in a message.

    Args:
        message: What the coordinator says.
        samples_s: Measured delays by file name.
    Raises: MessageError: it is no change that can be applied.
    """
    try:
        change = link_change(message.source, message.target, message.settings)
    except LinkError as error:
        raise MessageError("out_of_range", str(error)) from error
    if change.samples is not None and change.samples not in samples_s:
        raise MessageError("out_of_range", f"samples: expected a file that the scenario names, got {change.samples!r}")
    return change


def link_change(source: str, target: str, settings: str) -> LinkOverrideSection:
    """A change of links from its text.

    Args:
        source: Process name, empty for any agent.
        target: Process name, empty for any agent.
        settings: Keys of a link and their new values, a JSON object.
    Raises: LinkError: it is none.
    """
    try:
        given = json.loads(settings)
    except (ValueError, RecursionError) as error:
        raise LinkError(f"expected a JSON object of a link's keys, got {settings[:60]!r}") from error
    if not isinstance(given, dict):
        raise LinkError(f"expected a JSON object of a link's keys, got {settings[:60]!r}")
    ends = {key: name for key, name in (("from", source), ("to", target)) if name}
    try:
        change = LinkOverrideSection.model_validate({**given, **ends})
    except ValidationError as error:
        raise LinkError(" ".join(str(error).split())[:200]) from error
    if (change.samples is not None) != (change.distribution == "empirical"):
        raise LinkError(
            f"samples: expected a file with distribution empirical and with no other, got {change.samples!r}"
        )
    return change


# Fields of a model that a key of a section decides, where they are not called the same.
_FIELDS = {
    "gilbert_elliott": ("burst_enter", "burst_leave", "burst_loss"),
    "samples": ("samples_s",),
    "distribution": ("distribution", "samples_s"),
}


def _fields(section: LinkSection, samples_s: Mapping[str, tuple[float, ...]]) -> dict[str, Any]:
    """A section of a scenario as the fields of a `LinkModel`."""
    bursts = section.gilbert_elliott
    return {
        "delay_s": section.delay_s,
        "jitter_s": section.jitter_s,
        "distribution": section.distribution,
        "samples_s": samples_s[section.samples] if section.distribution == "empirical" and section.samples else (),
        "loss": section.loss,
        "burst_enter": bursts.enter if bursts else 0.0,
        "burst_leave": bursts.leave if bursts else 1.0,
        "burst_loss": bursts.loss if bursts else 1.0,
        "duplicate": section.duplicate,
        "reorder": section.reorder,
        "reorder_s": section.reorder_s,
        "rate_hz": math.inf if section.rate_hz is None else section.rate_hz,
    }


def _delay(model: LinkModel, uniform: Array) -> float:
    """One delay, s, from two uniform numbers."""
    if model.distribution == "empirical":
        return model.samples_s[int(uniform[0] * len(model.samples_s))]
    if model.jitter_s == 0.0:
        return model.delay_s
    # Box-Muller: one normal number from two uniform ones.
    normal = math.sqrt(-2.0 * math.log(1.0 - uniform[0])) * math.cos(2.0 * math.pi * uniform[1])
    random: float = {
        "uniform": (uniform[0] - 0.5) * model.jitter_s,
        "normal": normal * model.jitter_s,
        "exponential": -math.log(1.0 - uniform[0]) * model.jitter_s,
        "lognormal": _lognormal(normal, model.jitter_s),
    }[model.distribution]
    return max(0.0, model.delay_s + random)


def _lognormal(normal: float, deviation: float) -> float:
    """A lognormal number whose logarithm has unit variance, scaled to the standard deviation asked for."""
    return math.exp(normal) * deviation / math.sqrt((math.e - 1.0) * math.e)
