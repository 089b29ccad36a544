"""Messages missing from a log, found by gaps in the sequence numbers of each sender."""

from collections.abc import Iterable, Iterator
from itertools import pairwise

from protocol.wire.keys import RECORDER
from protocol.wire.messages import Control, Measurement, Message, Plan, PlantState, Rejected, StepReport
from protocol.wire.names import COORDINATOR
from transport.log.run_log import RunLog

# Reason of a run whose end was not recorded.
END_NOT_RECORDED = "the outcome of the run did not reach the recorder"


def missing(log: RunLog) -> str:
    """Return a sentence with the ticks whose messages are missing; empty if none is.

    Every process numbers its messages, so a gap shows a missing one. The last messages of a killed process leave no
    gap. Ticks simulated after the last recorded plant state are known from messages of agents and coordinator.
    """
    merged: list[tuple[int, int]] = []
    for first, last in sorted([*_gaps(log), *_unrecorded_end(log)]):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = merged[-1][0], max(last, merged[-1][1])
        else:
            merged.append((first, last))
    parts = [f"some messages of ticks {ranges(merged)}"] if merged else []
    if any(control.reason == END_NOT_RECORDED for control in log.of(Control)):
        parts.append(f"the rest of the run after tick {max(entry.message.tick for entry in log.messages)}")
    return f"{' and '.join(parts)} did not reach the recorder" if parts else ""


def ranges(spans: Iterable[tuple[int, int]]) -> str:
    """Format spans of ticks: "3, 7 to 9"."""
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in spans)


def _gaps(log: RunLog) -> Iterator[tuple[int, int]]:
    """Yield the ticks around each gap in the numbers of one process, and before its first number if that is not 0."""
    ticks: dict[tuple[str, int], dict[int, int]] = {}  # by sender and incarnation, then by number
    for message in (entry.message for entry in log.messages):
        # The recorder's own notes cannot get lost; rejections have numbers of their own.
        if message.sender != RECORDER and not isinstance(message, Rejected):
            ticks.setdefault((message.sender, message.incarnation), {})[message.sequence] = message.tick
    for tick_of in ticks.values():
        numbers = sorted(tick_of)
        if numbers[0] > 0:
            yield 0, tick_of[numbers[0]]
        for before, after in pairwise(numbers):
            if after > before + 1:
                yield min(tick_of[before], tick_of[after]), max(tick_of[before], tick_of[after])


def _unrecorded_end(log: RunLog) -> Iterator[tuple[int, int]]:
    """Yield first and last tick simulated after the last recorded plant state, if there are any."""
    recorded = max((plant_state.tick for plant_state in log.of(PlantState)), default=-1)
    simulated = max((_simulated(entry.message) for entry in log.messages), default=-1)
    if simulated > recorded:
        yield recorded + 1, simulated


def _simulated(message: Message) -> int:
    """Return the last tick that the plant had simulated before a message, -1 for none."""
    match message:
        case Measurement() | Plan() | StepReport():
            return message.tick - 1  # the plant measures at a tick after simulating the one before
        case Control(outcome="completed") if message.sender == COORDINATOR:
            return message.tick
    return -1
