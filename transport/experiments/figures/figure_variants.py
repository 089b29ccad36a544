"""Rows of marks: the cost of each variant of a scenario, or the payload's errors in each case.

A row has a mark for each network, or for each value of an axis: they stand below each other, about its middle.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from transport.experiments.figures.axes_and_units import Axis, axis
from transport.experiments.statistics import PointStatistics, values_of
from transport.report.figures.column import Room, column_panels, head, text_width_in
from transport.report.figures.style import (
    DIVERGED,
    REFERENCE,
    SMALL,
    label_decades,
    looks_of,
)

# Height of a row, room around and between panels, distance of the marks of diverged runs, inches.
_ROW_IN = 0.185
_ABOVE_IN = 0.2
_BETWEEN_IN = 0.28
_BELOW_IN = 0.42
_RIGHT_IN = 0.5
_BESIDE_NAME_IN = 0.08
_BESIDE_PANEL_IN = 0.12
# Distance between the marks of a row, in rows, and room at both ends of the axis of costs, a factor.
_APART = 0.5
_ROOM = 1.15
# Panels beside each other: width of one, as a share of its place; room below for numbers, inches; the end of
# an axis over the highest value that it shows, and its numbers at most.
_STRIP = 0.86
_BELOW_STRIPS_IN = 0.18
_ABOVE_HIGHEST = 1.1
_MOST_NUMBERS = 3
_WORD_OFFSET_PT = (8.0, 2.0)  # of "diverged" from the upper right corner, points

Styles = Mapping[str, dict[str, Any]]  # of marks, by the name of a network or value


def draw_variants(figure: Figure, scenarios: Mapping[str, Sequence[PointStatistics]]) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant.

    Points with diverged runs have a mark beside the panel.
    """
    measured = [statistics for own in scenarios.values() for statistics in own]
    styles = _marks([str(network) for network in values_of(measured, "network")])
    names_by_scenario = [list(dict.fromkeys(map(_name, own))) for own in scenarios.values()]
    widths_in = [text_width_in(name) for names in names_by_scenario for name in names]

    panels = column_panels(
        figure,
        [_ROW_IN * len(names) for names in names_by_scenario],
        legend=[Line2D([], [], label=network, **style) for network, style in styles.items()],
        x_label="mean cost over that of the unchanged scenario\non a perfect network",
        room=Room(
            left_in=max(widths_in) + _BESIDE_NAME_IN,
            right_in=_RIGHT_IN,  # for marks of diverged runs
            top_in=_ABOVE_IN,
            gap_in=_BETWEEN_IN,
            bottom_in=_BELOW_IN,
        ),
    )

    span = _span(measured)
    contents = zip(panels, scenarios.items(), names_by_scenario, strict=True)
    for panel, (scenario, own), names in contents:
        _draw_points(figure, panel, own, names, styles)
        head(panel, scenario, legend=False)
        panel.axvline(1.0, color=REFERENCE, linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set(xscale="log", xlim=span, ylim=(len(names) - 0.5, -0.5))
        label_decades(panel.xaxis)


class _Strip(NamedTuple):
    """A panel beside others: its title, the name of its number, and the factor to its unit."""

    title: str
    number: str
    factor: float = 1.0


_STRIPS = (
    _Strip("rms error (cm)", "payload_rms_m", 100.0),
    _Strip("largest (cm)", "payload_max_m", 100.0),
    _Strip("attitude (deg)", "attitude_max_deg"),
)


def draw_tracking(figure: Figure, measured: Sequence[PointStatistics], x: Axis, rows: str) -> None:
    """Draw errors of the payload: a row for each case, a mark for each value of the axis `x`.

    Errors, largest errors and attitudes stand beside each other, with their error bars.
    """
    cases = [str(case) for case in values_of(measured, rows)]
    styles = _marks([x.text(value) for value in values_of(measured, x.label)])
    marks = []
    for one in measured:
        case = str(one.point.labels[rows])
        value = x.text(one.point.labels[x.label])
        row = cases.index(case) + _beside(list(styles), value)
        marks.append(_Mark(one, row, styles[value]))

    for panel, strip in zip(_panels_beside(figure, cases, styles), _STRIPS, strict=True):
        head(panel, strip.title, legend=False)
        highest = max(_draw_in_strip(panel, strip, mark) for mark in marks)
        panel.set_xlim(0.0, _ABOVE_HIGHEST * highest or 1.0)
        panel.set_ylim(len(cases) - 0.5, -0.5)
        panel.xaxis.set_major_locator(MaxNLocator(_MOST_NUMBERS, steps=[1, 2, 5, 10]))


class _Mark(NamedTuple):
    """A point with the row of its mark, and its style."""

    point: PointStatistics
    row: float
    style: dict[str, Any]


def _panels_beside(figure: Figure, cases: Sequence[str], styles: Styles) -> list[Axes]:
    """Return a panel of an empty figure for each of `_STRIPS`, beside each other: the first has the cases."""
    room = Room(
        left_in=max(map(text_width_in, cases)) + _BESIDE_NAME_IN,
        top_in=_ABOVE_IN,
        bottom_in=_BELOW_STRIPS_IN,
    )
    legend = [Line2D([], [], label=text, **style) for text, style in styles.items()]
    (whole,) = column_panels(figure, [_ROW_IN * len(cases)], legend=legend, x_label="", room=room)
    whole.set_axis_off()

    panels = []
    count = len(_STRIPS)
    for place in range(count):
        panel = whole.inset_axes((place / count, 0.0, _STRIP / count, 1.0))
        panel.set_yticks(range(len(cases)), cases if place == 0 else [""] * len(cases))
        panels.append(panel)
    return panels


def _draw_in_strip(panel: Axes, strip: _Strip, mark: _Mark) -> float:
    """Draw a number of a point in its row; return the end of its error bar, 0 without a completed run."""
    mean = mark.point.mean(strip.number)
    if mean is None:
        return 0.0
    below, above = mark.point.bar(strip.number)
    bar = [[strip.factor * below], [strip.factor * above]]
    panel.errorbar([strip.factor * mean], [mark.row], xerr=bar, elinewidth=0.8, **mark.style)
    return strip.factor * (mean + above)


def _beside(names: Sequence[str], name: str) -> float:
    """Return the place of one of several marks about the middle of a row, in rows."""
    return _APART * (names.index(name) - (len(names) - 1) / 2.0)


def _span(measured: Sequence[PointStatistics]) -> tuple[float, float]:
    """Return the limits of the axis: those of the ratios, the baseline's included, with room."""
    ratios = [statistics.cost_ratio for statistics in measured]
    shown = [1.0, *(ratio for ratio in ratios if ratio is not None)]
    return min(shown) / _ROOM, max(shown) * _ROOM


def _marks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the style of the marks of each name, such as a network."""
    return {name: look.style() for name, look in looks_of(names).items()}


def _draw_points(
    figure: Figure,
    panel: Axes,
    own: Sequence[PointStatistics],
    names: Sequence[str],
    styles: Styles,
) -> None:
    """Draw the variants of a scenario, and beside the panel those with diverged runs."""
    offset = ScaledTranslation(_BESIDE_PANEL_IN, 0.0, figure.dpi_scale_trans)
    beside = panel.get_yaxis_transform() + offset

    for statistics in own:
        network = str(statistics.point.labels["network"])
        style = styles[network]
        row = names.index(_name(statistics)) + _beside(list(styles), network)
        if statistics.cost_ratio is not None:
            panel.plot([statistics.cost_ratio], [row], **style)
        if statistics.completed < statistics.runs:
            panel.plot([1.0], [row], transform=beside, clip_on=False, **style | DIVERGED)

    if any(statistics.completed < statistics.runs for statistics in own):
        panel.annotate(
            "diverged",
            xy=(1.0, 1.0),
            xycoords="axes fraction",
            xytext=_WORD_OFFSET_PT,
            textcoords="offset points",
            fontsize=SMALL,
        )


def _name(statistics: PointStatistics) -> str:
    """Return the name of a variant: its texts, and its numbers with their names."""
    labels = {name: value for name, value in statistics.point.labels.items() if name != "network"}
    numbers = [
        f"{axis(name).name} {value:g}"
        for name, value in labels.items()
        if not isinstance(value, str)
    ]
    texts = [value for value in labels.values() if isinstance(value, str) and value]
    parts = [*numbers, ": ".join(texts)] if texts else numbers
    return ", ".join(parts).replace("_", " ")
