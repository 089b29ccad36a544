"""The tables of an experiment: one of its flights, one of its points, and the one people read."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from rich.table import Table

from transport.experiments.cases import Case, Point
from transport.experiments.flight import NUMBERS, Result
from transport.experiments.statistics import Measured

WIDTH, WIDTH_OF_VARIANTS = 100, 140

# From here on a number is shown without its decimals.
_MANY = 100.0

_LOST, _RATIO = "lost", "ratio"


class _Shown(NamedTuple):
    """A column that people read: heading, name of the number, factor, digits, whether there is room for intervals.

    "lost" and "ratio" are no means of flights and stand for `Measured.first_lost_s` and `cost_ratio`.
    """

    heading: str
    name: str
    factor: float
    digits: int
    interval: bool


_SHOWN = [
    _Shown("lost\n(s)", _LOST, 1.0, 1, False),
    _Shown("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True),
    _Shown("cost\nratio", _RATIO, 1.0, 2, False),
    _Shown("max\n(1e-3)", "cost_max", 1e3, 1, False),
    _Shown("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True),
    _Shown("swing\n(m)", "swing_m", 1.0, 2, False),
    _Shown("apart\n(m)", "separation_min_m", 1.0, 3, False),
    _Shown("age\n(tick)", "plan_age_mean_ticks", 1.0, 2, False),
]

# What is read of flights in which agents do not send every plan.
_SHOWN_SHARING = [
    _Shown("plans\nsent (%)", "plans_shared_share", 100.0, 1, True),
    *(shown for shown in _SHOWN if shown.name not in (_LOST, "cost_max", "swing_m", "separation_min_m")),
]

# What is read of flights whose computation was measured.
_SHOWN_TIMED = [
    _Shown("CPU step\np50 (ms)", "cpu_step_p50_ms", 1.0, 2, True),
    _Shown("p99\n(ms)", "cpu_step_p99_ms", 1.0, 2, False),
    _Shown("team\n(ms)", "cpu_team_tick_ms", 1.0, 1, False),
    _Shown("run\n(s/s)", "cpu_flight_s_per_s", 1.0, 2, False),
    _Shown("plans\n/tick", "plans_per_tick", 1.0, 0, False),
    _Shown("\nkB/s", "plan_bytes_per_s", 1e-3, 1, False),
    _Shown("cost\n(1e-3)", "cost_mean", 1e3, 2, False),
    _Shown("cost\nratio", _RATIO, 1.0, 2, False),
    _Shown("attitude\n(deg)", "attitude_max_deg", 1.0, 2, False),
    _Shown("swing\n(m)", "swing_m", 1.0, 2, False),
]


def cases_csv(
    points: Sequence[Point], cases: Iterable[Case], results: Iterable[Result], numbers: Sequence[str] = NUMBERS
) -> bytes:
    """One row for each flight, in the order of the sweep. Floats are written so that they read back as the same bits.

    Args:
        points: Of the sweep.
        cases: Its flights.
        results: What came of them.
        numbers: Of each flight.
    """
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
    return _csv(["scenario", *points[0].labels, "seed", "outcome", "reason", *numbers], rows)


def points_csv(measured: Sequence[Measured]) -> bytes:
    """One row for each point: flights, and means over those that were completed with 95 % confidence intervals."""
    rows = []
    for m in measured:
        row: dict[str, Any] = {"scenario": m.point.scenario, **m.point.labels, "flights": m.flights}
        row |= {"completed": m.completed, "errors": m.errors, "first_lost_s": m.first_lost_s}
        row["cost_ratio"] = m.cost_ratio
        for name, value in m.numbers.items():
            row |= {name: value and value.mean, f"{name}_ci95": value and value.half_width}
        rows.append(row)
    means = [column for name in measured[0].numbers for column in (name, f"{name}_ci95")]
    counts = ["flights", "completed", "errors", "first_lost_s", "cost_ratio"]
    return _csv(["scenario", *measured[0].point.labels, *counts, *means], rows)


def table_of(title: str, measured: Sequence[Measured], *, timed: bool = False) -> Table:
    """What a person reads, in `WIDTH` columns.

    Args:
        title: Above the table.
        measured: The points, in the order of the sweep.
        timed: Whether it is about computation and messages; then all points are of one scenario.
    """
    sharing = "share_threshold" in measured[0].point.labels
    columns, named = (_SHOWN_TIMED, False) if timed else (_SHOWN_SHARING if sharing else _SHOWN, True)
    table = Table(box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0))
    headings = [name.replace("_", "\n", 1) for name in measured[0].point.labels]
    for heading in [*["scenario"] * named, *headings]:
        table.add_column(heading, no_wrap=True)
    for heading in ["done", *[shown.heading for shown in columns]]:
        table.add_column(heading, justify="right", no_wrap=True)
    for m in measured:
        labels = [*[m.point.scenario] * named, *(_label(value) for value in m.point.labels.values())]
        table.add_row(*labels, _done(m), *(_cell(m, shown) for shown in columns))
    return table


def _done(m: Measured) -> str:
    errors = f" {m.errors}!" if m.errors else ""
    return f"{m.completed}/{m.flights}{errors}"


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}f}" if abs(value) < _MANY else f"{value:.0f}"


def _label(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _cell(m: Measured, shown: _Shown) -> str:
    if shown.name in (_LOST, _RATIO):
        return _number(m.first_lost_s if shown.name == _LOST else m.cost_ratio, shown.digits)
    value = m.numbers[shown.name]
    if value is None:
        return "-"
    text = _number(shown.factor * value.mean, shown.digits)
    if value.half_width is None or not shown.interval:
        return text
    return f"{text} ±{_number(shown.factor * value.half_width, shown.digits)}"


def _csv(columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
