"""The command `transport run`: its options, without the imports of a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from transport.cli.lazy import load
from transport.cli.options import (
    FiguresOption,
    FormatOption,
    HostOption,
    LargeOption,
    PortOption,
    ScenarioArgument,
    SetOption,
    with_options,
)
from transport.cli.output import Format


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of `transport run`."""

    scenario: ScenarioArgument = "paper"
    settings: SetOption = None
    out: Annotated[
        Path | None, Option("--out", metavar="FOLDER", help="Run folder to create; by default runs/<time>-<scenario>.")
    ] = None
    output: FormatOption = Format.text
    figures: FiguresOption = True
    external: Annotated[
        list[str] | None,
        Option("--external", metavar="NAME", help="Process that you start yourself: plant, agent1, ... Repeatable."),
    ] = None
    view: Annotated[bool, Option("--view", help="Show the run in the browser, live and afterwards.")] = False
    host: HostOption = "127.0.0.1"
    port: PortOption = 8080
    allow_large: LargeOption = False


@with_options(RunOptions)
def run(options: RunOptions) -> None:
    """Run a scenario with all its processes; record and report it.

    Starts one process per agent, a plant and a coordinator; writes log, metrics and figures to a run folder.

    Example: transport run paper --set controller.relaxation=0.5 --out runs/relaxed
    """
    load("transport.cli.run_scenario").run_scenario(options)
