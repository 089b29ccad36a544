"""What a log lacks that was said: messages that did not reach the recorder, told by the numbers of those that did."""

from collections.abc import Iterator
from itertools import pairwise

from protocol.wire.keys import RECORDER
from protocol.wire.messages import Control, Measurement, Message, Plan, PlantState, Rejected, StepReport
from transport.log.run_log import RunLog

# Reason of a run whose end was not recorded.
UNHEARD = "how the run ended did not reach the recorder"


def missing(log: RunLog) -> str:
    """Of which ticks messages are missing between those there are, in a sentence; empty when none is.

    Every process numbers what it says, so whatever is missing in between shows; the last words of one that was killed
    do not, and need not have been said. That the plant flew on shows in what agents and coordinator say of it.

    Args:
        log: All of it.
    """
    merged: list[tuple[int, int]] = []
    for first, last in sorted([*_holes(log), *_unrecorded_end(log)]):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = merged[-1][0], max(last, merged[-1][1])
        else:
            merged.append((first, last))
    lacking = []
    if merged:
        ticks = ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in merged)
        lacking.append(f"some messages of ticks {ticks}")
    if any(control.reason == UNHEARD for control in log.of(Control)):
        lacking.append(f"the rest of the run after tick {max(entry.message.tick for entry in log.messages)}")
    return f"{' and '.join(lacking)} did not reach the recorder" if lacking else ""


def _holes(log: RunLog) -> Iterator[tuple[int, int]]:
    """First and last tick of what is missing between two messages of a process, or before its first."""
    said: dict[tuple[str, int], dict[int, int]] = {}  # ticks by number, of each start of a process
    for message in (entry.message for entry in log.messages):
        # What a recorder notes reaches itself; refusals have numbers of their own.
        if message.sender != RECORDER and not isinstance(message, Rejected):
            said.setdefault((message.sender, message.incarnation), {})[message.sequence] = message.tick
    for ticks in said.values():
        numbers = sorted(ticks)
        if numbers[0] > 0:
            yield 0, ticks[numbers[0]]
        for before, after in pairwise(numbers):
            if after > before + 1:
                yield min(ticks[before], ticks[after]), max(ticks[before], ticks[after])


def _unrecorded_end(log: RunLog) -> Iterator[tuple[int, int]]:
    """First and last tick that the plant has flown after the last one it is heard of, if there are any."""
    recorded = max((plant_state.tick for plant_state in log.of(PlantState)), default=-1)
    flown = -1
    for message in (entry.message for entry in log.messages):
        flown = max(flown, _flown(message))
    if flown > recorded:
        yield recorded + 1, flown


def _flown(message: Message) -> int:
    """The last tick whose truth has been said before a message, -1 for none."""
    match message:
        case Measurement() | Plan() | StepReport():
            return message.tick - 1  # the plant measures at a tick when it has flown the one before
        case Control(outcome="completed", sender="coordinator"):
            return message.tick
    return -1
