"""Variants of a scenario: the cost over the baseline's.

Each variant has a row, each network a colour.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from transport.experiments.declaration import Axis, axis
from transport.experiments.statistics import PointStatistics
from transport.report.figures.column import Room, column_panels, head, text_width_in
from transport.report.figures.style import (
    DIVERGED,
    MARKER,
    REFERENCE,
    SMALL,
    label_decades,
    styles_of,
)

# Height of a row, room around and between panels, distance of the marks of diverged runs, in.
_ROW_IN = 0.185
_ABOVE_IN = 0.2
_BETWEEN_IN = 0.28
_BELOW_IN = 0.42
_RIGHT_IN = 0.5
_BESIDE_NAME_IN = 0.08
_BESIDE_PANEL_IN = 0.12
# Distance between the networks of a variant, in rows, and room at both ends of the axis, a factor.
_APART = 0.5
_ROOM = 1.15
# Panels beside each other: width of one, as a share of its place; room below for numbers.
_STRIP = 0.86
_BELOW_STRIPS_IN = 0.18


def draw_variants(figure: Figure, scenarios: Mapping[str, Sequence[PointStatistics]]) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant.

    Points with diverged runs have a mark beside the panel.
    """
    measured = [statistics for own in scenarios.values() for statistics in own]
    networks = list(dict.fromkeys(str(one.point.labels["network"]) for one in measured))
    styles = _marks(networks)
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
    cases: dict[str, list[PointStatistics]] = {}
    for one in measured:
        cases.setdefault(str(one.point.labels[rows]), []).append(one)
    values = list(dict.fromkeys(x.text(one.point.labels[x.label]) for one in measured))
    styles = _marks(values)
    room = Room(
        left_in=max(map(text_width_in, cases)) + _BESIDE_NAME_IN,
        top_in=_ABOVE_IN,
        bottom_in=_BELOW_STRIPS_IN,
    )
    legend = [Line2D([], [], label=text, **style) for text, style in styles.items()]
    (whole,) = column_panels(figure, [_ROW_IN * len(cases)], legend=legend, x_label="", room=room)
    whole.set_axis_off()

    # Each point with the row of its mark, and the style of its value.
    marks = []
    for row, own in enumerate(cases.values()):
        for one in own:
            value = x.text(one.point.labels[x.label])
            marks.append((one, row + _beside(values, value), styles[value]))

    for place, strip in enumerate(_STRIPS):
        panel = whole.inset_axes((place / len(_STRIPS), 0.0, _STRIP / len(_STRIPS), 1.0))
        ends = [_draw_in_strip(panel, strip, *mark) for mark in marks]
        highest = max(ends, default=0.0)
        head(panel, strip.title, legend=False)
        panel.set(xlim=(0.0, 1.1 * highest or 1.0), ylim=(len(cases) - 0.5, -0.5))
        panel.set_yticks(range(len(cases)), cases if place == 0 else [""] * len(cases))
        panel.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))


def _draw_in_strip(
    panel: Axes, strip: _Strip, one: PointStatistics, row: float, style: dict[str, Any]
) -> float:
    """Draw a number of a point in a row; return the end of its error bar."""
    mean = one.mean(strip.number)
    if mean is None:
        return 0.0
    below, above = one.bar(strip.number)
    bar = [[strip.factor * below], [strip.factor * above]]
    panel.errorbar([strip.factor * mean], [row], xerr=bar, elinewidth=0.8, **style)
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
    return {
        name: {"color": colour, "marker": marker, "markersize": MARKER, "linestyle": "none"}
        for name, (colour, marker, _) in styles_of(names).items()
    }


def _draw_points(
    figure: Figure,
    panel: Axes,
    own: Sequence[PointStatistics],
    names: Sequence[str],
    styles: Mapping[str, dict[str, Any]],
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
            xytext=(8.0, 2.0),
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
