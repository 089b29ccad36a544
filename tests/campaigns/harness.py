"""One campaign: many runs drawn from a seed and their numbers, executed several at a time, tabulated and judged.

A campaign is a function that executes one run in a folder of its own and returns a `Result`. Every
run can be repeated by its number. Folders of runs with problems are kept.
"""

import argparse
import shutil
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of one run.

    Attributes:
        number: Number of the run.
        label: Kind of the run: its row of the table.
        outcome: What became of it, as "exit 0".
        problems: Descriptions by kind of problem.
        details: What was drawn, a line each.
    """

    number: int
    label: str
    outcome: str
    problems: Mapping[str, str] = field(default_factory=dict)
    details: tuple[str, ...] = ()


# Arguments: seed, number, folder of the run, and an event that ends the run early.
Execute = Callable[[int, int, Path, threading.Event], Result]


def table(results: Sequence[Result]) -> Iterator[str]:
    """Yield a line for each kind of run: how often each outcome and each problem came."""
    rows: dict[str, Counter[str]] = {}
    for result in results:
        rows.setdefault(result.label, Counter()).update([result.outcome, *result.problems])
    for label, counts in sorted(rows.items()):
        yield f"{label:<46}" + ", ".join(
            f"{count} x {outcome}" for outcome, count in sorted(counts.items())
        )


def execute_all(
    execute: Execute, seed: int, numbers: Sequence[int], folder: Path, jobs: int = 1
) -> Iterator[Result]:
    """Execute runs, `jobs` at a time, and yield their results as they come.

    Keep the folders of those with problems.
    """
    stop = threading.Event()

    def one(number: int) -> Result:
        own = folder / str(number)
        shutil.rmtree(own, ignore_errors=True)  # kept by an earlier campaign
        own.mkdir(parents=True)
        result = execute(seed, number, own, stop)
        if not result.problems:
            shutil.rmtree(own, ignore_errors=True)
        return result

    with ThreadPoolExecutor(jobs) as pool:
        try:
            for future in as_completed([pool.submit(one, number) for number in numbers]):
                yield future.result()
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    with suppress(OSError):
        folder.rmdir()  # only if no folder was kept


def conduct(name: str, execute: Execute, options: argparse.Namespace) -> int:
    """Execute a campaign with the options of the command line, print table and problems, and return the exit code.

    Returns: 1 if any run has a problem, 130 after an interrupt, otherwise 0.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The commands inherit these: they would ignore SIGINT in the background of a shell, and SIGHUP
    # under nohup.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    folder = (options.out or Path("runs") / f"{name}-{options.seed}").resolve()
    results = []
    try:
        numbers = range(options.first, options.first + options.runs)
        for result in execute_all(execute, options.seed, numbers, folder, options.jobs):
            results.append(result)
            said = ", ".join(result.problems) or "no problem"
            sys.stderr.write(f"{name} {result.number}: {result.label}: {result.outcome}: {said}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    lines = list(table(results))
    bad = sorted(
        (result for result in results if result.problems), key=lambda result: result.number
    )
    for result in bad:
        number = result.number
        again = f"python -m tests.campaigns {name} --seed {options.seed} --first {number} --runs 1"
        lines += ["", f"run {number}, kept in {folder / str(number)}; repeat with:", f"  {again}"]
        lines += [f"  {kind}: {text}" for kind, text in result.problems.items()]
        lines += [f"  {line}" for line in result.details]
    lines.append(f"{name}, seed {options.seed}: {len(results)} runs, {len(bad)} with problems")
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if bad else 0
