"""The command `transport coordinator`."""

from typing import Annotated

from typer import Option

from coordinator.main import run
from transport.cli.options import with_options
from transport.cli.process import ProcessOptions


@with_options(ProcessOptions)
def coordinator(
    options: ProcessOptions,
    observer: Annotated[
        list[str] | None,
        Option("--observer", metavar="PROCESS", help="Also wait for this process before the first tick: recorder."),
    ] = None,
) -> None:
    """Run the coordinator: sampling clock and roster.

    Example: transport coordinator --observer recorder
    """
    options.run("coordinator", lambda setup, place: run(setup, place, observer or []))
