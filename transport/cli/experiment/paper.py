"""The command `transport experiment paper`."""

import math
from functools import partial
from typing import Annotated

from rich.console import Console
from typer import Option

from transport.cli.experiment.conduct import exit_codes, new_folder, show, simulator, trial_note
from transport.cli.experiment.options import ExperimentOptions
from transport.cli.options import with_options
from transport.experiments import comparison, comparison_report
from transport.experiments.errors import refused


@with_options(partial(ExperimentOptions, default_seeds=5))
def paper(
    options: ExperimentOptions,
    gust: Annotated[
        float, Option("--gust", metavar="SPEED", help="Standard deviation of gusts, m/s; 0 for still air only.")
    ] = 1.0,
) -> None:
    """The paper's claim: centralized against distributed.

    Runs both controllers at a grid of sampling periods and compares mean cost over processor time, which is measured
    first.

    Prints a table, and verdicts at equal sampling rate and at equal computation with their ranges; writes figures.

    Example: transport experiment paper --seeds 10
    """
    with exit_codes():
        if not 0.0 <= gust < math.inf:
            raise refused("--gust", "a speed >= 0 m/s", f"{gust:g}")
        folder, console = new_folder(options, comparison.NAME), Console(stderr=True)
        trial_note(options, console)
        changes, simulate = options.changes(), simulator(options, folder)
        lines, table, found = comparison_report.compare(
            changes, options.repetitions, gust, folder, simulate, console, quick=options.quick
        )
        content = {"experiment": comparison.NAME, "report": [line.strip() for line in lines if line.strip()]}
        show(table, comparison_report.WIDTH, lines, found, content, options.output)
