"""Folders of runs: their names, what is in them before the run begins, and the error of a run that cannot begin."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from protocol.network.security import SecurityError, new_secret
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


def existing(folder: Path) -> RunError:
    """Return the error of a run folder that exists."""
    return RunError(f"expected a folder that does not exist yet, got {folder}", EXIT_USAGE)


def create(folder: Path, setup: Setup) -> str:
    """Create the run folder with the resolved scenario; return its text, or raise RunError."""
    text = tomli_w.dumps(setup.scenario.tree())
    try:
        str(folder).encode()  # Zenoh and TOML take UTF-8 only
        folder.mkdir(parents=True)
        (folder / "scenario.toml").write_text(text, encoding="utf-8")
    except FileExistsError as error:
        raise existing(folder) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"cannot create the folder {str(folder)!r} ({reason})", EXIT_USAGE) from error
    point_latest(folder)
    return text


@contextmanager
def own_keys(scenario: Scenario, folder: Path) -> Iterator[Path | None]:
    """Make the secret of a run in its folder; None where other keys protect the run, or it is to be open.

    Raises: RunError: it cannot be written where only this user can read it.
    """
    network = scenario.network
    if network.keys is not None or network.router is not None or not network.secret:
        yield None
        return
    with ExitStack() as stack:
        try:
            keys = stack.enter_context(new_secret(folder.resolve() / "keys"))
        except SecurityError as error:
            remedy = "use another folder, or --set network.secret=false: open to every local process"
            raise RunError(f"network.secret: {error}; {remedy}", EXIT_SCENARIO) from error
        yield keys
