"""Statistics of repetitions, means with 95 % confidence intervals for each point of a sweep, and their tables."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rich.table import Table
from scipy.special import stdtrit

from transport.experiments.cases import Point
from transport.experiments.simulation import ERROR, Result

CONFIDENCE = 0.95

# Numbers of a point beside those of its runs.
FIRST_DIVERGED, COST_RATIO = "first_lost_s", "cost_ratio"


class Estimate(NamedTuple):
    """A mean with its uncertainty."""

    mean: float
    half_width: float | None  # half the 95 % confidence interval of the mean; None for a single value
    n: int  # number of repetitions


def estimate(values: Sequence[float]) -> Estimate | None:
    """Return mean and Student's 95 % confidence interval of independent repetitions; None without any.

    Half the interval is t s / sqrt(n), with the sample standard deviation s (n - 1 degrees of freedom) and the 0.975
    quantile t of Student's distribution. It is exact for normally distributed values.
    """
    n = len(values)
    if n == 0:
        return None
    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, 1)
    t = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2.0))
    return Estimate(mean, t * statistics.stdev(values) / math.sqrt(n), n)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointStatistics:
    """Statistics of the runs of one point.

    The cost ratio is the mean cost over that of the baseline, if both are known. The baseline has the same scenario,
    group and number of UAVs.
    """

    point: Point
    runs: int  # number of simulated runs, without errors
    completed: int  # number of runs that reached the end of the maneuver
    errors: int  # number of runs that could not be simulated
    diverged_s: tuple[float, ...]  # scenario times at which the other runs ended, ascending, s
    numbers: Mapping[str, Estimate | None]  # over the completed runs, by name (simulation.NUMBERS)
    cost_ratio: float | None

    def mean(self, name: str) -> float | None:
        """Return the mean of a number, or the cost ratio; None where no run was completed."""
        if name == COST_RATIO:
            return self.cost_ratio
        value = self.numbers[name]
        return None if value is None else value.mean

    def row(self) -> dict[str, Any]:
        """Return values by column, as in points.csv."""
        row: dict[str, Any] = {"scenario": self.point.scenario, **self.point.labels, "flights": self.runs}
        row |= {"completed": self.completed, "errors": self.errors}
        row |= {FIRST_DIVERGED: min(self.diverged_s, default=None), COST_RATIO: self.cost_ratio}
        for name, value in self.numbers.items():
            row |= {name: value and value.mean, f"{name}_ci95": value and value.half_width}
        return row


def statistics_of(
    points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]
) -> list[PointStatistics]:
    """Return the statistics of each point.

    Costs of diverged runs are left out: they cover only part of the maneuver.
    """
    numbers = [{name: estimate(_completed(found, name)) for name in names} for found in results]
    baselines = {
        _comparable(point): cost.mean
        for point, own in zip(points, numbers, strict=True)
        if point.baseline and (cost := own["cost_mean"]) is not None
    }
    made = []
    for point, found, own in zip(points, results, numbers, strict=True):
        simulated = [result for result in found if result.outcome != ERROR]
        cost, baseline = own["cost_mean"], baselines.get(_comparable(point))
        ends_s = [result.numbers["lost_s"] for result in simulated]
        made.append(
            PointStatistics(
                point=point,
                runs=len(simulated),
                completed=sum(result.outcome == "completed" for result in simulated),
                errors=len(found) - len(simulated),
                diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
                numbers=own,
                cost_ratio=cost.mean / baseline if cost is not None and baseline else None,
            )
        )
    return made


def _comparable(point: Point) -> tuple[str, str, int]:
    """Return scenario, group and number of UAVs, which a point has in common with its baseline."""
    return point.scenario, point.group, 0 if point.team is None else point.team.uavs


def _completed(results: Sequence[Result], name: str) -> list[float]:
    """Return a number of the completed runs that have it."""
    values = [result.numbers[name] for result in results if result.outcome == "completed"]
    return [value for value in values if value is not None]


WIDTH, WIDTH_OF_VARIANTS = 100, 140

# Numbers from here on are shown without decimals.
_LARGE = 100.0


class Column(NamedTuple):
    """A column of the console's table: heading, name of the number, factor, digits, whether intervals are shown."""

    heading: str
    name: str
    factor: float = 1.0
    digits: int = 2
    interval: bool = False

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the number of a row as text."""
        values = [row[self.name], row.get(f"{self.name}_ci95") if self.interval else None]
        shown = [self.factor * value for value in values if value is not None]
        return " ±".join(f"{v:.{self.digits if abs(v) < _LARGE else 0}f}" for v in shown) or "-"


_DIVERGED = Column("div.\n(s)", FIRST_DIVERGED, 1.0, 1)
_COST = Column("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True)
_RATIO = Column("cost\nratio", COST_RATIO)
_ATTITUDE = Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True)
_SWING = Column("swing\n(m)", "swing_m")
_APART = Column("apart\n(m)", "separation_min_m", 1.0, 3)
_AGE = Column("age\n(tick)", "plan_age_mean_ticks")
_COLUMNS = [_DIVERGED, _COST, _RATIO, Column("max\n(1e-3)", "cost_max", 1e3, 1), _ATTITUDE, _SWING, _APART, _AGE]

# Columns of runs in which agents do not send every plan, and of runs at several speeds, by a label that these have.
_FURTHER = {
    "share_threshold": [
        Column("plans\nsent (%)", "plans_shared_share", 100.0, 1, True),
        *(_COST, _RATIO, _ATTITUDE, _AGE),
    ],
    "speed_mps": [
        Column("error rms\n(cm)", "payload_rms_m", 100.0, 2, True),
        Column("largest\n(cm)", "payload_max_m", 100.0, 1),
        *(_DIVERGED, _RATIO, _ATTITUDE, _APART, _AGE),
    ],
}

# Columns of timed runs.
_TIMED_COLUMNS = [
    Column("CPU step\np50 (ms)", "cpu_step_p50_ms", 1.0, 2, True),
    Column("p99\n(ms)", "cpu_step_p99_ms"),
    Column("team\n(ms)", "cpu_team_tick_ms", 1.0, 1),
    Column("run\n(s/s)", "cpu_flight_s_per_s"),
    Column("plans\n/tick", "plans_per_tick", 1.0, 0),
    Column("\nkB/s", "plan_bytes_per_s", 1e-3, 1),
    Column("cost\n(1e-3)", "cost_mean", 1e3),
    _RATIO,
    Column("attitude\n(deg)", "attitude_max_deg"),
    _SWING,
]


def means_in_words(measured: Sequence[PointStatistics]) -> str:
    """Return the title of a table: a single run for each point has no confidence interval."""
    repeated = any(number is not None and number.n > 1 for m in measured for number in m.numbers.values())
    return "means of completed runs" + ", ± 95 % confidence" * repeated


def table_of(title: str, measured: Sequence[PointStatistics], *, timed: bool = False) -> Table:
    """Return the table for the console, `WIDTH` characters wide; timed points have one scenario and more columns."""
    names = list(measured[0].point.labels)
    columns = next((_FURTHER[name] for name in names if name in _FURTHER), _COLUMNS)
    headings = {name: name.replace("_", "\n", 1) for name in names}
    if timed:
        columns = _TIMED_COLUMNS
    else:
        headings = {"scenario": "scenario", **headings}
    return console_table(title, headings, columns, [m.row() for m in measured])


def console_table(
    title: str, labels: Mapping[str, str], columns: Sequence[Column], rows: Sequence[Mapping[str, Any]]
) -> Table:
    """Return a table for the console: labels with their headings, number of completed runs, columns of numbers."""
    table = Table(box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0))
    for heading in labels.values():
        table.add_column(heading, no_wrap=True)
    for heading in ("done", *(column.heading for column in columns)):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        texts = [value if isinstance(value := row[name], str) else f"{value:g}" for name in labels]
        done = f"{row['completed']}/{row['flights']}" + (f" {row['errors']}!" if row.get("errors") else "")
        table.add_row(*texts, done, *(column.cell(row) for column in columns))
    return table
