"""The commands `transport experiment ...`. Heavy imports are inside, as in all of the command line."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from transport.experiments.errors import EXIT_CASES, EXIT_SCENARIO, ExperimentError, refused

if TYPE_CHECKING:
    from transport.experiments.catalogue import Experiment
    from transport.experiments.sweep import Fly

_INTERRUPTED = 130

# With --quick: a maneuver of 1.5 s, and an agent that is killed and started again within it.
_QUICK = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
_QUICK_SEEDS = 2

experiment_app = typer.Typer(
    help="Fly many variations of a scenario and compare them: tables, confidence intervals, a figure.",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Exit codes: 0 done, whatever was found; 2 usage, 3 scenario, 4 cluster or worker lost, "
    "7 some flights could not be flown, 130 interrupted.",
)

ScenariosOption = Annotated[
    list[str] | None,
    typer.Option("--scenario", help="Scenario file or name; paper and resilient by default. Repeatable."),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a value of every scenario. Repeatable."),
]
SeedsOption = Annotated[
    int | None, typer.Option("--seeds", min=1, help="Repetitions of what is random, with the seeds 0, 1, ...")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder; one of the same experiment is gone on with. By default a new one in runs/."),
]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Flights at a time; as many as there are cores by default.")
]
DaskOption = Annotated[
    str | None, typer.Option("--dask", metavar="ADDRESS", help="Fly on a Dask cluster, e.g. tcp://host:8786.")
]
ProcessesOption = Annotated[
    bool, typer.Option("--processes", help="Fly each as `transport run` does, recorded, one after the other.")
]
QuickOption = Annotated[bool, typer.Option("--quick", help="Short flights and few of them: a trial, no measurement.")]
