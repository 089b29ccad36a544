"""The command `transport doctor`."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument

from protocol.wire.exit_codes import EXIT_CHECK_FAILED
from transport.cli.options import FormatOption, SetOption
from transport.cli.output import Format, show_json
from transport.cli.scenario_setup import read_setup
from transport.doctor.checks import Check, checks

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    scenario: Annotated[str, Argument(help="File or name of the scenario that is to run here.")] = "paper",
    settings: SetOption = None,
    output: FormatOption = Format.text,
) -> None:
    """Check this machine for what a run needs.

    Python, packages, ports, network, clock, processors, limits: each is ok, warn (runs work, but not as well as they
    could) or fail (runs do not work), with advice. Takes a few seconds and changes nothing.

    Exit codes: 0 no check failed, 9 a check failed, 3 scenario.

    Example: transport doctor resilient --set clock.mode=realtime --set clock.speed=1
    """
    setup = read_setup(scenario, settings)
    found = list(checks(setup) if output is Format.json else _shown(checks(setup)))
    failed = [check for check in found if check.status == "fail"]
    if output is Format.json:
        show_json({"scenario": setup.scenario.name, "ok": not failed, "checks": [asdict(check) for check in found]})
    else:
        warned = sum(check.status == "warn" for check in found)
        typer.echo(f"{len(found)} checks: {len(failed)} fail, {warned} warn")
    if failed:
        raise typer.Exit(EXIT_CHECK_FAILED)


def _shown(found: Iterable[Check]) -> Iterator[Check]:
    """Print each check as soon as its result is known."""
    console = Console()
    for check in found:
        grid = Table.grid(padding=(0, 1))
        grid.add_column(width=4)
        grid.add_column(width=12)
        grid.add_column(ratio=1)
        grid.add_row(Text(check.status, _COLOURS[check.status]), Text(check.name, "cyan"), Text(check.found))
        if check.advice:
            grid.add_row("", "", Text(f"-> {check.advice}"))
        console.print(grid)
        yield check
