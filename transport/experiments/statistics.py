"""Statistics of repetitions, means with 95 % confidence intervals for each point of a sweep, and their tables."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rich.table import Table
from scipy.special import stdtrit

from transport.experiments.cases import Case, Point
from transport.experiments.simulation import ERROR, Result

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
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
    variance = math.fsum((value - mean) ** 2 for value in values) / (n - 1)
    t = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2.0))
    return Estimate(mean, t * math.sqrt(variance / n), n)


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

    @property
    def first_diverged_s(self) -> float | None:
        """Scenario time of the first divergence, s."""
        return min(self.diverged_s, default=None)


def statistics_of(
    points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]
) -> list[PointStatistics]:
    """Return the statistics of each point.

    Costs of diverged runs are left out: they cover only part of the maneuver.
    """
    baselines = {
        _comparable(point): cost.mean
        for point, found in zip(points, results, strict=True)
        if point.baseline and (cost := estimate(_completed(found, "cost_mean"))) is not None
    }
    statistics = []
    for point, found in zip(points, results, strict=True):
        simulated = [result for result in found if result.outcome != ERROR]
        numbers = {name: estimate(_completed(found, name)) for name in names}
        cost, baseline = numbers["cost_mean"], baselines.get(_comparable(point))
        ends_s = [result.numbers["lost_s"] for result in simulated]
        statistics.append(
            PointStatistics(
                point=point,
                runs=len(simulated),
                completed=sum(result.outcome == "completed" for result in simulated),
                errors=len(found) - len(simulated),
                diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
                numbers=numbers,
                cost_ratio=cost.mean / baseline if cost is not None and baseline else None,
            )
        )
    return statistics


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

_DIVERGED, _RATIO = "diverged", "ratio"


class _Column(NamedTuple):
    """A column of the console's table: heading, name of the number, factor, digits, whether intervals are shown.

    `_DIVERGED` and `_RATIO` stand for `PointStatistics.first_diverged_s` and `cost_ratio`.
    """

    heading: str
    name: str
    factor: float
    digits: int
    interval: bool


_COLUMNS = [
    _Column("div.\n(s)", _DIVERGED, 1.0, 1, False),
    _Column("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True),
    _Column("cost\nratio", _RATIO, 1.0, 2, False),
    _Column("max\n(1e-3)", "cost_max", 1e3, 1, False),
    _Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True),
    _Column("swing\n(m)", "swing_m", 1.0, 2, False),
    _Column("apart\n(m)", "separation_min_m", 1.0, 3, False),
    _Column("age\n(tick)", "plan_age_mean_ticks", 1.0, 2, False),
]

# Columns of runs in which agents do not send every plan.
_SHARING_COLUMNS = [
    _Column("plans\nsent (%)", "plans_shared_share", 100.0, 1, True),
    *(shown for shown in _COLUMNS if shown.name not in (_DIVERGED, "cost_max", "swing_m", "separation_min_m")),
]

# Columns of runs at several speeds.
_TRACKING_COLUMNS = [
    _Column("error rms\n(cm)", "payload_rms_m", 100.0, 2, True),
    _Column("largest\n(cm)", "payload_max_m", 100.0, 1, False),
    *(shown for shown in _COLUMNS if shown.name not in ("cost_mean", "cost_max", "swing_m")),
]

# Columns of timed runs.
_TIMED_COLUMNS = [
    _Column("CPU step\np50 (ms)", "cpu_step_p50_ms", 1.0, 2, True),
    _Column("p99\n(ms)", "cpu_step_p99_ms", 1.0, 2, False),
    _Column("team\n(ms)", "cpu_team_tick_ms", 1.0, 1, False),
    _Column("run\n(s/s)", "cpu_flight_s_per_s", 1.0, 2, False),
    _Column("plans\n/tick", "plans_per_tick", 1.0, 0, False),
    _Column("\nkB/s", "plan_bytes_per_s", 1e-3, 1, False),
    _Column("cost\n(1e-3)", "cost_mean", 1e3, 2, False),
    _Column("cost\nratio", _RATIO, 1.0, 2, False),
    _Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, False),
    _Column("swing\n(m)", "swing_m", 1.0, 2, False),
]


def cases_rows(points: Sequence[Point], cases: Iterable[Case], results: Iterable[Result]) -> list[dict[str, Any]]:
    """Return one row for each run, values by column, in the order of the sweep."""
    rows: list[dict[str, Any]] = []
    for case, result in zip(cases, results, strict=True):
        point = points[case.point]
        rows.append(
            {
                "scenario": point.scenario,
                **point.labels,
                "seed": case.scenario.seed,
                "outcome": result.outcome,
                "reason": result.reason,
                **result.numbers,
            }
        )
    return rows


def points_rows(measured: Sequence[PointStatistics]) -> list[dict[str, Any]]:
    """Return one row for each point, values by column."""
    rows = []
    for m in measured:
        row: dict[str, Any] = {"scenario": m.point.scenario, **m.point.labels, "flights": m.runs}
        row |= {"completed": m.completed, "errors": m.errors}
        row |= {"first_lost_s": m.first_diverged_s, "cost_ratio": m.cost_ratio}
        for name, value in m.numbers.items():
            row |= {name: value and value.mean, f"{name}_ci95": value and value.half_width}
        rows.append(row)
    return rows


def means_in_words(measured: Sequence[PointStatistics]) -> str:
    """Return the title of a table: a single run for each point has no confidence interval."""
    repeated = any(number is not None and number.n > 1 for m in measured for number in m.numbers.values())
    return "means of completed runs" + ", ± 95 % confidence" * repeated


def table_of(title: str, measured: Sequence[PointStatistics], *, timed: bool = False) -> Table:
    """Return the table for the console, `WIDTH` characters wide; timed points have one scenario and more columns."""
    chosen = {"share_threshold": _SHARING_COLUMNS, "speed_mps": _TRACKING_COLUMNS}
    columns = next((found for label, found in chosen.items() if label in measured[0].point.labels), _COLUMNS)
    columns, named = (_TIMED_COLUMNS, False) if timed else (columns, True)
    headings = [name.replace("_", "\n", 1) for name in measured[0].point.labels]
    table = empty_table(title, [*["scenario"] * named, *headings], ["done", *[shown.heading for shown in columns]])
    for m in measured:
        texts = (value if isinstance(value, str) else f"{value:g}" for value in m.point.labels.values())
        labels = [*[m.point.scenario] * named, *texts]
        done = f"{m.completed}/{m.runs}" + (f" {m.errors}!" if m.errors else "")
        table.add_row(*labels, done, *(_cell(m, shown) for shown in columns))
    return table


def empty_table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    """Return a table for the console with columns aligned left, then columns aligned right."""
    table = Table(box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0))
    for heading in left:
        table.add_column(heading, no_wrap=True)
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}f}" if abs(value) < _LARGE else f"{value:.0f}"


def _cell(m: PointStatistics, shown: _Column) -> str:
    if shown.name in (_DIVERGED, _RATIO):
        return _number(m.first_diverged_s if shown.name == _DIVERGED else m.cost_ratio, shown.digits)
    value = m.numbers[shown.name]
    if value is None:
        return "-"
    text = _number(shown.factor * value.mean, shown.digits)
    if value.half_width is None or not shown.interval:
        return text
    return f"{text} ±{_number(shown.factor * value.half_width, shown.digits)}"
