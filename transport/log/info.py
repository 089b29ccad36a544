"""Content of a log: channels, ticks, time span, and what is missing."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from protocol.scenario.setup import Setup
from protocol.wire.messages import Control, Measurement, Plan, PlantState, StepReport, Tick
from transport.log.channels import kind_of, topic_of
from transport.log.run_folder import missing
from transport.log.run_log import RunLog, read_log, setup_in

# Kinds of messages sent at every tick.
_REGULAR = (Tick.kind, PlantState.kind, Measurement.kind, Plan.kind, StepReport.kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFile:
    """Readable content of a log file, and the run, None if the scenario in the log is missing or of another version."""

    path: Path
    log: RunLog
    setup: Setup | None


def open_log(path: Path) -> LogFile:
    """Read a log from a file or a run folder.

    Raises: LogError: it cannot be read, or is not a log.
    """
    file = path / "run.mcap" if path.is_dir() else path
    log = read_log(file)
    return LogFile(path=file, log=log, setup=setup_in(log.header, file.parent))


def describe(file: LogFile) -> dict[str, Any]:
    """Return a description of a log as JSON data."""
    log, setup = file.log, file.setup
    ticks = [entry.message.tick for entry in log.messages]
    received = [entry.received_ns for entry in log.messages]
    control = next(log.of(Control), None)
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
        "ticks_flown": len({plant_state.tick for plant_state in log.of(PlantState)}),
        "sampling_period_s": None if setup is None else setup.settings.sampling_period_s,
        "wall_time_s": (max(received) - min(received)) / 1e9 if received else None,
        "outcome": "unknown" if control is None else control.outcome,
        "reason": "" if control is None else control.reason,
        "complete": not log.cut and not missing(log),
        "cut": log.cut or None,
        "lost": lost(file),
        "channels": _channels(log),
    }


def lost(file: LogFile) -> list[str]:
    """Return what is missing from the log, a sentence each; empty if it is whole."""
    log, setup = file.log, file.setup
    found = []
    if log.cut:
        if not log.header:
            found.append("the metadata of the run: its name, scenario, versions, machine")
        if log.messages and next(log.of(Control), None) is None:
            last = max(entry.message.tick for entry in log.messages)
            rest = "everything after it, and the outcome of the run"
            if setup is not None and last + 1 < setup.ticks:
                period_s = setup.settings.sampling_period_s
                gone = setup.ticks - last - 1
                rest = (
                    f"ticks {last + 1} to {setup.ticks - 1} as far as they were simulated (up to {gone} of "
                    f"{setup.ticks}, {gone * period_s:.2f} s of {setup.ticks * period_s:.2f} s), "
                    "and the outcome of the run"
                )
            found.append(f"possibly some messages of tick {last}; {rest}")
    gaps = missing(log)
    if gaps:
        found.append(gaps)
    return found


def _channels(log: RunLog) -> list[dict[str, Any]]:
    """Return the channels, sorted by name, each with the spans of ticks in between that have no message."""
    ticks: dict[str, list[int]] = {}
    for entry in log.messages:
        ticks.setdefault(topic_of(entry.message), []).append(entry.message.tick)
    return [
        {
            "topic": topic,
            "messages": len(found),
            "first_tick": min(found),
            "last_tick": max(found),
            # Only channels with a message at every tick can have gaps.
            "ticks_without": _gaps(found) if kind_of(topic) in _REGULAR else [],
        }
        for topic, found in sorted(ticks.items(), key=lambda item: _natural(item[0]))
    ]


def _gaps(ticks: Iterable[int]) -> list[list[int]]:
    """Return the spans missing between the smallest and the largest tick."""
    return [[a + 1, b - 1] for a, b in pairwise(sorted(set(ticks))) if b > a + 1]


def _natural(topic: str) -> tuple[str, int]:
    """Return the sorting key of a channel: agent 10 after agent 9."""
    head, _, last = topic.rpartition("/")
    return (head, int(last)) if last.isdecimal() else (topic, 0)
