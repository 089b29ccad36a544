"""The command `transport doctor`."""

from typing import Annotated

import typer

from protocol.wire.exit_codes import EXIT_CHECK_FAILED, EXIT_SCENARIO
from transport.cli.answers import Format, fail, show_json

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    scenario: Annotated[str, typer.Argument(help="Scenario file or name that is to be flown here.")] = "paper",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a scenario value, e.g. network.base_port=7500."),
    ] = None,
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
) -> None:
    """Check this machine for what a run needs.

    Python, packages, ports, network, clock, processors, limits: each is ok, warn (a run flies, but not as well as it
    could) or fail (it does not), with what to do about it. Takes a few seconds and changes nothing.

    Exit codes: 0 nothing fails, 9 something does, 3 scenario.

    Example: transport doctor resilient --set clock.mode=realtime --set clock.speed=1
    """
    from dataclasses import asdict

    from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
    from protocol.scenario.setup import Setup
    from transport.doctor.checks import checks

    try:
        path = find_scenario(scenario)
        setup = Setup.of(read_scenario(path, settings or []), str(path))
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)
    if output is Format.json:
        found = list(checks(setup))
        failed = [check for check in found if check.status == "fail"]
        show_json({"scenario": setup.scenario.name, "ok": not failed, "checks": [asdict(check) for check in found]})
    else:
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        console = Console()
        found = []
        for check in checks(setup):  # each line as soon as it is known
            found.append(check)
            grid = Table.grid(padding=(0, 1))
            grid.add_column(width=4)
            grid.add_column(width=12)
            grid.add_column(ratio=1)
            grid.add_row(Text(check.status, _COLOURS[check.status]), Text(check.name, "cyan"), Text(check.found))
            if check.advice:
                grid.add_row("", "", Text(f"-> {check.advice}"))
            console.print(grid)
        failed = [check for check in found if check.status == "fail"]
        warned = sum(check.status == "warn" for check in found)
        typer.echo(f"{len(found)} checks: {len(failed)} fail, {warned} warn")
    if failed:
        raise typer.Exit(EXIT_CHECK_FAILED)
