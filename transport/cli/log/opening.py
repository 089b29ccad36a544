"""The log that a command reads."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.output import exit_on
from transport.log.info import LogFile, open_log
from transport.log.run_log import LogError

LogArgument = Annotated[Path, Argument(metavar="RUN|FILE", help="Run folder, or MCAP file.")]


def open_or_fail(path: Path) -> LogFile:
    """Open a log, or end the command if it cannot be read."""
    with exit_on(LogError, code=EXIT_USAGE):
        return open_log(path)
