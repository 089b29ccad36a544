"""Statistics of repetitions: means with 95 % confidence intervals of each point of a sweep, in tables and sentences."""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from scipy.special import stdtrit

from transport.experiments.cases import ERROR, Point, Result

# Numbers of a point beside those of its runs.
FIRST_DIVERGED, COST_RATIO = "first_lost_s", "cost_ratio"


class Estimate(NamedTuple):
    """A mean with its uncertainty."""

    mean: float
    half_width: (
        float | None
    )  # half the 95 % confidence interval of the mean; None for a single value
    n: int  # number of repetitions


def estimate(values: Sequence[float]) -> Estimate | None:
    """Return mean and Student's 95 % confidence interval of independent repetitions; None without any.

    Half the interval is t s / sqrt(n), with the sample standard deviation s (n - 1 degrees of freedom) and the 0.975
    quantile t of Student's distribution. It is exact for normally distributed values.
    """
    n = len(values)
    if n == 0:
        return None
    half_width = (
        float(stdtrit(n - 1, 0.975)) * statistics.stdev(values) / math.sqrt(n) if n > 1 else None
    )
    return Estimate(math.fsum(values) / n, half_width, n)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointStatistics:
    """Statistics of the runs of one point.

    The cost ratio is the mean cost over that of the baseline, if both are known. The baseline has the same scenario
    and group.
    """

    point: Point
    runs: int  # number of simulated runs, without errors
    completed: int  # number of runs that reached the end of the maneuver
    errors: int  # number of runs that could not be simulated
    diverged_s: tuple[float, ...]  # scenario times at which the other runs ended, ascending, s
    numbers: Mapping[str, Estimate | None]  # over the completed runs, by name (cases.NUMBERS)
    cost_ratio: float | None

    def mean(self, name: str) -> float | None:
        """Return the mean of a number, or the cost ratio; None where no run was completed."""
        if name == COST_RATIO:
            return self.cost_ratio
        value = self.numbers[name]
        return None if value is None else value.mean

    def row(self) -> dict[str, Any]:
        """Return values by column, as in points.csv."""
        row: dict[str, Any] = {
            "scenario": self.point.scenario,
            **self.point.labels,
            "flights": self.runs,
        }
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
    made: list[PointStatistics] = []
    baselines = {}
    for point, found in zip(points, results, strict=True):
        simulated = [result for result in found if result.outcome != ERROR]
        done = [result.numbers for result in simulated if result.outcome == "completed"]
        estimates = {
            name: estimate([value for numbers in done if (value := numbers.get(name)) is not None])
            for name in names
        }
        ends_s = (result.numbers["lost_s"] for result in simulated)
        m = PointStatistics(
            point=point,
            runs=len(simulated),
            completed=len(done),
            errors=len(found) - len(simulated),
            diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
            numbers=estimates,
            cost_ratio=None,
        )
        made.append(m)
        if point.baseline:
            baselines[point.scenario, point.group] = m.mean("cost_mean")
    return [
        replace(m, cost_ratio=cost / baseline)
        if (baseline := baselines.get((m.point.scenario, m.point.group)))
        and (cost := m.mean("cost_mean")) is not None
        else m
        for m in made
    ]


# Most characters in a line of a table, and its title.
WIDTH, TITLE = 140, "means of completed runs, ± 95 % confidence"

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
        values = [row.get(self.name), row.get(f"{self.name}_ci95") if self.interval else None]
        shown = [self.factor * value for value in values if value is not None]
        return " ±".join(f"{v:.{self.digits if abs(v) < _LARGE else 0}f}" for v in shown) or "-"


_DIVERGED = Column("div.\n(s)", FIRST_DIVERGED, 1.0, 1)
_COST = Column("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True)
_RATIO = Column("cost\nratio", COST_RATIO)
_ATTITUDE = Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True)
_SWING = Column("swing\n(m)", "swing_m")
_APART = Column("apart\n(m)", "separation_min_m", 1.0, 3)
_AGE = Column("age\n(tick)", "plan_age_mean_ticks")
_COLUMNS = [
    _DIVERGED,
    _COST,
    _RATIO,
    Column("max\n(1e-3)", "cost_max", 1e3, 1),
    _ATTITUDE,
    _SWING,
    _APART,
    _AGE,
]

# Columns of experiments whose points have a label: plans that are not sent, speeds, and teams, which are timed.
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
    "ownership": [
        Column("CPU step\np50 (ms)", "cpu_step_p50_ms", 1.0, 2, True),
        Column("p99\n(ms)", "cpu_step_p99_ms"),
        Column("team\n(ms)", "cpu_team_tick_ms", 1.0, 1),
        Column("plans\n(kB/s)", "plan_bytes_per_s", 1e-3, 1),
        *(_COST, _RATIO, _SWING),
    ],
}


def table_of(title: str, measured: Sequence[PointStatistics]) -> Table:
    """Return the table for the console, `WIDTH` characters wide."""
    names = list(measured[0].point.labels)
    columns = next((_FURTHER[name] for name in names if name in _FURTHER), _COLUMNS)
    headings = {name: name.replace("_", "\n", 1) for name in ("scenario", *names)}
    return console_table(title, headings, columns, [m.row() for m in measured])


def console_table(
    title: str,
    labels: Mapping[str, str],
    columns: Sequence[Column],
    rows: Sequence[Mapping[str, Any]],
) -> Table:
    """Return a table for the console: labels with their headings, number of completed runs, columns of numbers."""
    table = Table(
        box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0)
    )
    for heading in labels.values():
        table.add_column(heading, no_wrap=True)
    for heading in ("done", *(column.heading for column in columns)):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        texts = [value if isinstance(value := row[name], str) else f"{value:g}" for name in labels]
        done = f"{row['completed']}/{row['flights']}" + (
            f" {row['errors']}!" if row.get("errors") else ""
        )
        table.add_row(*texts, done, *(column.cell(row) for column in columns))
    return table


# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and larger teams are not
# always run.
FEWEST, MOST = 4, 12
# Numbers whose growth with the team is told: name, factor, unit.
_GROWING = {
    "CPU of an agent's step": ("cpu_step_p50_ms", 1.0, "ms"),
    "CPU of the team per tick": ("cpu_team_tick_ms", 1.0, "ms"),
    "volume of plans": ("plan_bytes_per_s", 1e-3, "kB/s"),
}


def conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each scenario or, with teams of increasing size, for each ownership."""
    groups: dict[str, list[PointStatistics]] = {}
    for m in measured:
        groups.setdefault(str(m.point.labels.get("ownership", m.point.scenario)), []).append(m)
    told = _growth if "ownership" in measured[0].point.labels else _extremes
    return [f"{name}: {'; '.join([*_outcomes(own), *told(own)])}" for name, own in groups.items()]


def _outcomes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how many runs were completed, where and when the first of the others diverged, and the errors."""
    runs, completed, errors = (
        sum(getattr(m, name) for m in measured) for name in ("runs", "completed", "errors")
    )
    diverged = [(m.diverged_s[0], m.point.text) for m in measured if m.diverged_s]
    if runs:
        first = (
            "first diverged at {:.1f} s ({})".format(*min(diverged))
            if diverged
            else "none diverged"
        )
        yield f"completes {completed} of {runs} runs, {first}"
    if errors:
        yield f"{errors} run{'s' * (errors > 1)} could not be simulated"


def _extremes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield the largest attitude, and the lowest and highest cost over the baseline's."""
    attitudes = [
        (value, m.point.text) for m in measured if (value := m.mean("attitude_max_deg")) is not None
    ]
    if attitudes:
        yield "largest payload attitude {:.2f} deg ({})".format(*max(attitudes))
    costs = [
        (m.cost_ratio, m.point.text)
        for m in measured
        if m.cost_ratio is not None and not m.point.baseline
    ]
    if costs:
        ends = dict.fromkeys([min(costs), max(costs)])
        yield "cost " + " to ".join(f"x{ratio:.2f} ({text})" for ratio, text in ends)


def _growth(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how numbers grow from `FEWEST` to `MOST` UAVs: p of N^p by least squares; nothing for a single team."""
    for name, (number, factor, unit) in _GROWING.items():
        means = {float(m.point.labels["uavs"]): factor * (m.mean(number) or 0.0) for m in measured}
        fitted = {
            uavs: value
            for uavs, value in sorted(means.items())
            if FEWEST <= uavs <= MOST and value > 0.0
        }
        if len(fitted) > 1:
            sizes, values = list(fitted), list(fitted.values())
            power = np.polyfit(np.log(sizes), np.log(values), 1)[0]
            ends = f"{values[0]:.3g} to {values[-1]:.3g} {unit}"
            yield f"{name} grows as N^{power:.2f} from {sizes[0]:g} to {sizes[-1]:g} UAVs ({ends})"
