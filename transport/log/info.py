"""What a log holds: channels, ticks, span, and of a log that is not whole what is lost."""

import tomllib
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from protocol.scenario.file import ScenarioError, validate
from protocol.scenario.setup import Setup
from protocol.wire.messages import Control, PlantState, Tick
from transport.log.gaps import missing
from transport.log.run_log import RunLog, read_log, topic_of


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFile:
    """A log by itself.

    Attributes:
        path: The file.
        log: What can be read of it.
        setup: The run, from the scenario the log carries; None where that is lost or not of this version.
    """

    path: Path
    log: RunLog
    setup: Setup | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One channel of a log.

    Attributes:
        topic: Its name.
        messages: How many.
        first, last: Ticks of its first and last message.
        without: Ticks in between that have no message, as ranges.
    """

    topic: str
    messages: int
    first: int
    last: int
    without: tuple[tuple[int, int], ...]


def open_log(path: Path) -> LogFile:
    """Read a log: a file, or the one of a run folder.

    Raises: LogError: it cannot be read, or is none.
    """
    file = path / "run.mcap" if path.is_dir() else path
    log = read_log(file)
    setup: Setup | None = None
    try:
        # Files that the scenario names lie beside the log, in its run folder.
        source = str(file.parent / "scenario.toml")
        setup = Setup.of(validate(tomllib.loads(log.header.get("scenario", "")), source), source)
    except (ScenarioError, tomllib.TOMLDecodeError):
        setup = None
    return LogFile(path=file, log=log, setup=setup)


def channels(log: RunLog) -> list[Channel]:
    """Its channels, by name."""
    ticks: dict[str, list[int]] = {}
    for entry in log.messages:
        ticks.setdefault(topic_of(entry.message), []).append(entry.message.tick)
    return [
        Channel(
            topic=topic,
            messages=len(found),
            first=min(found),
            last=max(found),
            # What happens now and then has no ticks it is missing at.
            without=_holes(found) if _is_regular(topic) else (),
        )
        for topic, found in sorted(ticks.items(), key=lambda item: _natural(item[0]))
    ]


def describe(file: LogFile) -> dict[str, Any]:
    """All there is to say about a log, as plain data that JSON can hold."""
    log, setup = file.log, file.setup
    ticks = [entry.message.tick for entry in log.messages]
    received = [entry.received_ns for entry in log.messages]
    control = next(log.of(Control), None)
    flown = {plant_state.tick for plant_state in log.of(PlantState)}
    return {
        "file": str(file.path),
        "bytes": file.path.stat().st_size,
        "run_id": log.header.get("run_id"),
        "scenario": None if setup is None else setup.scenario.name,
        "versions": log.header.get("versions"),
        "machine": log.header.get("machine"),
        "messages": len(log.messages),
        "kinds": dict(Counter(entry.message.kind for entry in log.messages)),
        "first_tick": min(ticks, default=None),
        "last_tick": max(ticks, default=None),
        "ticks_of_the_run": None if setup is None else setup.ticks,
        "ticks_flown": len(flown),
        "sampling_period_s": None if setup is None else setup.settings.sampling_period_s,
        "wall_time_s": (max(received) - min(received)) / 1e9 if received else None,
        "outcome": "unknown" if control is None else control.outcome,
        "reason": "" if control is None else control.reason,
        "complete": not log.cut and not missing(log),
        "cut": log.cut or None,
        "lost": lost(file),
        "channels": [
            {
                "topic": channel.topic,
                "messages": channel.messages,
                "first_tick": channel.first,
                "last_tick": channel.last,
                "ticks_without": [list(hole) for hole in channel.without],
            }
            for channel in channels(log)
        ],
    }


def lost(file: LogFile) -> list[str]:
    """What the log lacks that was said, a sentence each; empty when it is whole."""
    log, setup = file.log, file.setup
    found = []
    if log.cut:
        if not log.header:
            found.append("what belongs to the run as a whole: its name, scenario, versions, machine")
        if log.messages and next(log.of(Control), None) is None:
            last = max(entry.message.tick for entry in log.messages)
            rest = "everything after it, and how the run ended"
            if setup is not None and last + 1 < setup.ticks:
                period_s = setup.settings.sampling_period_s
                gone = setup.ticks - last - 1
                rest = (
                    f"ticks {last + 1} to {setup.ticks - 1} as far as they were flown (up to {gone} of {setup.ticks}, "
                    f"{gone * period_s:.2f} s of {setup.ticks * period_s:.2f} s), and how the run ended"
                )
            found.append(f"some messages of tick {last}, perhaps; {rest}")
    gaps = missing(log)
    if gaps:
        found.append(gaps)
    return found


def ranges(holes: Iterable[tuple[int, int]]) -> str:
    """Ranges for people: "3, 7 to 9"."""
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in holes)


def _holes(ticks: Collection[int]) -> tuple[tuple[int, int], ...]:
    """Ranges of what is missing between the smallest and the largest."""
    there = sorted(set(ticks))
    return tuple((a + 1, b - 1) for a, b in pairwise(there) if b > a + 1)


def _is_regular(topic: str) -> bool:
    """Whether a channel has something to say at every tick."""
    return topic.strip("/").split("/")[0] in (Tick.kind, PlantState.kind, "measurement", "plan", "report")


def _natural(topic: str) -> tuple[str, int]:
    """Order of channels: agent 10 after agent 9."""
    head, _, last = topic.rpartition("/")
    return (head, int(last)) if last.isdecimal() else (topic, 0)
