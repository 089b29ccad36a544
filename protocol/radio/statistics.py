"""Numbers of a channel over a run: airtime, delivered share, delays and losses by link."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from transport.protocol.radio.channel import ChannelCounts
from transport.protocol.radio.frames import Outcome, Result

_NS_PER_MS = 1e6
_QUANTILES = (50.0, 99.0)

Link = tuple[int, int]  # sender, receiver


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """What became of the frames of one link, or of all."""

    frames: int
    delivered: int
    lost: Mapping[Result, int]
    delay_p50_ms: (
        float | None
    )  # of delivered frames, from the send to the arrival; None without any
    delay_p99_ms: float | None

    @property
    def delivered_share(self) -> float | None:
        """Delivered frames over all, 0 to 1; None without any."""
        return self.delivered / self.frames if self.frames else None


@dataclass(slots=True)
class ChannelStatistics:
    """Collects outcomes and counts."""

    results: dict[Link, Counter[Result]] = field(default_factory=lambda: defaultdict(Counter))
    delays_ns: dict[Link, list[int]] = field(default_factory=lambda: defaultdict(list))
    counts: ChannelCounts = field(default_factory=ChannelCounts)

    def add(self, outcomes: Iterable[Outcome], counts: ChannelCounts) -> None:
        """Add a window of time."""
        for outcome in outcomes:
            link = (outcome.frame.sender, outcome.receiver)
            self.results[link][outcome.result] += 1
            if outcome.result is Result.DELIVERED:
                self.delays_ns[link].append(outcome.delay_ns)
        self.counts.transmissions += counts.transmissions
        self.counts.repetitions += counts.repetitions
        self.counts.acknowledgements += counts.acknowledgements
        self.counts.busy_ns += counts.busy_ns

    def airtime_share(self, duration_ns: int) -> float:
        """Return the share of a time in which at least one station transmitted, 0 to 1."""
        return self.counts.busy_ns / duration_ns

    def link(self, link: Link) -> LinkStatistics:
        """Return the numbers of one link."""
        return _statistics(self.results[link], self.delays_ns[link])

    def all_links(self) -> LinkStatistics:
        """Return the numbers of all links together."""
        results: Counter[Result] = Counter()
        for counted in self.results.values():
            results.update(counted)
        return _statistics(
            results, [delay for delays in self.delays_ns.values() for delay in delays]
        )


def _statistics(results: Counter[Result], delays_ns: list[int]) -> LinkStatistics:
    p50_ms: float | None = None
    p99_ms: float | None = None
    if delays_ns:
        p50_ms, p99_ms = (
            float(value) for value in np.percentile(delays_ns, _QUANTILES) / _NS_PER_MS
        )
    return LinkStatistics(
        frames=results.total(),
        delivered=results[Result.DELIVERED],
        lost={
            result: count
            for result, count in sorted(results.items())
            if result is not Result.DELIVERED
        },
        delay_p50_ms=p50_ms,
        delay_p99_ms=p99_ms,
    )
