"""The command `transport margins`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import matplotlib as mpl
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from typer import Option

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.options import FormatOption, LargeOption, ScenarioArgument, SetOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup, scenario_errors
from transport.report.margins import ACTUATIONS, draw, hover_margins, notes, rows
from transport.report.style import RC


def margins(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    figure: Annotated[
        Path | None, Option("--figure", metavar="FILE", help="Draw the ranges; the ending is the format.")
    ] = None,
    without: Annotated[
        str | None, Option("--without", metavar="AGENTS", help="Agents that are gone for good, such as 1,2.")
    ] = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Compute how much model error a hover tolerates.

    Analyses the sampled loop about hover: actuator lag, delay and gain, masses, inertias and rods up to which the hover
    is stable, the others as known. Factors are relative to the known value. Takes seconds. With --without the
    team that is left holds the payload if all deviations decay.

    Example: transport margins resilient --set controller.sampling_period_s=0.02 --figure margins.png
    """
    setup = read_setup(scenario, settings, allow_large=large)
    absent = [agent.strip() for agent in without.split(",")] if without else []
    if not all(map(str.isdecimal, absent)):
        fail(f"--without: expected agents such as 1,2, got {without!r:.60}", EXIT_USAGE)
    with scenario_errors(settings):
        found = hover_margins(setup, [int(agent) for agent in absent])
    if output is Format.json:
        show_json(asdict(found))
    else:
        table = Table("property", *ACTUATIONS, box=None)
        for row in rows(found):
            table.add_row(*row)
        Console().print(table)
        for note in notes(found):
            typer.echo(f"warning: {note}", err=True)
    if figure is not None:
        with exit_on(OSError, ValueError, code=EXIT_USAGE, option="--figure"), mpl.rc_context(RC):
            drawing = Figure()
            draw(found, drawing)
            drawing.savefig(figure)
