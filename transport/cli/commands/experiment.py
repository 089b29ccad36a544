"""Commands `transport experiment`: one for each declared experiment, and the paper's comparison."""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import joblib
import numpy as np
import typer
from rich.console import Console
from typer import Option

from transport.cli.lazy import with_options
from transport.cli.options import RUNS, FormatOption, LargeOption
from transport.cli.output import Format, show
from transport.cli.setting_words import complete_setting
from transport.experiments import (
    design_experiments,
    information_experiment,
    network_experiments,
    radio_experiment,
    weather_experiment,
)
from transport.experiments.cases import Case, cases_of, refused
from transport.experiments.declaration import EXPERIMENTS, Experiment, Values
from transport.experiments.paper import comparison_report, controllers_and_periods
from transport.experiments.result_sentences import conclusions
from transport.experiments.result_tables import TITLE, WIDTH, table_of, write_markdown
from transport.experiments.simulation import Result
from transport.experiments.statistics import PointStatistics
from transport.experiments.sweep import Results, Swept, sweep
from transport.experiments.workers import check_cluster, on_cluster, on_cores
from transport.flight.run_files import machine
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.limits_on_size import ADMITTED, most_workers
from transport.protocol.scenario.sections.schema import Scenario

# The five modules are imported for their effect: each declares its experiments in `EXPERIMENTS`.
__all__ = [
    "EXPERIMENTS",
    "ExperimentOptions",
    "design_experiments",
    "information_experiment",
    "network_experiments",
    "radio_experiment",
    "weather_experiment",
]

_OUT = (
    "Folder, by default a new one in runs/; an existing folder of the same experiment is resumed."
)
_SCENARIO = (
    "Scenario file or name; default: paper and resilient (hover: also centralized; "
    "deaths, sharing: resilient; agile: eight; information: precise; follow: precise and resilient; "
    "weather: five). Repeatable."
)
_QUICK_SEEDS = 2
# Experiments that are drawn so measure processor times.
_TIMED = "scaling"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentOptions:
    """Options of one declared experiment: what is not given comes from its declaration."""

    declared: Experiment

    settings: Annotated[
        list[str] | None,
        Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a value of every scenario. Repeatable.",
            autocompletion=complete_setting,
        ),
    ] = None
    seeds: Annotated[
        int | None,
        Option(metavar="COUNT", min=1, help="Repetitions of random runs: seeds 0, 1, ..."),
    ] = None
    out: Annotated[Path | None, Option(metavar="FOLDER", help=_OUT)] = None
    jobs: Annotated[
        int | None,
        Option(metavar="COUNT", min=1, help="Parallel runs; default: all cores (scaling: 1)."),
    ] = None
    allow_large: LargeOption = False
    quick: Annotated[
        bool, Option("--quick", help="Few and short runs: a trial, no measurement.")
    ] = False
    output: FormatOption = Format.text
    scenarios: Annotated[
        list[str] | None, Option("--scenario", metavar="SCENARIO", help=_SCENARIO)
    ] = None
    dask: Annotated[
        str | None, Option(metavar="ADDRESS", help="Dask cluster, e.g. tcp://host:8786.")
    ] = None

    @property
    def repetitions(self) -> int:
        """Number of seeds of random runs."""
        if self.seeds:
            return self.seeds
        return min(self.declared.seeds, _QUICK_SEEDS) if self.quick else self.declared.seeds

    def changes(self) -> list[str]:
        """Return the changes of every scenario, the experiment's own maneuver first."""
        maneuver = self.declared.quick_maneuver if self.quick else self.declared.maneuver
        own = [maneuver] if maneuver else []
        return [*own, *(self.settings or [])]

    def read(self) -> dict[str, Scenario]:
        """Return the scenarios by name, with the changes of every scenario.

        There are none if the experiment has teams of its own.

        Raises: ExperimentError: options exclude each other. ScenarioError: a scenario is refused.
        """
        self.check_workers()
        names = self.scenarios or list(self.declared.scenarios)
        if len(set(names)) < len(names):
            raise refused("--scenario", "each value once", ", ".join(names))
        return {
            name: read_scenario(find_scenario(name), self.changes(), allow_large=self.allow_large)
            for name in names
        }

    def plan(
        self, given: Mapping[str, Any], *, simulated_before: bool = False
    ) -> tuple[Experiment, list[Case]]:
        """Return the experiment with its points for some of its own options, and all its runs.

        With `simulated_before` the setups are not checked, which takes a second for a large team.

        Raises: ExperimentError: options are refused. ScenarioError: a scenario is refused.
        """
        experiment = self.declared.experiment(self.read(), given, quick=self.quick)
        cases = cases_of(
            experiment.points,
            self.changes(),
            self.repetitions,
            more=experiment.more,
            allow_large=self.allow_large,
            simulated_before=simulated_before,
        )
        return experiment, cases

    def check_workers(self) -> None:
        """Refuse a cluster beside workers of this machine, or an address that is none.

        Raises: ExperimentError.
        """
        if self.dask is not None:
            if self.jobs is not None:
                raise refused("--dask", "only one of --dask and --jobs", "both")
            check_cluster(self.dask)

    def folder(self, name: str) -> Path:
        """Return the folder of an experiment; say that `--quick` gives no measurement."""
        if self.quick:
            typer.echo("--quick: a trial, no measurement", err=True)
        time_utc = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        return self.out or RUNS / f"experiment-{name}-{time_utc}"

    def simulate(self, cases: Sequence[Case]) -> Iterable[Result]:
        """Simulate cases: on a cluster, or on the cores of this machine.

        By default at most as many at a time as fit into the memory of a run.

        Raises: ExperimentError: more are asked for, without `--allow-large`.
        """
        if self.dask is not None:
            return on_cluster(cases, address=self.dask)

        jobs = min(len(cases), self.jobs or self.declared.jobs or joblib.cpu_count())
        most = jobs if self.allow_large else most_workers(case.scenario for case in cases)
        if jobs > most and self.jobs is not None:
            raise refused("--jobs", f"at most {most} runs so large", f"{jobs} ({ADMITTED})")
        return on_cores(cases, min(jobs, most))


def _options_of(declared: Experiment) -> Callable[..., ExperimentOptions]:
    """Return what makes the options of an experiment: values bound here are no options any more.

    An experiment with teams of its own takes neither --scenario nor --dask.
    """
    bound: dict[str, Any] = {} if declared.scenarios else {"scenarios": None, "dask": None}
    return partial(ExperimentOptions, declared=declared, **bound)


def _command(declared: Experiment) -> Callable[..., None]:
    """Return the command of a declared experiment: its own options, then the common ones."""

    def command(options: ExperimentOptions, **given: Any) -> None:
        _conduct(declared.name, options, given)

    command.__doc__ = declared.build.__doc__
    common = inspect.Parameter("options", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    own = [
        _parameter(option, values) for option, values in declared.options.items() if values.metavar
    ]
    command.__signature__ = inspect.Signature([common, *own])  # type: ignore[attr-defined]
    return with_options(_options_of(declared))(command)


def _parameter(name: str, values: Values) -> inspect.Parameter:
    """Return an option as a parameter of its command."""
    is_list = isinstance(values.default, list)
    example = values.default[0] if is_list else values.default
    kind: Any = list[type(example)] if is_list else type(example)  # type: ignore[misc]

    # With `--quick` another default may hold, and lists have none on the command line: None is the
    # default then, and the help tells the values.
    default = values.default
    text = values.help
    if is_list or values.quick is not None:
        default = None
        kind = kind | None
        text = _help_of(values)

    option = Option(
        f"--{name}", metavar=values.metavar, help=text, min=values.least, max=values.most
    )
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )


def _help_of(values: Values) -> str:
    """Return the help of an option with its default, which the command line does not show."""
    defaults = np.atleast_1d(values.default).tolist()
    texts = [value if isinstance(value, str) else f"{value:g}" for value in defaults]
    repeatable = " Repeatable." if isinstance(values.default, list) else ""
    separator = "; " if any("," in text for text in texts) else ", "
    return f"{values.help.rstrip('.')}; by default {separator.join(texts)}.{repeatable}"


def _conduct(name: str, options: ExperimentOptions, given: Mapping[str, Any]) -> None:
    """Simulate the cases of an experiment that have no result yet, and report all of them.

    Raises: ExperimentError: a case raised an error, a worker was lost, or the options are refused.
    """
    experiment, cases = options.plan(given)
    folder = options.folder(name)
    with Results(name, folder) as results:
        swept = sweep(experiment, cases, options.simulate, results, Console(stderr=True))

    measured = swept.measured
    sentences = conclusions(measured)
    table = table_of(_title(name, swept, options), measured)
    files = swept.write(folder)
    lines = write_markdown(folder, sentences, table, files)
    content = {
        "experiment": name,
        "points": [_content(point) for point in measured],
        "findings": sentences,
        "machine": machine(),
        "files": [str(file) for file in files],
    }
    show(options.output, content, table, *lines, width=WIDTH)
    swept.check()


def _title(name: str, swept: Swept, options: ExperimentOptions) -> str:
    """Return the title of a table; that of a timed experiment names its maneuver."""
    trial = " (trial, no measurement)" if options.quick else ""
    title = f"{name}{trial}: {TITLE}"
    if swept.experiment.drawn_as != _TIMED:
        return title

    phases = swept.cases[0].scenario.maneuver.phase  # the same in all cases
    duration_s = sum(phase.duration_s for phase in phases)
    return f"{title}\n{duration_s:g} s of {', '.join(phase.name for phase in phases)}"


@with_options(_options_of(controllers_and_periods.DECLARED))
def paper(
    options: ExperimentOptions,
    gust: float = Option(
        1.0, metavar="SPEED", help="Standard deviation of gusts, m/s; 0 for still air only."
    ),
) -> None:
    """The paper's claim: centralized against distributed.

    Runs both controllers at a grid of sampling periods and compares mean cost over processor time,
    which is measured first.

    Prints a table, and the cost at equal sampling rate and at equal computation as ranges; writes
    figures.

    Example: transport experiment paper --seeds 10
    """
    if not 0.0 <= gust < math.inf:
        raise refused("--gust", "a speed >= 0 m/s", f"{gust:g}")

    folder = options.folder("paper")
    compared = comparison_report.ComparisonOptions(
        settings=options.changes(),
        seeds=options.repetitions,
        gust_mps=gust,
        quick=options.quick,
        allow_large=options.allow_large,
    )
    console = Console(stderr=True)
    lines, table = comparison_report.compare(compared, folder, options.simulate, console)
    content = {"experiment": "paper", "report": [line.strip() for line in lines if line.strip()]}
    show(options.output, content, table, *lines, width=WIDTH)


def _content(statistics: PointStatistics) -> dict[str, Any]:
    """Return the statistics of a point as JSON data."""
    point = statistics.point
    return {
        "scenario": point.scenario,
        "point": point.text,
        "labels": dict(point.labels),
        "runs": statistics.runs,
        "completed": statistics.completed,
        "errors": statistics.errors,
        "diverged_s": list(statistics.diverged_s),
        "cost_ratio": statistics.cost_ratio,
        "numbers": {
            name: None if value is None else value._asdict()
            for name, value in statistics.numbers.items()
        },
    }


# Commands of the declared experiments by name.
COMMANDS = {name: _command(declared) for name, declared in EXPERIMENTS.items()}
