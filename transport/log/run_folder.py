"""Reading a run folder: its scenario, its log, and what is known to be missing from it."""

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
        folder: The run folder.
        setup: The run.
        log: Its messages; `cut` names what the file lacks and what did not reach the recorder.
    """

    folder: Path
    setup: Setup
    log: RunLog

    @property
    def scenario_file(self) -> Path:
        """Path of the scenario of the run, with every default."""
        return self.folder / "scenario.toml"


def open_run(folder: Path, *, horizons: bool = True, setup: Setup | None = None) -> RecordedRun:
    """Read run.mcap of a run folder, with `horizons` as in `read_log`, and the run from scenario.toml unless given.

    Raises: LogError: the log cannot be read; ScenarioError: the scenario cannot be read.
    """
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
