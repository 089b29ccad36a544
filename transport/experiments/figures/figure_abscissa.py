"""Horizontal axis of curves: places of values, and of several curves beside each other at a value."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from transport.experiments.declaration import Experiment
from transport.experiments.figures.axes_and_units import Axis, axis
from transport.experiments.statistics import PointStatistics, values_of

# More values than this get round ticks instead of one each, and no line between them.
_MOST_TICKS = 10
# Distance between neighbouring curves, as shares of the width of a figure and of the distance between values,
# and room at both ends of the axis.
_APART_OF_SPAN = 0.035
_APART_OF_GAP = 0.7
_ROOM = 0.04
_BESIDE_GROWTH = 1.12  # of a logarithmic axis, a factor


@dataclass(frozen=True, slots=True, kw_only=True)
class Abscissa:
    """The horizontal axis of an experiment.

    Attributes:
        axis: Its column, title and unit.
        values: Values of the points, in their order.
        is_number: Whether values stand at their numbers; names, thresholds and the values of several curves, which
            stand beside each other, have equal distances.
        is_growth: Whether the axis is logarithmic.
        columns: Number of panels beside each other.
    """

    axis: Axis
    values: Sequence[float | str]
    is_number: bool
    is_growth: bool
    columns: int

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        measured: Sequence[PointStatistics],
        *,
        columns: int,
        is_alone: bool,
    ) -> "Abscissa":
        """Return the axis of all points of an experiment, in so many panels of one curve each, or of several."""
        x = axis(experiment.x)
        values = values_of(measured, x.label)
        is_growth = experiment.drawn_as == "scaling"
        is_threshold = experiment.drawn_as == "sharing"
        is_apart = is_threshold or not (is_alone or len(values) > _MOST_TICKS)
        is_number = is_growth or (isinstance(values[0], int | float) and not is_apart)
        return cls(axis=x, values=values, is_number=is_number, is_growth=is_growth, columns=columns)

    @property
    def is_few(self) -> bool:
        """True if every value has a tick."""
        return len(self.values) <= _MOST_TICKS

    @property
    def is_joined(self) -> bool:
        """True if the points of a curve are joined by a line."""
        return self.is_few and not isinstance(self.values[0], str)

    @property
    def places(self) -> dict[float | str, float]:
        """Place of each value on the axis."""
        if self.is_number:
            return {value: self.axis.factor * float(value) for value in self.values}
        return {value: float(i) for i, value in enumerate(self.values)}

    @property
    def span(self) -> float:
        """Length of the axis between its first and last value, 1 for a single one."""
        places = self.places.values()
        return max(places) - min(places) or 1.0

    def apart(self, curves: int) -> float:
        """Return the distance between curves that keeps markers and error bars apart.

        Only names leave room for it: on an axis of numbers a marker stands on its value.
        """
        if self.is_number:
            return 0.0
        pairs = itertools.pairwise(sorted(self.places.values()))
        gap = min((high - low for low, high in pairs), default=self.span)
        return min(self.columns * _APART_OF_SPAN * self.span, _APART_OF_GAP * gap / curves)

    def places_of(self, curves: Sequence[Sequence[PointStatistics]]) -> list[list[float]]:
        """Return the places of the points of each curve of a panel."""
        apart = self.apart(len(curves))
        middle = (len(curves) - 1) / 2.0
        places = self.places
        return [
            [places[one.point.labels[self.axis.label]] + apart * (i - middle) for one in points]
            for i, points in enumerate(curves)
        ]

    def apply(self, panel: Axes, curves: int) -> None:
        """Set limits, scale and ticks of a panel."""
        places = self.places
        low, high = min(places.values()), max(places.values())
        if self.is_growth:
            panel.set_xscale("log")
            panel.set_xlim(low / _BESIDE_GROWTH, high * _BESIDE_GROWTH)
            panel.xaxis.set_minor_locator(NullLocator())
        else:
            margin = _ROOM * self.span + self.apart(curves) * (curves + 1) / 2.0
            panel.set_xlim(low - margin, high + margin)

        if self.is_few or not self.is_number:
            names = [
                value if isinstance(value, str) else f"{self.axis.factor * value:g}"
                for value in self.values
            ]
            panel.set_xticks(list(places.values()), names)
