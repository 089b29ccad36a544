"""Options of the commands `transport experiment`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from transport.cli.options import with_options
from transport.experiments.errors import refused

# With --quick: a maneuver of 1.5 s, and two repetitions of random simulations.
_QUICK_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
_QUICK_SEEDS = 2

ScenariosOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scenario",
        help="Scenario file or name; by default paper and resilient, in hover centralized as well. Repeatable.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a value of every scenario. Repeatable."),
]
SeedsOption = Annotated[
    int | None, typer.Option("--seeds", min=1, help="Repetitions of random simulations, with the seeds 0, 1, ...")
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out", help="Folder, by default a new one in runs/; an existing folder of the same experiment is resumed."
    ),
]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Simulations in parallel; by default the number of cores.")
]
DaskOption = Annotated[
    str | None, typer.Option("--dask", metavar="ADDRESS", help="Simulate on a Dask cluster, e.g. tcp://host:8786.")
]
ProcessesOption = Annotated[
    bool, typer.Option("--processes", help="Run each as `transport run` does, recorded, one after the other.")
]
QuickOption = Annotated[bool, typer.Option("--quick", help="Few and short simulations: a trial, no measurement.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentOptions:
    """Options of an experiment, with its own defaults filled in."""

    settings: list[str] | None
    seeds: int
    out: Path | None
    jobs: int | None
    quick: bool
    names: tuple[str, ...] = ()
    dask: str | None = None
    processes: bool = False
    maneuver: str = ""
    quick_maneuver: str = _QUICK_MANEUVER

    def read(self) -> dict[str, Scenario]:
        """Return the scenarios by name, with the changes of every scenario.

        Raises: ExperimentError: one is named twice. ScenarioError: one is refused.
        """
        if len(set(self.names)) < len(self.names):
            raise refused("--scenario", "each value once", ", ".join(self.names))
        return {name: read_scenario(find_scenario(name), self.changes()) for name in self.names}

    def changes(self) -> list[str]:
        """Return the changes of every scenario, the experiment's own maneuver first."""
        maneuver = self.quick_maneuver if self.quick else self.maneuver
        return [*([maneuver] if maneuver else []), *(self.settings or [])]


def seeds_or_default(seeds: int | None, default: int, *, quick: bool) -> int:
    """Return the number of repetitions, given or by default."""
    return seeds if seeds is not None else min(default, _QUICK_SEEDS) if quick else default


def with_experiment_options(
    *, seeds: int, scenarios: tuple[str, ...] = ("paper", "resilient"), quick_maneuver: str = _QUICK_MANEUVER
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command the options of all experiments, after its own.

    Args:
        seeds: Default number of repetitions.
        scenarios: Default scenarios.
        quick_maneuver: Setting of the maneuver with `--quick`.
    """
    default_seeds, default_scenarios = seeds, scenarios

    def options(
        scenarios: ScenariosOption = None,
        settings: SetOption = None,
        seeds: SeedsOption = None,
        out: OutOption = None,
        jobs: JobsOption = None,
        dask: DaskOption = None,
        processes: ProcessesOption = False,
        quick: QuickOption = False,
    ) -> ExperimentOptions:
        return ExperimentOptions(
            settings=settings,
            seeds=seeds_or_default(seeds, default_seeds, quick=quick),
            out=out,
            jobs=jobs,
            quick=quick,
            names=tuple(scenarios or default_scenarios),
            dask=dask,
            processes=processes,
            quick_maneuver=quick_maneuver,
        )

    return with_options(options)
