"""Conducting an experiment: simulations, tables, figures and the exit code of the command."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial, wraps
from pathlib import Path
from typing import Any

import joblib
from rich.console import Console
from rich.table import Table

from protocol.scenario.budget import ADMITTED, MB, MOST_TOTAL_BYTES, most_workers
from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import EXIT_CASE_FAILED, EXIT_INTERRUPTED, EXIT_SCENARIO
from transport.cli.experiment.options import ExperimentOptions, SweepOptions
from transport.cli.options import RUNS, with_options
from transport.cli.output import Format, exit_on, fail, show_json
from transport.experiments.cases import Case, cases_of
from transport.experiments.conclusions import conclusions
from transport.experiments.errors import ExperimentError, refused
from transport.experiments.experiment import Experiment
from transport.experiments.results import Results
from transport.experiments.scaling import scaling_conclusions
from transport.experiments.simulation import Result, simulate_in_processes
from transport.experiments.statistics import PointStatistics
from transport.experiments.sweep import Simulate, report, sweep
from transport.experiments.table import WIDTH, WIDTH_OF_VARIANTS, means_in_words, table_of
from transport.experiments.workers import check_cluster, on_cluster, on_cores
from transport.flight.header import machine


def sweep_command(
    kind: type[ExperimentOptions] = SweepOptions, **defaults: Any
) -> Callable[[Callable[..., Experiment]], Callable[..., None]]:
    """Return a decorator that makes a command of a function that returns an experiment; defaults are its options."""

    def decorate(build: Callable[..., Experiment]) -> Callable[..., None]:
        @with_options(partial(kind, **defaults))
        @wraps(build)
        def command(options: ExperimentOptions, **own: Any) -> None:
            with exit_codes():
                conduct(build(options, **own), options)

        return command

    return decorate


@contextmanager
def exit_codes() -> Iterator[None]:
    """End the command with the exit code of an error or interrupt."""
    try:
        with exit_on(ExperimentError), exit_on(ScenarioError, code=EXIT_SCENARIO):
            yield
    except KeyboardInterrupt:
        fail("interrupted", EXIT_INTERRUPTED)


def conduct(experiment: Experiment, options: ExperimentOptions) -> None:
    """Simulate the cases of an experiment that have no result yet, and report all of them.

    Raises: ExperimentError: a case raised an error, a worker was lost, or the options are refused.
    """
    if isinstance(options, SweepOptions):
        _check(options)
    folder = new_folder(options, experiment.name)
    cases = cases_of(
        experiment.points,
        options.changes(),
        options.repetitions,
        timed=experiment.timed,
        allow_large=options.allow_large,
    )
    console = Console(stderr=True)
    trial = trial_note(options, console)
    with Results(folder, experiment.name, machine()) as results:
        done = sum(results.done(case.key) for case in cases)
        if done:
            console.print(f"{done} of {len(cases)} runs are done already", highlight=False)
        found = sweep(experiment, cases, simulator(options, folder), results, console)
        measured, files = report(experiment, cases, found, folder)
    title = f"{experiment.name}: {means_in_words(measured)}" + (f" ({trial})" if trial else "")
    if experiment.timed:
        phases = cases[0].scenario.maneuver.phase  # the same in all cases
        title += f"\n{sum(phase.duration_s for phase in phases):g} s of {', '.join(phase.name for phase in phases)}"
    width = WIDTH_OF_VARIANTS if experiment.drawn_as == "variants" else WIDTH
    sentences = scaling_conclusions(measured) if experiment.timed else conclusions(measured)
    lines = ["", *sentences, "", f"machine: {machine()}", *(f" {path}" for path in files)]
    content = {
        "experiment": experiment.name,
        "points": [_content(m) for m in measured],
        "findings": sentences,
        "machine": machine(),
        "files": [str(path) for path in files],
    }
    show(table_of(title, measured, timed=experiment.timed), width, lines, found, content, options.output)


def new_folder(options: ExperimentOptions, name: str) -> Path:
    """Return the folder of an experiment."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    return options.out or RUNS / f"experiment-{name}-{stamp}"


def trial_note(options: ExperimentOptions, console: Console) -> str:
    """Return, and print, a note that `--quick` gives no measurement; empty without it."""
    if not options.quick:
        return ""
    console.print("--quick: a trial, no measurement", highlight=False)
    return "trial, no measurement"


def simulator(options: ExperimentOptions, folder: Path) -> Simulate:
    """Return the function that simulates cases: on a cluster, in processes, or on the cores of this machine."""
    if isinstance(options, SweepOptions):
        if options.dask is not None:
            return partial(on_cluster, address=options.dask)
        if options.processes:
            return lambda cases: (simulate_in_processes(case, folder / "runs") for case in cases)
    return lambda cases: on_cores(cases, _jobs(options, cases))


def _jobs(options: ExperimentOptions, cases: Sequence[Case]) -> int:
    """Return how many cases are simulated at a time: by default at most as many as fit into the memory of a run.

    Raises: ExperimentError: more are asked for, without `--allow-large`.
    """
    jobs = min(len(cases), options.jobs or options.default_jobs or joblib.cpu_count())
    most = jobs if options.allow_large else most_workers(case.scenario for case in cases)
    if jobs > most and options.jobs is not None:
        memory = f"{MOST_TOTAL_BYTES / MB:,.0f} MB of memory in all"
        raise refused("--jobs", f"at most {most}, which take {memory}", f"{jobs} ({ADMITTED})")
    return min(jobs, most)


def _content(m: PointStatistics) -> dict[str, Any]:
    """Return the statistics of a point as JSON data."""
    return {
        "scenario": m.point.scenario,
        "point": m.point.text,
        "labels": dict(m.point.labels),
        "runs": m.runs,
        "completed": m.completed,
        "errors": m.errors,
        "diverged_s": list(m.diverged_s),
        "cost_ratio": m.cost_ratio,
        "numbers": {name: None if value is None else asdict(value) for name, value in m.numbers.items()},
    }


def show(
    table: Table, width: int, lines: Sequence[str], found: Sequence[Result], content: Mapping[str, Any], form: Format
) -> None:
    """Print table and findings, or the same as JSON, then raise an error if a case has no result.

    Raises: ExperimentError: a run raised an error.
    """
    if form is Format.json:
        show_json(content)
    else:
        output = Console()
        output.width = max(output.width, width)
        output.print(table)
        sys.stdout.write("\n".join(lines) + "\n")
    failed = [result for result in found if result.outcome == "error"]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise ExperimentError(f"a run raised an error{more}: {failed[0].reason}", EXIT_CASE_FAILED)


def _check(options: SweepOptions) -> None:
    """Refuse options that exclude each other, and a cluster that does not answer."""
    given = {"--processes": options.processes, "--dask": options.dask is not None, "--jobs": options.jobs is not None}
    chosen = [name for name, is_given in given.items() if is_given]
    if len(chosen) > 1:
        raise refused(chosen[0], "only one of --processes, --dask, --jobs", f"also {chosen[1]}")
    if options.dask is not None:
        check_cluster(options.dask)
