"""Curves of an experiment: which points are on each, with its colour, marker, line and name."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from transport.experiments.declaration import NONE, Experiment
from transport.experiments.figures.axes_and_units import axis
from transport.experiments.statistics import PointStatistics, values_of
from transport.report.figures.style import MARKER, Look, looks_of

Scenarios = Mapping[str, Sequence[PointStatistics]]

_AROUND_PT = 1.5  # by which a marker is larger than the one above it


class DrawnCurve(NamedTuple):
    """A curve: its scenario, its points in the order of the horizontal axis, and its style with its name."""

    scenario: str
    points: list[PointStatistics]
    style: dict[str, Any]


def curves_of(
    experiment: Experiment, scenarios: Scenarios, *, joined: bool
) -> Iterator[DrawnCurve]:
    """Yield each curve of each scenario, joined by lines or not.

    A scenario has a colour, and a value in the column of the curves a marker and a line; with a single scenario
    each value has a colour of its own.
    """
    for scenario, look in looks_of(list(scenarios)).items():
        points = scenarios[scenario]
        if experiment.curves is None:
            style = {**_style(look, joined=joined), "label": scenario}
            yield DrawnCurve(scenario, points_on(experiment, points, None), style)
            continue

        values = _named_values(experiment, points)
        is_single = len(scenarios) == 1
        for name, own_look in looks_of(list(values)).items():
            shown = own_look if is_single else own_look._replace(colour=look.colour)
            label = name if is_single else f"{scenario}, {name}"
            style = {**_style(shown, joined=joined), "label": label}
            yield DrawnCurve(scenario, points_on(experiment, points, values[name]), style)


def _named_values(
    experiment: Experiment, measured: Sequence[PointStatistics]
) -> dict[str, str | float]:
    """Return the values in the column of the curves by the names of their curves."""
    column = str(experiment.curves)
    named = {}
    for value in values_of(measured, column):
        if value != NONE:  # points of all curves
            text = value if isinstance(value, str) else axis(column).text(value)
            named[experiment.legend.get(value, text)] = value
    return named


def points_on(
    experiment: Experiment, measured: Sequence[PointStatistics], value: float | str | None
) -> list[PointStatistics]:
    """Return the points of the curve with a value in the column of the curves; all points without such a column.

    Points labelled `NONE` belong to all curves of their scenario. Points at one x follow each other in
    `measured`, and the last of them belongs to the curve: the constant delay, not the perfect network.
    """
    column = experiment.curves
    last_at: dict[float | str, PointStatistics] = {}
    for one in measured:
        if column is None or one.point.labels[column] in (NONE, value):
            last_at[one.point.labels[experiment.x]] = one
    return list(last_at.values())


def _style(look: Look, *, joined: bool) -> dict[str, Any]:
    """Return the style of a curve, joined by its line or by none."""
    return look.style(look.line if joined else "")


def nest(curves: Sequence[DrawnCurve]) -> None:
    """Let the markers of each curve be seen around those of the next, where curves stand on the same values."""
    for under, curve in enumerate(reversed(curves)):
        curve.style["markersize"] = MARKER + _AROUND_PT * under
