"""The command `transport fault`."""

from typing import Annotated

import typer
from typer import Argument

from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.names import RECORDER
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, with_options
from transport.cli.output import Format, fail, show_json
from transport.flight.requests import FAULTS


def _actions(incomplete: str) -> list[str]:
    """Return the faults that begin like an incomplete word, for the shell."""
    return [action for action in FAULTS if action.startswith(incomplete)]


@with_options(ActiveRun)
def fault(
    run: ActiveRun,
    action: Annotated[
        str, Argument(metavar="ACTION", help="kill, stop, continue or restart.", autocompletion=_actions)
    ],
    target: Annotated[str, Argument(metavar="PROCESS", help="agent1, agent2, ..., plant or coordinator.")],
    output: FormatOption = Format.text,
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    if action not in FAULTS:
        fail(f"ACTION: expected one of {', '.join(FAULTS)}, got {action!r}", EXIT_USAGE)
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(f"{action} {target}: done at tick {answer['tick']}")
