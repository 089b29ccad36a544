"""A run folder: its scenario, its log and what is known to be missing from it; the link to the newest folder.

Missing messages are found by gaps in the sequence numbers of each sender.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from protocol.scenario.file import read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Control, Measurement, Plan, PlantState, Rejected, StepReport
from protocol.wire.names import COORDINATOR
from transport.log.run_log import RunLog, read_log

# Folder whose runs have a link to the most recent one, and the name of the link.
_RUNS, LATEST = "runs", "latest"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """A recorded run."""

    folder: Path
    setup: Setup
    log: RunLog  # `cut` names what the file lacks and what did not reach the recorder

    @property
    def scenario_file(self) -> Path:
        """Path of the scenario of the run, with every default."""
        return self.folder / "scenario.toml"


def open_run(folder: Path, *, horizons: bool = True, setup: Setup | None = None) -> RecordedRun:
    """Read run.mcap of a run folder, as `read_log`, and the run from scenario.toml, or raise ScenarioError."""
    path = folder / "run.mcap"
    if setup is None and path.exists():  # otherwise the folder is none of a run, which says more
        setup = setup_of(folder)
    log = read_log(path, horizons=horizons, setup=setup)
    cut = "; ".join(filter(None, (log.cut, missing(log))))
    return RecordedRun(folder=folder, setup=setup or setup_of(folder), log=replace(log, cut=cut))


def setup_of(folder: Path) -> Setup:
    """Return the run of a folder without reading its log, which an active run is still writing.

    Raises: ScenarioError: the scenario cannot be read.
    """
    path = folder / "scenario.toml"
    return Setup.of(read_scenario(path, allow_large=True), str(path))  # its run has been allowed


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
    spans = ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in merged)
    return f"some messages of ticks {spans} did not reach the recorder" if merged else ""


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
    # The plant measures at a tick after simulating the one before.
    others = [message.tick - 1 for kind in (Measurement, Plan, StepReport) for message in log.of(kind)]
    ends = [end.tick for end in log.of(Control) if end.outcome == "completed" and end.sender == COORDINATOR]
    simulated = max([*others, *ends], default=-1)
    if simulated > recorded:
        yield recorded + 1, simulated


def point_latest(folder: Path) -> None:
    """Point `latest` beside a run folder at it, if both are in a folder named `runs` and nothing else has that name."""
    link = folder.parent / LATEST
    if folder.resolve().parent.name == _RUNS and folder.name != LATEST:
        with suppress(OSError):
            if link.is_symlink():
                link.unlink()
            link.symlink_to(folder.name, target_is_directory=True)
