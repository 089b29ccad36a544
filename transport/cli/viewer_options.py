"""Options of `transport view` and `transport run --view`."""

from typing import Annotated

import typer

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.answers import fail
from transport.viewer.server import ViewerError, require_viser

HostOption = Annotated[
    str,
    typer.Option(
        "--host", help="Address to listen on. Any client that reaches it sees the run, and can control a live one."
    ),
]
PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="First port to try.")]


def check_viewer() -> None:
    """Exit with an error if the viewer is not installed."""
    try:
        require_viser()
    except ViewerError as error:
        fail(str(error), EXIT_USAGE)
