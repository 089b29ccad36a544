"""Simulations behind the measured tables of documents: in memory, on all cores, kept for each commit."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from tables import ROOT, commit, place, put, table

from protocol.scenario.setup import Setup
from protocol.wire.messages import Control
from transport.analysis.series import series_of
from transport.experiments.cases import Case, Point, Team, cases_of
from transport.experiments.simulation import Result
from transport.experiments.sweep import simulated
from transport.flight.header import machine, versions
from transport.log.run_log import RunLog

RESULTS = ROOT / "runs" / "figures" / "simulations"
DIVERGED = "diverged"


class Run(NamedTuple):
    """A scenario with changes, or a team in place of its own, simulated with the seeds 0, 1, ..."""

    scenario: str
    settings: tuple[str, ...] = ()
    team: Team | None = None
    seeds: int = 1


# Numbers of a result by name (`transport.experiments.simulation.NUMBERS` and `more`), with `completed` and `phase`, the
# phase in which it ended; or a list of these for several seeds.
Flown = Any


class Measured(NamedTuple):
    """A table of a document."""

    name: str  # of its markers
    headings: Sequence[str]
    rows: Mapping[Any, Sequence[Run | None]]  # runs of each row, None for those left out, by its first cell or cells
    cells: Callable[..., Sequence[str]]  # returns the other cells, given the first one and the results

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
    now = commit()
    kept = None if "changes" in now or now == "unknown" else RESULTS / now
    found = _results([run for part in tables for runs in part.rows.values() for run in runs if run], kept)
    for part in tables:
        put(document, part.name, part.text(found))
    for name, text in (texts or {}).items():
        put(document, name, text())
    put(document, "origin", f"*Commit {now}; {versions()}{version}; {machine()}.*")


def _results(runs: Sequence[Run], kept: Path | None) -> Mapping[Run, Flown]:
    """Run the missing simulations; return all results."""
    groups = {}
    for run in dict.fromkeys(runs):
        point = Point({}, " ".join(run.settings), run.settings, team=run.team, scenario=run.scenario)
        groups[run] = cases_of([point], (), run.seeds, more=more)
    results = simulated("pages", list(groups.values()), kept)
    found: dict[Run, Flown] = {}
    for (run, cases), own in zip(groups.items(), results, strict=True):
        several = [_flown(case, result) for case, result in zip(cases, own, strict=True)]
        found[run] = several if run.seeds > 1 else several[0]
    return found


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


def _flown(case: Case, result: Result) -> Flown:
    """Return the numbers; of two phases with the same name, the phase says which one."""
    names = [phase.name for phase in case.scenario.maneuver.phase]
    index = int(result.numbers["phase"] or 0)
    same = [i for i, name in enumerate(names) if name == names[index]]
    which = "" if len(same) == 1 else "first " if index == same[0] else "last " if index == same[-1] else ""
    found = {"completed": result.outcome == "completed", "phase": f"{which}{names[index]}"}
    return SimpleNamespace(**{**result.numbers, **found})
