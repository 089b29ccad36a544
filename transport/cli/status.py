"""The command `transport status`."""

import json
from typing import Annotated

import typer
from typer import Option

from protocol.wire.names import COORDINATOR
from transport.cli.active_run import ActiveRun
from transport.cli.options import with_options


@with_options(ActiveRun)
def status(
    run: ActiveRun,
    process: Annotated[str | None, Option("--process", help="Process, such as plant, agent1 or recorder.")] = None,
) -> None:
    """Show the progress of a run, or the health of one process.

    Prints JSON: tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    name, what = (COORDINATOR, "status") if process is None else (process, "health")
    typer.echo(json.dumps(run.ask(name, what, {})))
