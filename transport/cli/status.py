"""The command `transport status`."""

import json
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Option

from protocol.wire.names import COORDINATOR
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, with_options
from transport.cli.output import Format, show_json

# Label, factor and unit of values in the table; --format json has them all as they are.
_SHOWN_AS = {
    "refused": ("refused messages", None, ""),
    "clock_offset_s": ("coordinator's clock", 1e3, "ms ahead"),
    "clock_uncertainty_s": ("known within", 1e3, "ms"),
    "memory_bytes": ("memory", 1e-6, "MB"),
    "open_files": ("open files", None, ""),
    "cpu_s": ("processor time", 1.0, "s"),
}
_HIDDEN = ("asked_ns", "answered_ns")


@with_options(ActiveRun)
def status(
    run: ActiveRun,
    process: Annotated[
        str | None, Option("--process", metavar="PROCESS", help="Process, such as plant, agent1 or recorder.")
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Show the progress of a run, or the health of one process.

    Tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    name, what = (COORDINATOR, "status") if process is None else (process, "health")
    answer = run.ask(name, what, {})
    if output is Format.json:
        show_json(answer)
    elif process is None:
        typer.echo(_progress(answer))
    else:
        Console().print(_table(answer))


def _progress(answer: Mapping[str, Any]) -> str:
    """Return a sentence about tick, roster and observers."""
    begun = f"tick {answer['tick']} of {answer['ticks']}" if answer["tick"] >= 0 else "before the first tick"
    agents = ", ".join(map(str, answer["members"])) or "none"
    observers = f"; observed by {', '.join(answer['observers'])}" if answer["observers"] else ""
    return f"{begun}; agents on the roster: {agents}{observers}"


def _table(answer: Mapping[str, Any]) -> Table:
    """Return a row for each value."""
    table = Table(box=None, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, value in answer.items():
        if name in _HIDDEN or value is None:
            continue
        label, scale, unit = _SHOWN_AS.get(name, (name, None, ""))
        number = (
            value if isinstance(value, str) else json.dumps(value) if scale is None else f"{round(scale * value, 3):g}"
        )
        table.add_row(label, Text(f"{number} {unit}".rstrip()))
    return table
