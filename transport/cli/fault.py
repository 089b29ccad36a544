"""The command `transport fault`."""

from typing import Annotated

import typer
from typer import Argument

from protocol.wire.names import RECORDER
from transport.cli.active_run import ActiveRun
from transport.cli.options import with_options


@with_options(ActiveRun)
def fault(
    run: ActiveRun,
    action: Annotated[str, Argument(help="kill, stop, continue or restart.")],
    target: Annotated[str, Argument(help="Process: agent1, agent2, ..., plant, coordinator.")],
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    typer.echo(f"{action} {target}: done at tick {answer['tick']}")
