"""Kept results: a file docs/results/<table>.csv for each table, with a row for each run.

A row is found by the fingerprint of its scenario with its seed, which stays the same as long as the
scenario gives the same values to the same keys: a key that is added with a default, and a comment,
do not change it. Tables and figures are made from these rows, so numbers are rounded before they are
kept, and a diverged run has only the time at which it ends: the rest of it shows the rounding errors
of the machine, amplified.
"""

import csv
import hashlib
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

import threadpoolctl
from tables import ROOT, commit

from transport.experiments.cases import Case
from transport.experiments.simulation import Result
from transport.flight.run_files import machine, versions
from transport.model.kernels import compiler, native
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.sections.schema import Scenario

FOLDER = ROOT / "docs" / "results"

# Significant digits of numbers; tables show at most four.
DIGITS = 6
# Largest difference of two results of a run, relative: kernels for other processors change completed
# runs by less than 1e-6, plain ones by less than 1e-5, and rounding adds a unit of the last digit.
TOLERANCE = 2e-5
# Numbers below it are rounding errors.
LEAST = 1e-9
# Times of divergence differ by up to this factor between machines: an unstable run amplifies the
# last bit. On one machine they are equal.
DIVERGENCE_FACTOR = 1.4
# Beginning of the names of processor times, which are not repeatable.
TIMES = "cpu_"

_LABELS = ("run", "origin", "case", "seed", "outcome")


def run_id(scenario: Scenario) -> str:
    """Return the fingerprint of a scenario with its seed, without addresses and defaults."""
    tree = scenario.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    tree.pop("network", None)
    text = json.dumps(tree, sort_keys=True).replace(f"{ROOT}/", "")
    return _digest(text, 12)


@cache
def rounding_id() -> str:
    """Return the fingerprint of how this machine rounds: processor, kernels and BLAS."""
    processor = compiler.compiled_file("processor", b"", ()).name
    pools = threadpoolctl.threadpool_info()
    libraries = {
        f"{pool['architecture']} {pool['version']}" for pool in pools if pool["user_api"] == "blas"
    }
    return _digest("\n".join([processor, str(native.AVAILABLE), *sorted(libraries)]), 8)


def _digest(text: str, length: int) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:length]


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where results come from."""

    commit: str  # the last one that changed the simulation
    versions: str
    machine: str
    rounding: str  # fingerprint

    @classmethod
    @cache
    def here(cls) -> "Origin":
        """Return the origin of a result computed now."""
        return cls(
            commit=commit(),
            versions=versions(),
            machine=machine(),
            rounding=rounding_id(),
        )

    @property
    def name(self) -> str:
        """Name in the file of a table."""
        return _digest(json.dumps(asdict(self)), 6)

    @property
    def is_of_this_code(self) -> bool:
        """Whether the commit and the versions are those of a result computed now."""
        here = Origin.here()
        return (self.commit, self.versions) == (here.commit, here.versions)

    def text(self) -> str:
        """Return the origin for readers of a page."""
        return f"Commit {self.commit}; {self.versions}; {self.machine}"


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptRun:
    """The kept result of a run."""

    origin: Origin
    case: str  # in words
    seed: int
    result: Result


Runs = dict[str, KeptRun]  # by `run_id`


def kept_run(case: Case, text: str, result: Result) -> KeptRun:
    """Return the result of a run as it is kept."""
    return KeptRun(
        origin=Origin.here(),
        case=text,
        seed=case.scenario.seed,
        result=rounded(run_id(case.scenario), result),
    )


def rounded(run: str, result: Result) -> Result:
    """Return a result with the numbers that are kept; its key is the fingerprint of the run."""
    names = result.numbers if result.outcome == "completed" else ("lost_s",)
    numbers = {name: _rounded(result.numbers[name]) for name in names}
    return Result(key=run, outcome=result.outcome, reason="", numbers=numbers)


def _rounded(number: float | None) -> float | None:
    if number is None:
        return None
    return 0.0 if abs(number) < LEAST else float(f"{number:.{DIGITS}g}")


def difference(kept: KeptRun, result: Result) -> str:
    """Return in what a repeated run differs from the kept one; empty if it does not."""
    repeated = rounded(kept.result.key, result)
    if repeated.outcome != kept.result.outcome:
        return f"kept {kept.result.outcome}, now {repeated.outcome} {result.reason}".rstrip()

    for name, now in repeated.numbers.items():
        if name.startswith(TIMES):
            continue
        before = kept.result.numbers.get(name)
        if not _equal(before, now, _relative(name, kept)):
            return f"{name}: kept {before}, now {now}"
    return ""


def _relative(name: str, kept: KeptRun) -> float:
    """Return the largest relative difference of a number."""
    is_other_machine = kept.origin.rounding != rounding_id()
    if name == "lost_s" and is_other_machine:
        return 1.0 - 1.0 / DIVERGENCE_FACTOR
    return TOLERANCE


def _equal(before: float | None, now: float | None, relative: float) -> bool:
    if before is None or now is None:
        return before is now
    if math.isnan(before) and math.isnan(now):  # no UAV left that could be measured
        return True
    return math.isclose(before, now, rel_tol=relative, abs_tol=2 * LEAST)


def file_of(table: str) -> Path:
    """Return the file of a table."""
    return FOLDER / f"{table}.csv"


def read(file: Path) -> Runs:
    """Return the kept runs of a table in their order; none without a file.

    Raises: ValueError, KeyError: the file is damaged.
    """
    if not file.exists():
        return {}
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    origins = {}
    for line in lines:
        if line.startswith("# "):
            name, _, content = line.removeprefix("# ").partition(": ")
            values = json.loads(content)  # an earlier version kept a fingerprint of the code, too
            origins[name] = Origin(**{field.name: values[field.name] for field in fields(Origin)})

    rows = csv.DictReader(line for line in lines if not line.startswith("# "))
    return {row["run"]: _run_of(row, origins) for row in rows}


def _run_of(row: Mapping[str, str], origins: Mapping[str, Origin]) -> KeptRun:
    numbers = {
        name: float(text) if text else None
        for name, text in row.items()
        if name not in _LABELS and text != "-"
    }
    outcome = row["outcome"]
    return KeptRun(
        origin=origins[row["origin"]],
        case=row["case"],
        seed=int(row["seed"]),
        result=Result(key=row["run"], outcome=outcome, reason="", numbers=numbers),
    )


def write(file: Path, runs: Iterable[KeptRun]) -> None:
    """Write the runs of a table; "-" stands for a number that a run does not have."""
    kept = list(runs)
    origins = {run.origin.name: run.origin for run in kept}
    names = list(dict.fromkeys(name for run in kept for name in run.result.numbers))

    text = io.StringIO()
    for name, origin in origins.items():
        text.write(f"# {name}: {json.dumps(asdict(origin))}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_LABELS, *names])
    for run in kept:
        result = run.result
        labels = [result.key, run.origin.name, run.case, run.seed, result.outcome]
        writer.writerow([*labels, *(_cell(result, name) for name in names)])
    file.parent.mkdir(exist_ok=True)
    write_whole(file, text.getvalue().encode())


def _cell(result: Result, name: str) -> str:
    if name not in result.numbers:
        return "-"
    number = result.numbers[name]
    return "" if number is None else f"{number:.{DIGITS}g}"


def origin_lines(runs: Sequence[KeptRun]) -> str:
    """Return the origins of a table for readers of a page, one line each."""
    texts = dict.fromkeys(run.origin.text() for run in runs)
    return "\n".join(f"*{text}.*" for text in texts)
