"""Length that a slot needs: the time that a station occupies the channel with one message."""

from collections.abc import Sequence

from transport.protocol.radio.standards_80211 import MESSAGE_BYTES, Standard


def frame_lengths(message_bytes: int) -> list[int]:
    """Return the lengths of the frames that carry a message, bytes."""
    full, rest = divmod(message_bytes, MESSAGE_BYTES)
    return [MESSAGE_BYTES] * full + [rest] * (rest > 0)


def occupied_ns(
    lengths: Sequence[int], standard: Standard, rate_mbps: float, *, receivers: int | None = None
) -> int:
    """Return the longest time that a message occupies a channel that is otherwise idle, ns.

    The first frame waits for DIFS, each further one for the longest first backoff behind it. Frames
    that are repeated because they were lost come on top.

    Args:
        lengths: Bytes of the frames of the message, without headers.
        standard: Timing of the channel.
        rate_mbps: Rate of the frames.
        receivers: With unicast, stations that get the message one after the other; None: broadcast.
    """
    copies = 1 if receivers is None else receivers
    frames = copies * len(lengths)
    backoffs_ns = (frames - 1) * standard.cw_min * standard.slot_ns
    waits_ns = frames * standard.difs_ns + backoffs_ns
    airtime_ns = copies * sum(
        [standard.message_airtime_ns(length, rate_mbps) for length in lengths]
    )
    if receivers is None:
        return waits_ns + airtime_ns

    acknowledgement_ns = standard.sifs_ns + standard.acknowledgement_airtime_ns(rate_mbps)
    return waits_ns + airtime_ns + frames * acknowledgement_ns


def fewest_periods(stations: int, spread_ns: int, slot_ns: int) -> int:
    """Return the fewest periods in which every station has a slot that is long enough.

    Args:
        stations: Number of stations.
        spread_ns: Time that the slots of a period share.
        slot_ns: Length that a slot needs. If it exceeds `spread_ns`, each station has a period.
    """
    slots_of_period = max(spread_ns // slot_ns, 1)
    return -(-stations // slots_of_period)
