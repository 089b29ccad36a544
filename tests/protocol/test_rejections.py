"""Refused messages are counted by sender and reason, within bounds, and reported now and then."""

from typing import get_args

import pytest

from protocol.wire.codec import decode, encode
from protocol.wire.messages import MAX_TEXT, MessageError, Reason
from protocol.wire.rejections import MAX_SENDERS, OTHERS, Notices, Rejection, Rejections

SECOND_NS = 10**9


def past(text: str = "over") -> MessageError:
    """Some refusal."""
    return MessageError("past", text)


def test_counts_by_sender_and_reason() -> None:
    """Each sender and reason has a count of its own, and the text of the first message as an example."""
    rejections = Rejections()
    rejections.add("agent1", past("first"))
    rejections.add("agent2", past("second"))
    rejections.add("agent1", past("third"))
    rejections.add("agent1", MessageError("future", "fourth"))
    assert list(rejections) == [
        Rejection("agent1", "past", 2, "first"),
        Rejection("agent2", "past", 1, "second"),
        Rejection("agent1", "future", 1, "fourth"),
    ]
    assert rejections.total == 4


def test_nothing_at_first() -> None:
    """Without refusals there is nothing to count and nothing to report."""
    rejections = Rejections()
    assert (rejections.total, list(rejections), list(rejections.news())) == (0, [], [])
    notices = Notices("plant", rejections)
    assert notices.due(0, 0, 0) == notices.rest(0, 0) == []


def test_senders_are_bounded() -> None:
    """A flood of invented senders is counted under one name; senders known before stay separate."""
    rejections = Rejections()
    for i in range(10 * MAX_SENDERS):
        for reason in get_args(Reason):
            rejections.add(f"plan/{i}", MessageError(reason, "x"))
    rejections.add("plan/3", past())
    entries = list(rejections)
    assert len({entry.sender for entry in entries}) == MAX_SENDERS + 1
    assert len(entries) == (MAX_SENDERS + 1) * len(get_args(Reason))
    assert sum(entry.count for entry in entries) == rejections.total == 10 * MAX_SENDERS * len(get_args(Reason)) + 1
    counts = {(entry.sender, entry.reason): entry.count for entry in entries}
    assert counts["plan/3", "past"] == 2
    assert counts[OTHERS, "past"] == 9 * MAX_SENDERS


@pytest.mark.parametrize("length", [10, 80, 81, 60_000])
def test_texts_are_bounded(length: int) -> None:
    """A key or a text of any length is cut to what can be sent."""
    rejections = Rejections()
    rejections.add("k" * length, past("t" * length))
    (entry,) = rejections
    assert entry.sender == ("k" * length)[:80]
    assert entry.example == ("t" * length)[:MAX_TEXT]
    (notice,) = Notices("plant", rejections).rest(0, 0)
    assert decode(encode(notice)) == notice


def test_news_are_told_once() -> None:
    """Each refusal is reported once; the example stays that of the first."""
    rejections = Rejections()
    rejections.add("agent1", past("first"))
    assert list(rejections.news()) == [Rejection("agent1", "past", 1, "first")]
    assert list(rejections.news()) == []
    rejections.add("agent2", past("other"))
    rejections.add("agent1", past("second"))
    rejections.add("agent1", past("third"))
    assert list(rejections.news()) == [Rejection("agent1", "past", 2, "first"), Rejection("agent2", "past", 1, "other")]


def test_notices_come_once_a_second() -> None:
    """The first refusals are reported at once, later ones at least a second after, the rest at the end."""
    rejections = Rejections()
    notices = Notices("agent2", rejections)
    told = []
    for i in range(26):
        rejections.add("plan/3", past())
        told += [(i, notice.count) for notice in notices.due(i * SECOND_NS // 10, 4, i)]
    assert told == [(0, 1), (10, 10), (20, 10)]
    (rest,) = notices.rest(4, 99)
    assert (rest.sender, rest.incarnation, rest.tick, rest.sequence) == ("agent2", 4, 99, 3)
    assert (rest.offender, rest.reason, rest.count, rest.example) == ("plan/3", "past", 5, "over")
    assert notices.rest(4, 99) == []


def test_no_notice_without_news() -> None:
    """Without new refusals nothing is reported."""
    rejections = Rejections()
    notices = Notices("agent2", rejections)
    rejections.add("plan/3", past())
    assert len(notices.due(0, 0, 0)) == 1
    assert notices.due(100 * SECOND_NS, 0, 0) == []


def test_notices_are_numbered() -> None:
    """`Rejected` messages have sequence numbers of their own, from 0."""
    rejections = Rejections()
    notices = Notices("agent2", rejections)
    sequences = []
    for i in range(3):
        for j in range(i + 1):
            rejections.add(f"agent{j + 5}", past())
        sequences += [notice.sequence for notice in notices.rest(0, 0)]
    assert sequences == [0, 1, 2, 3, 4, 5]
