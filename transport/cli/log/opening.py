"""The log that a command reads."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.output import exit_on
from transport.cli.recorded_run import complete_run, run_folder
from transport.log.info import LogFile, open_log
from transport.log.run_log import LogError

LogArgument = Annotated[
    Path | None,
    Argument(
        metavar="RUN|FILE",
        help="Run folder, its name in runs/, or MCAP file; by default the most recent run.",
        autocompletion=complete_run,
    ),
]


def open_or_fail(given: Path | None) -> LogFile:
    """Open a log, by default that of the most recent run, or end the command if it cannot be read."""
    path = run_folder(given)
    with exit_on(LogError, code=EXIT_USAGE):
        return open_log(path)
