"""Folder of a run: its name, its log and its scenario, and the link to the newest folder."""

from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from transport.log.missing_messages import missing
from transport.log.run_log import RunLog, read_log
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

# Folder whose runs have a link to the most recent one, and the name of the link.
RUNS = Path("runs")
LATEST = "latest"


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
    """Read run.mcap of a run folder, as `read_log`, and the run from scenario.toml.

    Raises: ScenarioError: the scenario is refused.
    """
    path = folder / "run.mcap"
    if setup is None and path.exists():  # otherwise the folder is none of a run, which says more
        setup = setup_of(folder)

    log = read_log(path, horizons=horizons, setup=setup)
    setup = setup or setup_of(folder)
    cut = "; ".join(filter(None, (log.cut, missing(log, setup))))
    return RecordedRun(folder=folder, setup=setup, log=replace(log, cut=cut))


def setup_of(folder: Path) -> Setup:
    """Return the run of a folder without reading its log.

    Raises: ScenarioError: the scenario is refused.
    """
    path = folder / "scenario.toml"
    return Setup.of(read_scenario(path, allow_large=True), str(path))  # its run has been allowed


def new_folder(parent: Path, name: str) -> Path:
    """Return the path of a new run folder, named by UTC time and scenario."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    folder = parent / f"{stamp}-{name}"
    count = 1
    while folder.exists():
        count += 1
        folder = parent / f"{stamp}-{name}-{count}"
    return folder


def point_latest(folder: Path) -> None:
    """Point the link `latest` beside a run folder at it.

    Only folders in one named `runs` have the link, and nothing else of that name is replaced.
    """
    if folder.resolve().parent.name != RUNS.name or folder.name == LATEST:
        return

    link = folder.parent / LATEST
    with suppress(OSError):
        if link.is_symlink():
            link.unlink()
        link.symlink_to(folder.name, target_is_directory=True)
