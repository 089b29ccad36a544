"""Command `transport arena`: algorithms of the project and of the user on all tasks and networks."""

from functools import partial
from typing import Annotated

from rich.console import Console, Group
from typer import Option

from transport.cli.commands.experiment import ExperimentOptions
from transport.cli.lazy import with_options
from transport.cli.output import show
from transport.experiments.arena.arena_measures import MEASURES
from transport.experiments.arena.arena_report import conduct
from transport.experiments.arena.arena_runs import DECLARED, NAME
from transport.experiments.arena.arena_runs import arena as arena_of
from transport.experiments.arena.arena_tasks_and_networks import NETWORKS, TASKS
from transport.experiments.cases import check_names

_WIDTH = 150  # characters

# Tasks and algorithms have all settings: none can be changed for all of them.
_OPTIONS = partial(
    ExperimentOptions,
    declared=DECLARED,
    settings=None,
    scenarios=None,
    quick=False,
    allow_large=False,
)


@with_options(_OPTIONS)
def arena(
    options: ExperimentOptions,
    controllers: Annotated[
        list[str] | None,
        Option("--controller", metavar="MODULE:CLASS", help="Class that enters. Repeatable."),
    ] = None,
    tasks: Annotated[
        list[str] | None,
        Option("--task", metavar="NAME", help=f"{', '.join(TASKS)}; default: all. Repeatable."),
    ] = None,
    networks: Annotated[
        list[str] | None,
        Option(
            "--network", metavar="NAME", help=f"{', '.join(NETWORKS)}; default: all. Repeatable."
        ),
    ] = None,
    algorithms: Annotated[
        list[str] | None,
        Option(
            "--algorithm",
            metavar="NAME",
            help="Algorithm of the project that runs beside the classes; default: all. Repeatable.",
        ),
    ] = None,
    measures: Annotated[
        list[str] | None,
        Option(
            "--measure",
            metavar="NAME",
            help=f"Also a figure of a measure: {', '.join(MEASURES)}. Repeatable.",
        ),
    ] = None,
) -> None:
    """Compare algorithms, yours too, on tasks and networks.

    Every algorithm of the project and every class given runs on each task and network. Prints a
    table for each measure: there is no score. Writes arena.json, tables and a figure of the completed runs.

    Example: transport arena --controller mine:Mine --algorithm paper --algorithm resilient
    """
    options.check_workers()
    check_names("--measure", measures or [], MEASURES)
    made = arena_of(
        controllers or [],
        tasks=tasks or [],
        networks=networks or [],
        algorithms=algorithms or [],
        seeds=options.repetitions,
    )

    folder = options.folder(NAME)
    result = conduct(made, options.simulate, folder, Console(stderr=True))
    files = [str(file) for file in result.write(folder, measures or [])]
    lines = ["", *result.sentences(), "", *(f" {file}" for file in files)]
    content = {**result.content(), "files": files}
    tables = [part for table in result.tables() for part in (table, "")]
    show(options.output, content, Group(*tables), *lines, width=_WIDTH)
    result.swept.check()
