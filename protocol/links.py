"""What the network does to messages: delay, jitter, loss, bursts, duplication, reordering, partitions.

Impairments act at the receiver, on messages, in scenario time. Every random number is drawn from a counter
(Philox) keyed by seed, sender, receiver, kind and the message's tick, so that what happens to a message does
not depend on when or in which order anything arrives.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator, Philox

from model.arrays import Array
from protocol.scenario import LinkSection, LinksSection

# Random numbers a message may need: loss, burst, jitter (two), duplicate, its jitter (two), reorder.
_DRAWS = 8
_LOSS, _BURST, _JITTER, _DUPLICATE, _ECHO, _REORDER = 0, 1, 2, 4, 5, 7

# Rounding of a delay that is a whole number of sampling periods must not cost one more.
_SLACK = 1e-9


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
    partitions: tuple[tuple[float, float], ...] = ()

    @property
    def perfect(self) -> bool:
        """Whether every message arrives at once, once."""
        return self == LinkModel()


class Link:
    """One directed link of a run: decides the fate of each message.

    Args:
        model: Its impairments.
        seed: Of the run.
        sender, receiver: Process names.
        kind: Message kind.
        period_s: Sampling period, s.
    """

    def __init__(self, model: LinkModel, *, seed: int, sender: str, receiver: str, kind: str, period_s: float) -> None:
        self.model = model
        self._period_s = period_s
        digest = hashlib.sha256(f"{seed}/{sender}/{receiver}/{kind}".encode()).digest()
        self._key = np.frombuffer(digest[:16], dtype="<u8").copy()
        self._bad: list[bool] = []  # Gilbert-Elliott state by tick

    def delays(self, tick: int) -> list[float]:
        """Delays with which the message of a tick arrives, s: none if it is lost, two if it is duplicated."""
        model = self.model
        if model.perfect:
            return [0.0]
        sent_s = tick * self._period_s
        if any(start <= sent_s + _SLACK < end for start, end in model.partitions):
            return []
        draw = self._draw(tick)
        if draw[_LOSS] < model.loss:
            return []
        if model.burst_enter > 0.0 and self._in_burst(tick) and draw[_BURST] < model.burst_loss:
            return []
        delays = [self._delay(draw[_JITTER : _JITTER + 2])]
        if draw[_REORDER] < model.reorder:
            delays[0] += model.reorder_s
        if draw[_DUPLICATE] < model.duplicate:
            delays.append(self._delay(draw[_ECHO : _ECHO + 2]))
        return delays

    def usable_ticks(self, tick: int) -> list[int]:
        """Ticks from which the message of a tick can be used: the first later one at or after its arrival."""
        return [max(tick + 1, math.ceil(tick + delay / self._period_s - _SLACK)) for delay in self.delays(tick)]

    def _draw(self, counter: int, stream: int = 0) -> Array:
        """Uniform numbers in [0, 1) that belong to a counter, (8,)."""
        generator = Generator(Philox(key=self._key, counter=np.array([0, 0, stream, counter], dtype=np.uint64)))
        return generator.random(_DRAWS)

    def _delay(self, uniform: Array) -> float:
        model = self.model
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

    def _in_burst(self, tick: int) -> bool:
        """State of the Gilbert-Elliott chain at a tick, from its beginning in the good state."""
        while len(self._bad) <= tick:
            k = len(self._bad)
            was_bad = self._bad[-1] if self._bad else False
            step = self._draw(k, stream=1)[0]
            self._bad.append(step >= self.model.burst_leave if was_bad else step < self.model.burst_enter)
        return self._bad[tick]


def link_model(
    section: LinksSection, sender: str, receiver: str, samples_s: Mapping[str, tuple[float, ...]]
) -> LinkModel:
    """Impairments of one directed link of a scenario: the general ones, the last override that names it, partitions.

    Args:
        section: Links of the scenario.
        sender: Process name.
        receiver: Process name.
        samples_s: Measured delays by file name.
    """
    chosen: LinkSection = section
    for override in section.override:
        if override.from_ in (None, sender) and override.to in (None, receiver):
            chosen = override
    bursts = chosen.gilbert_elliott
    return LinkModel(
        delay_s=chosen.delay_s,
        jitter_s=chosen.jitter_s,
        distribution=chosen.distribution,
        samples_s=samples_s[chosen.samples] if chosen.distribution == "empirical" and chosen.samples else (),
        loss=chosen.loss,
        burst_enter=bursts.enter if bursts else 0.0,
        burst_leave=bursts.leave if bursts else 1.0,
        burst_loss=bursts.loss if bursts else 1.0,
        duplicate=chosen.duplicate,
        reorder=chosen.reorder,
        reorder_s=chosen.reorder_s,
        partitions=tuple(
            (p.start_s, p.end_s) for p in section.partition if (sender in p.between) != (receiver in p.between)
        ),
    )


def _lognormal(normal: float, deviation: float) -> float:
    """A lognormal number whose logarithm has unit variance, scaled to the standard deviation asked for."""
    return math.exp(normal) * deviation / math.sqrt((math.e - 1.0) * math.e)
