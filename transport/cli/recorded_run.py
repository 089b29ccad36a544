"""The recorded run that a command reads: by default the most recent one."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.options import RUNS
from transport.cli.output import fail

_LOG = "run.mcap"


def complete_run(incomplete: str) -> list[str]:
    """Return the folders of runs that begin like an incomplete word, the most recent first, for the shell."""
    return [str(folder) for folder in newest_runs() if str(folder).startswith(incomplete)]


RunArgument = Annotated[
    Path | None,
    Argument(
        metavar="RUN",
        help="Run folder, or its name in runs/; by default the most recent one.",
        autocompletion=complete_run,
    ),
]


def newest_runs() -> list[Path]:
    """Return the folders below runs/ that hold a log, the most recently written first."""
    logs = [path for path in RUNS.glob(f"*/{_LOG}") if not path.parent.is_symlink()]  # `latest` is one of them
    return [path.parent for path in sorted(logs, key=lambda path: path.stat().st_mtime, reverse=True)]


def run_folder(given: Path | None) -> Path:
    """Return the folder of the run that was named, or of the most recent one, which is told on standard error."""
    if given is not None:
        in_runs = RUNS / given
        return in_runs if not given.exists() and in_runs.exists() else given
    found = newest_runs()
    if not found:
        fail(f"RUN: expected a run folder, got none, and there is no run in {RUNS}/", EXIT_USAGE)
    typer.echo(f"run: {found[0]}", err=True)
    return found[0]
