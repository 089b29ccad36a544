"""Options of the commands `transport experiment`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from typer import Option

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from transport.cli.options import FormatOption, LargeOption
from transport.cli.output import Format
from transport.experiments.errors import refused

T = TypeVar("T", str, int, float)

# With --quick: a maneuver of 1.5 s, and two repetitions of random runs.
_QUICK_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
_QUICK_SEEDS = 2

_OUT = "Folder, by default a new one in runs/; an existing folder of the same experiment is resumed."
_SCENARIO = (
    "Scenario file or name; default: paper and resilient (hover: also centralized; "
    "deaths, sharing: resilient). Repeatable."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentOptions:
    """Options of all experiments, and the defaults of one."""

    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=VALUE", help="Change a value of every scenario. Repeatable.")
    ] = None
    seeds: Annotated[
        int | None, Option("--seeds", metavar="COUNT", min=1, help="Repetitions of random runs: seeds 0, 1, ...")
    ] = None
    out: Annotated[Path | None, Option("--out", metavar="FOLDER", help=_OUT)] = None
    jobs: Annotated[
        int | None, Option("--jobs", metavar="COUNT", min=1, help="Parallel runs; default: all cores (scaling: 1).")
    ] = None
    allow_large: LargeOption = False
    quick: Annotated[bool, Option("--quick", help="Few and short runs: a trial, no measurement.")] = False
    output: FormatOption = Format.text
    # Not options, as they are not annotated.
    default_seeds: int = 1
    default_jobs: int | None = None
    maneuver: str = ""
    quick_maneuver: str = _QUICK_MANEUVER

    @property
    def repetitions(self) -> int:
        """Number of seeds of random runs."""
        default = min(self.default_seeds, _QUICK_SEEDS) if self.quick else self.default_seeds
        return default if self.seeds is None else self.seeds

    def choose(self, given: list[T] | None, default: list[T], *, quick: list[T]) -> list[T]:
        """Return the values of an option: those given, or its default with or without `--quick`."""
        return given or (quick if self.quick else default)

    def changes(self) -> list[str]:
        """Return the changes of every scenario, the experiment's own maneuver first."""
        maneuver = self.quick_maneuver if self.quick else self.maneuver
        return [*([maneuver] if maneuver else []), *(self.settings or [])]


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions(ExperimentOptions):
    """Options of experiments with any scenario."""

    scenarios: Annotated[list[str] | None, Option("--scenario", metavar="SCENARIO", help=_SCENARIO)] = None
    dask: Annotated[str | None, Option("--dask", metavar="ADDRESS", help="Dask cluster, e.g. tcp://host:8786.")] = None
    processes: Annotated[
        bool, Option("--processes", help="Run each case with processes and a run folder, one at a time.")
    ] = False
    default_scenarios: tuple[str, ...] = ("paper", "resilient")

    @property
    def names(self) -> list[str]:
        """Scenarios to run."""
        return self.scenarios or list(self.default_scenarios)

    def read(self) -> dict[str, Scenario]:
        """Return the scenarios by name, with the changes of every scenario.

        Raises: ExperimentError: one is named twice. ScenarioError: one is refused.
        """
        if len(set(self.names)) < len(self.names):
            raise refused("--scenario", "each value once", ", ".join(self.names))
        return {
            name: read_scenario(find_scenario(name), self.changes(), allow_large=self.allow_large)
            for name in self.names
        }
