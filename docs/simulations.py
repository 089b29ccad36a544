"""Simulations behind the measured tables of documents: in memory, on all cores, kept for each commit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console
from tables import ROOT, commit, place, put, table

from protocol.scenario.setup import Setup
from protocol.wire.messages import Control
from transport.analysis.series import series_of
from transport.experiments.cases import Case, Point, Team, cases_of
from transport.experiments.declaration import Experiment, axis
from transport.experiments.simulation import Result
from transport.experiments.sweep import Results, sweep
from transport.experiments.workers import on_cores
from transport.flight.header import machine, versions
from transport.log.run_log import RunLog

RESULTS = ROOT / "runs" / "figures" / "simulations"
DIVERGED = "diverged"


@dataclass(frozen=True, slots=True)
class Run:
    """A scenario with changes, or a team in place of its own, simulated with the seeds 0, 1, ..."""

    scenario: str
    settings: tuple[str, ...] = ()
    team: Team | None = None
    seeds: int = 1


# Numbers of a result by name (`transport.experiments.simulation.NUMBERS` and `more`), with `completed` and `phase`, the
# phase in which it ended; or a list of these for several seeds.
Flown = Any


@dataclass(frozen=True, slots=True)
class Measured:
    """A table of a document.

    Attributes:
        name: Name of its markers.
        headings: Headings of its columns.
        rows: Simulations of each row, None for those left out, by its first cell or cells.
        cells: Function that returns the other cells, given the first one and the results.
    """

    name: str
    headings: Sequence[str]
    rows: Mapping[Any, Sequence[Run | None]]
    cells: Callable[..., Sequence[str]]

    def text(self, found: Mapping[Run, Flown]) -> str:
        """Return the table in Markdown."""
        lines = []
        for key, runs in self.rows.items():
            first = [key] if isinstance(key, str) else list(key)
            lines.append([*first, *self.cells(first[0], *(run and found[run] for run in runs))])
        return table(self.headings, lines)


def each(cell: Callable[[Flown], str], without: str = "") -> Callable[..., list[str]]:
    """Return the function for rows with a cell for each simulation, and a text for those left out."""
    return lambda _, *results: [without if result is None else cell(result) for result in results]


def number(value: float, digits: int = 2) -> str:
    """Return a number with so many digits behind the point."""
    return f"{value:.{digits}f}"


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, without an exponent."""
    return np.format_float_positional(value, precision=digits, fractional=False, unique=False, trim="k").rstrip(".")


def attitude(result: Flown) -> str:
    """Return the largest payload attitude."""
    return f"{result.attitude_max_deg:.2f} deg"


def cost(result: Flown) -> str:
    """Return the mean cost."""
    return significant(result.cost_mean)


def or_diverged(result: Flown, cell: Callable[[Flown], str]) -> str:
    """Return a cell, or when the run diverged."""
    return cell(result) if result.completed else f"{DIVERGED} at {result.lost_s:.0f} s ({result.phase})"


def renew(
    document: Path,
    tables: Sequence[Measured],
    texts: Mapping[str, Callable[[], str]] | None = None,
    version: str = "",
) -> None:
    """Simulate, and renew tables and further texts of a document and the line that says where they come from.

    The version is that of another package.

    Raises: SystemExit: the document lacks markers.
    """
    for name in ("origin", *(part.name for part in tables), *(texts or {})):
        place(document, name)  # refused before minutes are spent
    now, found = _results([run for part in tables for runs in part.rows.values() for run in runs if run])
    for part in tables:
        put(document, part.name, part.text(found))
    for name, text in (texts or {}).items():
        put(document, name, text())
    put(document, "origin", f"*Commit {now}; {versions()}{version}; {machine()}.*")


def _results(runs: Sequence[Run]) -> tuple[str, Mapping[Run, Flown]]:
    """Run the missing simulations; return the commit and all results."""
    now, different = commit(), list(dict.fromkeys(runs))
    kept = None if "changes" in now or now == "unknown" else RESULTS / now
    cases: list[Case] = []
    owner: list[Run] = []
    points = []
    for index, run in enumerate(different):
        points.append(
            Point(scenario=run.scenario, labels={}, text=" ".join(run.settings), settings=run.settings, team=run.team)
        )
        own = cases_of(points[-1:], (), run.seeds, more=more)
        cases += [replace(case, point=index) for case in own]
        owner += [run] * len(own)
    experiment = Experiment(name="pages", points=tuple(points), x=axis("point"))
    with Results("pages", kept) as results:
        # Large teams and long runs first: no core is idle while the last of them ends.
        def simulated(missing: Sequence[Case]) -> Any:
            return on_cores(sorted(missing, key=_effort, reverse=True))

        swept = sweep(experiment, cases, simulated, results, Console(stderr=True))
    swept.check()
    found: dict[Run, list[Flown]] = {}
    for run, case, result in zip(owner, cases, swept.results, strict=True):
        found.setdefault(run, []).append(_flown(case, result))
    return now, {run: several if run.seeds > 1 else several[0] for run, several in found.items()}


def _flown(case: Case, result: Result) -> Flown:
    phase = _phase_name(case, int(result.numbers["phase"] or 0))
    return SimpleNamespace(**{**result.numbers, "completed": result.outcome == "completed", "phase": phase})


def more(setup: Setup, summary: Any, log: RunLog) -> dict[str, float | None]:
    """Return the largest cost after the first phase; the index of the last phase; and errors at the end, m.

    That is the largest distance of a UAV and the distance of the payload from their references at the last tick, and
    the largest x of a UAV.
    """
    series = series_of(setup, log)
    end_s = next(log.of(Control)).tick * setup.settings.sampling_period_s
    ends_s = np.cumsum([phase.duration_s for phase in setup.maneuver.phases])
    return {
        "cost_max_settled": summary["cost"]["max_after_hover"],
        "phase": float(min(int(np.searchsorted(ends_s, end_s - 1e-9)), len(ends_s) - 1)),
        "uav_last_m": float(np.linalg.norm(series.uav_errors_I[-1], axis=1).max()),
        "payload_last_m": float(np.linalg.norm(series.payload_error_I[-1])),
        "front_m": float(series.uavs_I[:, :, 0].max()),
    }


def _phase_name(case: Case, index: int) -> str:
    """Return the name of a phase; of two with the same name, which one."""
    names = [phase.name for phase in case.scenario.maneuver.phase]
    same = [i for i, name in enumerate(names) if name == names[index]]
    which = "first " if index == same[0] else "last " if index == same[-1] else ""
    return f"{which}{names[index]}" if len(same) > 1 else names[index]


def _effort(case: Case) -> float:
    """Return about how long a case takes, in any unit."""
    return float(len(case.scenario.system.uav) ** 2 * sum(p.duration_s or 0.0 for p in case.scenario.maneuver.phase))
