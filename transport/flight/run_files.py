"""Folders of runs: their names, what is in them before the run begins, and the error of a run that cannot begin."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from protocol.network.security import SecurityError, new_secret
from protocol.scenario.files import path_problem, write_delays
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.log.run_folder import point_latest


class RunError(TransportError, RuntimeError):
    """A run that could not be started or recorded: one line for the user, and the exit code of the command."""

    def __init__(self, text: str, exit_code: int) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def new_folder(parent: Path, name: str) -> Path:
    """Return the path of a new run folder, named by time and scenario."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    folder, count = parent / f"{stamp}-{name}", 1
    while folder.exists():
        count += 1
        folder = parent / f"{stamp}-{name}-{count}"
    return folder


def refuse_existing(folder: Path) -> None:
    """Raise RunError if a run folder exists already."""
    problem = path_problem(folder)
    if problem:
        raise RunError(f"--out: cannot create {str(folder)!r} ({problem})", EXIT_USAGE)
    if folder.exists():
        raise RunError(f"--out: expected a folder that does not exist yet, got {folder}", EXIT_USAGE)


def create(folder: Path, setup: Setup) -> str:
    """Create the run folder with the resolved scenario; return its text, or raise RunError."""
    refuse_existing(folder)
    text = tomli_w.dumps(setup.scenario.tree())
    try:
        folder.mkdir(parents=True)
        (folder / "scenario.toml").write_text(text, encoding="utf-8")
        write_delays(setup.samples_s, folder)
    except OSError as error:
        raise RunError(f"--out: cannot create {folder} ({error.strerror})", EXIT_USAGE) from error
    point_latest(folder)
    return text


@contextmanager
def own_keys(scenario: Scenario, folder: Path) -> Iterator[Path | None]:
    """Make the secret of a run in its folder; None where other keys protect the run, or it is to be open.

    On a file system without permissions it is made in the temporary folder of the system.

    Raises: RunError: it cannot be written where only this user can read it.
    """
    network, problem = scenario.network, ""
    if network.keys is not None or network.router is not None or not network.secret:
        yield None
        return
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}-") as second, ExitStack() as stack:
        for place in (folder, Path(second)):
            try:
                keys = stack.enter_context(new_secret(place.resolve() / "keys"))
            except SecurityError as error:
                problem = str(error)
            else:
                yield keys
                return
    expected = "expected a file system with permissions, in --out or in TMPDIR, for the secret of the run"
    remedy = "--set network.secret=false runs without, open to every local process"
    raise RunError(f"network.secret: {expected}, got none ({problem}); {remedy}", EXIT_SCENARIO)
