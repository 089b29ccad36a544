"""The reception: each message is checked, handled or counted, the same in every receiver."""

from dataclasses import replace

import pytest

from protocol.admission.reception import Reception
from protocol.wire.messages import LinkChange, Message, MessageError
from tests.support import runs
from tests.support.runs import setup
from tests.support.samples import sample

NEWEST_TICK = 5
WINDOW = 1  # in lockstep


def reception(handled: list[Message], newest_tick: int | None = NEWEST_TICK) -> Reception:
    """A reception whose handler keeps what it gets."""
    return Reception(setup(), lambda message, _: handled.append(message), lambda: newest_tick)


def reasons(receiver: Reception) -> list[str]:
    """Reasons of the refused messages."""
    return [entry.reason for entry in receiver.rejected]


def test_a_plausible_message_is_handled_at_its_time() -> None:
    """The handler gets the message and the time at which it was received."""
    handled: list[tuple[Message, int]] = []
    receiver = Reception(setup(), lambda message, now_ns: handled.append((message, now_ns)))
    assert receiver.receive(runs.tick(3), 7)
    assert (handled, receiver.rejected.total) == ([(runs.tick(3), 7)], 0)


def test_an_implausible_message_is_counted_and_not_handled() -> None:
    """A message that does not fit the run never reaches the handler."""
    handled: list[Message] = []
    receiver = reception(handled)
    assert not receiver.receive(runs.tick(setup().ticks), 0)
    assert (handled, reasons(receiver)) == ([], ["future"])


def test_a_message_that_the_handler_refuses_is_counted_under_its_sender() -> None:
    """The handler's own refusals are counted like the reception's."""

    def refuse(message: Message, _: int) -> None:
        raise MessageError("past", f"{message.kind} is over")

    receiver = Reception(setup(), refuse)
    assert not receiver.receive(runs.tick(0), 0)
    (entry,) = receiver.rejected
    assert (entry.sender, entry.reason, entry.count, entry.example) == ("coordinator", "past", 1, "tick is over")


@pytest.mark.parametrize(
    ("tick", "reason"),
    [
        (NEWEST_TICK - WINDOW - 1, "past"),
        (NEWEST_TICK - WINDOW, None),
        (NEWEST_TICK + 1 + WINDOW, None),
        (NEWEST_TICK + 1 + WINDOW + 1, "future"),
    ],
)
def test_messages_of_the_coordinator_are_of_about_now(tick: int, reason: str | None) -> None:
    """Roster and end of the run are refused outside the window around the newest tick, if that is known."""
    for message in (replace(runs.roster(), tick=tick), runs.end(tick)):
        receiver, late_joiner = reception([]), reception([], newest_tick=None)
        assert receiver.receive(message, 0) == (reason is None)
        assert reasons(receiver) == ([] if reason is None else [reason])
        assert late_joiner.receive(message, 0)


def test_link_changes_of_any_past_tick_are_accepted() -> None:
    """The coordinator repeats all link changes when an agent joins; those of the future are refused."""
    receiver = reception([])
    assert receiver.receive(sample(LinkChange, tick=0), 0)
    assert not receiver.receive(sample(LinkChange, tick=NEWEST_TICK + 1 + WINDOW + 1), 0)
    assert reasons(receiver) == ["future"]
