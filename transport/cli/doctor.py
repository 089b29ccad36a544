"""The command `transport doctor`."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument

from protocol.wire.exit_codes import EXIT_CHECK_FAILED
from transport.cli.options import FormatOption, LargeOption, SetOption
from transport.cli.output import Format, show_json
from transport.cli.scenario_setup import read_setup
from transport.doctor.checks import Finding, checks

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    scenario: Annotated[
        str, Argument(metavar="SCENARIO", help="File or name of the scenario that is to run here.")
    ] = "paper",
    settings: SetOption = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check that this machine can run a scenario.

    Checks Python, packages, ports, network, clock, processors and limits. Each result is ok, warn (runs work, but
    slower or less punctually) or fail (runs do not work), with advice. Takes a few seconds and changes nothing.

    Exit codes: 0 no check failed, 9 a check failed, 3 scenario.

    Example: transport doctor resilient --set clock.mode=realtime --set clock.speed=1
    """
    setup = read_setup(scenario, settings, allow_large=large)
    found = list(checks(setup) if output is Format.json else _shown(checks(setup)))
    count = Counter(finding.status for _, finding in found)
    failed = count["fail"]
    if output is Format.json:
        content = [{"name": name, **finding._asdict()} for name, finding in found]
        show_json({"scenario": setup.scenario.name, "ok": not failed, "checks": content})
    else:
        typer.echo(f"{len(found)} checks: {failed} fail, {count['warn']} warn")
    if failed:
        raise typer.Exit(EXIT_CHECK_FAILED)


def _shown(found: Iterable[tuple[str, Finding]]) -> Iterator[tuple[str, Finding]]:
    """Print each check as soon as its result is known."""
    console = Console()
    for name, finding in found:
        grid = Table.grid(padding=(0, 1))
        grid.add_column(width=4)
        grid.add_column(width=12)
        grid.add_column(ratio=1)
        grid.add_row(Text(finding.status, _COLOURS[finding.status]), Text(name, "cyan"), Text(finding.found))
        if finding.advice:
            grid.add_row("", "", Text(f"-> {finding.advice}"))
        console.print(grid)
        yield name, finding
