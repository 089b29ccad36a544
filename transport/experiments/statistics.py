"""Statistics of repetitions: means with 95 % confidence intervals of each point of a sweep."""

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from scipy.special import stdtrit

from transport.experiments.cases import ERROR, Point, Result

# Numbers of a point beside those of its runs.
FIRST_DIVERGED = "first_lost_s"
COST_RATIO = "cost_ratio"
WORST_ATTITUDE = "attitude_worst_deg"

# Quantile of Student's distribution at the upper end of a 95 % confidence interval.
_QUANTILE = 0.975
# Fewer values than these are shown with their range: the interval of two or three can exceed their mean.
FEW = 5


class Estimate(NamedTuple):
    """A mean with its uncertainty."""

    mean: float
    # Half the 95 % confidence interval of the mean; None for a single value.
    half_width: float | None
    n: int  # number of repetitions
    low: float  # smallest and largest value
    high: float

    def bar(self) -> tuple[float, float]:
        """Return the lengths of an error bar below and above the mean.

        It is the 95 % interval, no further than to zero for values that are all positive. The interval of
        fewer than five values is wider than the axis: their range stands for it.
        """
        if self.half_width is None:
            return 0.0, 0.0
        if self.n < FEW:
            return max(0.0, self.mean - self.low), max(0.0, self.high - self.mean)  # rounding
        below = min(self.half_width, self.mean) if self.low >= 0.0 else self.half_width
        return below, self.half_width

    def scaled(self, factor: float) -> "Estimate":
        """Return the estimate in another unit, for a factor above zero."""
        half_width = None if self.half_width is None else factor * self.half_width
        return Estimate(
            factor * self.mean, half_width, self.n, factor * self.low, factor * self.high
        )

    def text(self, digits: int) -> str:
        """Return the mean with half its interval, with the range of fewer than five values."""
        return with_spread(self._asdict(), lambda value: f"{value:.{digits}f}")


def with_spread(values: Mapping[str, Any], text: Callable[[float], str]) -> str:
    """Return a mean in words with half its interval, with its range if n is below five, alone if n is one.

    Args:
        values: The fields of an `Estimate`.
        text: Returns a number as text.
    """
    mean = text(values["mean"])
    if values["half_width"] is None:
        return mean
    if values["n"] < FEW:
        return f"{mean} [{text(values['low'])}, {text(values['high'])}]"
    return f"{mean} ±{text(values['half_width'])}"


def estimate(values: Sequence[float]) -> Estimate | None:
    """Return mean and Student's 95 % confidence interval of independent repetitions.

    Half the interval is t s / sqrt(n), with the sample standard deviation s (n - 1 degrees of
    freedom) and the 0.975 quantile t of Student's distribution. It is exact for normally
    distributed values. None without any values.
    """
    n = len(values)
    if n == 0:
        return None

    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, n, mean, mean)
    t = float(stdtrit(n - 1, _QUANTILE))
    s = statistics.stdev(values)
    return Estimate(mean, t * s / math.sqrt(n), n, min(values), max(values))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointStatistics:
    """Statistics of the runs of one point.

    The cost ratio is the mean cost over that of the baseline, if both are known. The baseline has
    the same scenario and group.
    """

    point: Point
    runs: int  # number of simulated runs, without errors
    completed: int  # number of runs that reached the end of the maneuver
    errors: int  # number of runs that could not be simulated
    diverged_s: tuple[float, ...]  # scenario times at which the other runs ended, ascending, s
    numbers: Mapping[str, Estimate | None]  # over the completed runs, by name (cases.NUMBERS)
    cost_ratio: float | None
    attitude_worst_deg: float | None = None  # over the completed runs

    def mean(self, name: str) -> float | None:
        """Return the mean of a number, or the cost ratio; None where no run was completed."""
        if name == COST_RATIO:
            return self.cost_ratio
        value = self.numbers[name]
        return None if value is None else value.mean

    def estimate(self, name: str) -> Estimate | None:
        """Return a number with its uncertainty; that of the cost ratio is the cost's, scaled."""
        if name != COST_RATIO:
            return self.numbers[name]
        cost = self.numbers["cost_mean"]
        if cost is None or self.cost_ratio is None:
            return None
        return cost.scaled(self.cost_ratio / cost.mean)._replace(mean=self.cost_ratio)

    def bar(self, name: str) -> tuple[float, float]:
        """Return the lengths of the error bar of a number."""
        value = self.estimate(name)
        return (0.0, 0.0) if value is None else value.bar()

    def row(self) -> dict[str, Any]:
        """Return values by column, as in points.csv."""
        row: dict[str, Any] = {
            "scenario": self.point.scenario,
            **self.point.labels,
            "flights": self.runs,
            "completed": self.completed,
            "errors": self.errors,
            FIRST_DIVERGED: min(self.diverged_s, default=None),
            COST_RATIO: self.cost_ratio,
            WORST_ATTITUDE: self.attitude_worst_deg,
        }
        for name, value in self.numbers.items():
            row |= columns_of(name, value)
        return row


def columns_of(name: str, value: Estimate | None) -> dict[str, float | None]:
    """Return the columns of a number in points.csv: mean, half its interval, smallest and largest value."""
    names = (name, *(f"{name}_{ending}" for ending in ("ci95", "min", "max")))
    if value is None:
        return dict.fromkeys(names)
    return dict(zip(names, (value.mean, value.half_width, value.low, value.high), strict=True))


def statistics_of(
    points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]
) -> list[PointStatistics]:
    """Return the statistics of each point.

    Costs of diverged runs are left out: they cover only part of the maneuver.
    """
    measured = [_of_point(point, own, names) for point, own in zip(points, results, strict=True)]
    baselines = {
        (one.point.scenario, one.point.group): one.mean("cost_mean")
        for one in measured
        if one.point.baseline
    }
    return [
        replace(one, cost_ratio=_ratio(one, baselines.get((one.point.scenario, one.point.group))))
        for one in measured
    ]


def _of_point(point: Point, results: Sequence[Result], names: Sequence[str]) -> PointStatistics:
    """Return the statistics of the runs of a point, without its cost ratio."""
    simulated = [result for result in results if result.outcome != ERROR]
    completed = [result.numbers for result in simulated if result.outcome == "completed"]
    ends_s = [result.numbers["lost_s"] for result in simulated]

    estimates = {}
    for name in names:
        values = [numbers.get(name) for numbers in completed]
        estimates[name] = estimate([value for value in values if value is not None])
    return PointStatistics(
        point=point,
        runs=len(simulated),
        completed=len(completed),
        errors=len(results) - len(simulated),
        diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
        numbers=estimates,
        cost_ratio=None,
        attitude_worst_deg=max(
            (numbers.get("attitude_max_deg") or 0.0 for numbers in completed), default=None
        ),
    )


def _ratio(measured: PointStatistics, baseline: float | None) -> float | None:
    """Return the mean cost over that of the baseline, if both are known."""
    if not baseline:
        return None
    cost = measured.mean("cost_mean")
    return None if cost is None else cost / baseline


# Most characters in a line of a table.
WIDTH = 160
SPREAD = f"± half the 95 % interval, [range] of fewer than {FEW}"
TITLE = f"means of completed runs, {SPREAD}"

# Numbers from here on are shown without decimals.
_LARGE = 100.0


class Column(NamedTuple):
    """A column of the console's table."""

    heading: str
    name: str  # of the number
    factor: float = 1.0
    digits: int = 2
    interval: bool = False  # whether confidence intervals are shown

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the number of a row as text."""
        mean = row.get(self.name)
        if mean is None:
            return "-"
        half_width, low, high = (
            row.get(f"{self.name}_{ending}") if self.interval else None
            for ending in ("ci95", "min", "max")
        )
        values = {"mean": mean, "half_width": half_width, "low": low, "high": high}
        return with_spread({**values, "n": row.get("completed")}, self._text)

    def _text(self, value: float) -> str:
        """Return a number in the unit of the column, a large one without decimals."""
        shown = self.factor * value
        digits = self.digits if abs(shown) < _LARGE else 0
        return f"{shown:.{digits}f}"


_DIVERGED = Column("div.\n(s)", FIRST_DIVERGED, 1.0, 1)
_COST = Column("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True)
_RATIO = Column("cost\nratio", COST_RATIO)
_ATTITUDE = Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True)
_SWING = Column("swing\n(m)", "swing_m")
_APART = Column("apart\n(m)", "separation_min_m", 1.0, 3)
_AGE = Column("age\n(tick)", "plan_age_mean_ticks")
_ERROR = Column("error rms\n(cm)", "payload_rms_m", 100.0, 2, True)
_LARGEST_ERROR = Column("largest\n(cm)", "payload_max_m", 100.0, 1)
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

_WORST_ATTITUDE = Column("worst\n(deg)", WORST_ATTITUDE, 1.0, 1)

# Columns in place of `_COLUMNS`, by the label of the points that selects them; the first label counts.
_FURTHER = {
    "weather": [
        *(_DIVERGED, _ERROR, _LARGEST_ERROR),
        *(_COST, _RATIO, _ATTITUDE, _APART, _AGE),
    ],
    "rule": [
        Column("away rms\n(cm)", "away_rms_m", 100.0, 1, True),
        Column("known\n(s)", "known_s"),
        *(_DIVERGED, _ERROR, _ATTITUDE, _WORST_ATTITUDE, _APART),
    ],
    "share_threshold": [
        Column("plans\nsent (%)", "plans_shared_share", 100.0, 1, True),
        *(_COST, _RATIO, _ATTITUDE, _AGE),
    ],
    "speed_mps": [
        *(_ERROR, _LARGEST_ERROR),
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
    """Return the table for the console; its further columns are those of the first label that has some."""
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
    """Return a table for the console.

    It has labels with their headings, the number of completed runs, and columns of numbers.
    """
    table = Table(
        box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0)
    )
    for heading in labels.values():
        table.add_column(heading, no_wrap=True)
    for heading in ("done", *(column.heading for column in columns)):
        table.add_column(heading, justify="right", no_wrap=True)

    for row in rows:
        values = [row[name] for name in labels]
        texts = [value if isinstance(value, str) else f"{value:g}" for value in values]
        errors = f" {row['errors']}!" if row.get("errors") else ""
        done = f"{row['completed']}/{row['flights']}{errors}"
        table.add_row(*texts, done, *(column.cell(row) for column in columns))
    return table


# Team sizes that power laws are fitted to: below four the constant part of a step dominates, and
# larger teams are not always run.
FEWEST = 4
MOST = 12
# Numbers whose growth with the team is told: name, factor, unit.
_GROWING = {
    "CPU of an agent's step": ("cpu_step_p50_ms", 1.0, "ms"),
    "CPU of the team per tick": ("cpu_team_tick_ms", 1.0, "ms"),
    "volume of plans": ("plan_bytes_per_s", 1e-3, "kB/s"),
}


def conclusions(measured: Sequence[PointStatistics]) -> list[str]:
    """Return one sentence for each scenario.

    With teams of increasing size it is one for each ownership.
    """
    groups: dict[str, list[PointStatistics]] = {}
    for one in measured:
        group = str(one.point.labels.get("ownership", one.point.scenario))
        groups.setdefault(group, []).append(one)

    clauses_of = _growth if "ownership" in measured[0].point.labels else _extremes
    sentences = []
    for name, own in groups.items():
        clauses = [*_outcomes(own), *clauses_of(own)]
        sentences.append(f"{name}: {'; '.join(clauses)}")
    return sentences


def _outcomes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how many runs were completed and where the first of the others diverged.

    Errors are told, too.
    """
    runs = sum(one.runs for one in measured)
    completed = sum(one.completed for one in measured)
    errors = sum(one.errors for one in measured)

    if runs:
        diverged = [(one.diverged_s[0], one.point.text) for one in measured if one.diverged_s]
        first = "none diverged"
        if diverged:
            first = "first diverged at {:.1f} s ({})".format(*min(diverged))
        yield f"completes {completed} of {runs} runs, {first}"
    if errors:
        yield f"{errors} run{'s' * (errors > 1)} could not be simulated"


def _extremes(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield the largest attitude, and the lowest and highest cost over the baseline's."""
    attitudes_deg = []
    ratios = []
    for one in measured:
        attitude_deg = one.mean("attitude_max_deg")
        if attitude_deg is not None:
            attitudes_deg.append((attitude_deg, one.point.text))
        if one.cost_ratio is not None and not one.point.baseline:
            ratios.append((one.cost_ratio, one.point.text))

    if attitudes_deg:
        yield "largest payload attitude {:.2f} deg ({})".format(*max(attitudes_deg))
    if ratios:
        ends = dict.fromkeys([min(ratios), max(ratios)])
        yield "cost " + " to ".join(f"x{ratio:.2f} ({text})" for ratio, text in ends)


def _growth(measured: Sequence[PointStatistics]) -> Iterator[str]:
    """Yield how numbers grow from `FEWEST` to `MOST` UAVs: p of N^p by least squares.

    Nothing for a single team.
    """
    for name, (number, factor, unit) in _GROWING.items():
        means = {
            float(one.point.labels["uavs"]): factor * (one.mean(number) or 0.0) for one in measured
        }
        fitted = {
            uavs: value
            for uavs, value in sorted(means.items())
            if FEWEST <= uavs <= MOST and value > 0.0
        }
        if len(fitted) < 2:
            continue

        # log value = p log N + constant
        sizes = list(fitted)
        values = list(fitted.values())
        power = np.polyfit(np.log(sizes), np.log(values), 1)[0]
        teams = f"from {sizes[0]:g} to {sizes[-1]:g} UAVs"
        ends = f"{values[0]:.3g} to {values[-1]:.3g} {unit}"
        yield f"{name} grows as N^{power:.2f} {teams} ({ends})"
