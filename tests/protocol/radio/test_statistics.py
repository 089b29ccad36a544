"""Statistics of a channel: counts and quantiles of what was added."""

from transport.protocol.radio.channel import ChannelCounts
from transport.protocol.radio.frames import Frame, Outcome, Result
from transport.protocol.radio.statistics import ChannelStatistics

MS = 1_000_000


def test_links_and_all_links() -> None:
    """Each link has its own share and quantiles, and all links are their sum."""
    statistics = ChannelStatistics()
    frames = [Frame(0, 0, sequence, 100, (1, 2)) for sequence in range(3)]
    statistics.add(
        [
            Outcome(frames[0], 1, Result.DELIVERED, 2 * MS),
            Outcome(frames[1], 1, Result.DELIVERED, 4 * MS),
            Outcome(frames[2], 1, Result.QUEUE, MS),
            Outcome(frames[0], 2, Result.COLLISION, 2 * MS),
        ],
        ChannelCounts(transmissions=2, busy_ns=3 * MS),
    )
    statistics.add([], ChannelCounts(transmissions=1, repetitions=1, busy_ns=MS))

    link = statistics.link((0, 1))
    assert (link.frames, link.delivered, link.delay_p50_ms) == (3, 2, 3.0)
    assert link.lost == {Result.QUEUE: 1}
    lost = statistics.link((0, 2))
    assert (lost.delivered_share, lost.delay_p50_ms) == (0.0, None)
    everything = statistics.all_links()
    assert (everything.frames, everything.delivered) == (4, 2)
    assert statistics.counts.transmissions == 3
    assert statistics.airtime_share(8 * MS) == 0.5


def test_nothing_sent_has_no_share() -> None:
    """A channel without frames delivered no share, neither all nor none."""
    assert ChannelStatistics().all_links().delivered_share is None
