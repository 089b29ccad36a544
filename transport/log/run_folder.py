"""A run folder as it is read: the scenario as flown and the log, with all that is known to be lost of it."""

from dataclasses import dataclass, replace
from pathlib import Path

from protocol.scenario.file import read_scenario
from protocol.scenario.setup import Setup
from transport.log.gaps import missing
from transport.log.run_log import RunLog, read_log


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """A recorded run.

    Attributes:
        folder: Where it is.
        setup: As flown.
        log: Every message; `cut` names what the file does not hold and what did not reach the recorder.
    """

    folder: Path
    setup: Setup
    log: RunLog

    @property
    def scenario_file(self) -> Path:
        """The scenario as flown, every default spelled out."""
        return self.folder / "scenario.toml"


def open_run(folder: Path, *, horizons: bool = True, setup: Setup | None = None) -> RecordedRun:
    """Read a run folder.

    Args:
        folder: With run.mcap and scenario.toml.
        horizons: Whether plans are wanted as they are, and not their first step alone (`read_log`).
        setup: The run, where it is known; otherwise the folder says.
    Raises: LogError: it has no log, or none that can be read; ScenarioError: its scenario cannot be read.
    """
    log = read_log(folder / "run.mcap", horizons=horizons)
    cut = "; ".join(filter(None, (log.cut, missing(log))))
    return RecordedRun(folder=folder, setup=setup or setup_of(folder), log=replace(log, cut=cut))


def setup_of(folder: Path) -> Setup:
    """What a run folder says is flown, without its log, which a run in flight is still writing.

    Raises: ScenarioError: its scenario cannot be read.
    """
    path = folder / "scenario.toml"
    return Setup.of(read_scenario(path), str(path))
