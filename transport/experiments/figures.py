"""Figures of an experiment as PNG, and as SVG for papers: curves, maps of two quantities, variants.

A map has cost as colour and completed runs as numbers. Variants have a row each, and a colour for each network. Curves
have panels with the time of divergence and with means and their confidence intervals: a scenario has a colour, a curve
of it (a distribution, a kind of loss) a marker and a line.
"""

import itertools
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from transport.experiments.declaration import NONE, Axis, Experiment, axis
from transport.experiments.statistics import COST_RATIO, PointStatistics
from transport.report.column import column_panels, head, text_width_in
from transport.report.style import (
    COLUMN_IN,
    CURVES,
    DIVERGED,
    MARKER,
    RC,
    REFERENCE,
    SMALL,
    TEXT,
    label_decades,
    save,
)

# Height of a row of a map and of variants, and of a panel of curves; room above a panel, in.
_CELL_IN, _ROW_IN, _PANEL_IN, _ABOVE_IN = 0.27, 0.185, 0.95, 0.2


def draw(experiment: Experiment, measured: Sequence[PointStatistics], folder: Path) -> list[Path]:
    """Draw an experiment to figure.png and figure.svg, which replace older ones; return these files."""
    with mpl.rc_context({**RC, "svg.hashsalt": experiment.name}):
        figure = Figure()
        fill(figure, experiment, measured)
        return save(figure, folder / "figure.png")


def fill(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw an experiment into an empty figure, in the style of `matplotlib.rcParams`."""
    scenarios: dict[str, list[PointStatistics]] = {}
    for m in measured:
        scenarios.setdefault(m.point.scenario, []).append(m)
    if experiment.drawn_as == "variants":
        _draw_variants(figure, scenarios)
    elif experiment.y:
        _draw_maps(figure, axis(experiment.x), axis(experiment.y), scenarios)
    else:
        _draw_curves(figure, experiment, scenarios)


Scenarios = Mapping[str, Sequence[PointStatistics]]


def _draw_maps(figure: Figure, x: Axis, y: Axis, scenarios: Scenarios) -> None:
    """Draw a map of two axes for each scenario, one below another, with one colour scale."""
    measured = [m for own in scenarios.values() for m in own]
    columns, rows = (sorted({float(m.point.labels[one.label]) for m in measured}) for one in (x, y))
    heights_in = [_CELL_IN * len(rows)] * len(scenarios)
    panels = column_panels(figure, heights_in, x_label=x.title, right_in=0.42, top_in=_ABOVE_IN)
    costs = [1e3 * cost for m in measured if (cost := m.mean("cost_mean"))] or [1.0]
    scale = LogNorm(min(costs), max(max(costs), 1.001 * min(costs)))
    for panel, (scenario, own) in zip(panels, scenarios.items(), strict=True):
        shown = np.full((len(rows), len(columns)), np.nan)
        for m in own:
            column, row = (
                where.index(float(m.point.labels[one.label]))
                for where, one in ((columns, x), (rows, y))
            )
            how: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "linespacing": 1.0}
            cost = m.mean("cost_mean")
            if cost is None:
                text = f"diverges\n{m.diverged_s[0]:.1f} s" if m.diverged_s else "-"
                how["bbox"] = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6}
            else:
                shown[row, column] = max(1e3 * cost, min(costs))
                text = f"{1e3 * cost:.2f}" + f"\n{m.completed} of {m.runs}" * (m.completed < m.runs)
                how["color"] = "#ffffff" if scale(shown[row, column]) < 0.55 else "#000000"
            panel.text(column, row, text, **how)
        panel.patch.set(
            hatch="////", edgecolor="#c8c8c8", linewidth=0.0
        )  # behind cells without a completed run
        panel.imshow(shown, norm=scale, aspect="auto", origin="lower")
        head(panel, scenario, legend=False)
        panel.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
        panel.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
        panel.set_ylabel(y.title)
        panel.tick_params(length=0.0)
        panel.grid(visible=False)
    bottom, top = panels[-1].get_position().y0, panels[0].get_position().y1
    place = (panels[0].get_position().x1 + 0.08 / COLUMN_IN, bottom, 0.09 / COLUMN_IN, top - bottom)
    bar = figure.colorbar(ScalarMappable(scale), cax=figure.add_axes(place))
    label_decades(bar.ax.yaxis)
    above = top + 2.0 / 72.0 / figure.get_figheight()
    figure.text(0.99, above, "mean cost ($10^{-3}$)", ha="right", va="bottom", fontsize=TEXT)


def _draw_variants(figure: Figure, scenarios: Scenarios) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant.

    Points with diverged runs have a mark beside the panel.
    """
    networks = list(
        dict.fromkeys(str(m.point.labels["network"]) for own in scenarios.values() for m in own)
    )
    styles: list[dict[str, Any]] = [
        {"color": colour, "marker": marker, "markersize": MARKER, "linestyle": "none"}
        for colour, marker, _ in CURVES[: len(networks)]
    ]
    rows = [list(dict.fromkeys(map(_name, own))) for own in scenarios.values()]
    panels = column_panels(
        figure,
        [_ROW_IN * len(names) for names in rows],
        legend=[
            Line2D([], [], label=name, **style)
            for name, style in zip(networks, styles, strict=True)
        ],
        x_label="mean cost over that of the unchanged scenario\non a perfect network",
        left_in=max(text_width_in(name) for names in rows for name in names) + 0.08,
        right_in=0.5,  # for marks of diverged runs
        top_in=_ABOVE_IN,
        gap_in=0.28,
        bottom_in=0.42,
    )
    ratios = [
        1.0,
        *(m.cost_ratio for own in scenarios.values() for m in own if m.cost_ratio is not None),
    ]
    for panel, (scenario, own), names in zip(panels, scenarios.items(), rows, strict=True):
        for m in own:
            network = networks.index(str(m.point.labels["network"]))
            y, style = (
                names.index(_name(m)) + 0.25 * (2 * network - (len(networks) - 1)),
                styles[network],
            )
            if m.cost_ratio is not None:
                panel.plot([m.cost_ratio], [y], **style)
            if m.completed < m.runs:
                beside = panel.get_yaxis_transform() + ScaledTranslation(
                    0.12, 0.0, figure.dpi_scale_trans
                )
                panel.plot([1.0], [y], transform=beside, clip_on=False, **style | DIVERGED)
        if any(m.completed < m.runs for m in own):
            panel.annotate(
                "diverged", (1.0, 1.0), (8.0, 2.0), "axes fraction", "offset points", fontsize=SMALL
            )
        head(panel, scenario, legend=False)
        panel.axvline(1.0, color=REFERENCE, linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set(
            xscale="log",
            xlim=(min(ratios) / 1.15, max(ratios) * 1.15),
            ylim=(len(names) - 0.5, -0.5),
        )
        label_decades(panel.xaxis)


def _name(m: PointStatistics) -> str:
    """Return the name of a variant: its texts, and its numbers with their names."""
    labels = {name: value for name, value in m.point.labels.items() if name != "network"}
    numbers = [
        f"{axis(name).name} {value:g}"
        for name, value in labels.items()
        if not isinstance(value, str)
    ]
    texts = [value for value in labels.values() if isinstance(value, str) and value]
    return ", ".join([*numbers, ": ".join(texts)] if texts else numbers).replace("_", " ")


class Panel(NamedTuple):
    """A panel: title, name of the number, factor."""

    title: str
    number: str
    factor: float = 1.0


class _Curve(NamedTuple):
    """A curve: its points in the order of the horizontal axis, and its style with its name."""

    points: list[PointStatistics]
    style: dict[str, Any]


_ATTITUDE = Panel("largest payload attitude (deg)", "attitude_max_deg")
# Panels by how an experiment is drawn.
_PANELS: Mapping[str, Sequence[Panel]] = {
    "curves": (Panel("mean cost of completed runs ($10^{-3}$)", "cost_mean", 1e3), _ATTITUDE),
    "sharing": (
        Panel("plans sent (%)", "plans_shared_share", 100.0),
        Panel("mean cost over that with all plans sent", COST_RATIO),
        _ATTITUDE,
    ),
    "tracking": (
        Panel("payload error, root mean square (cm)", "payload_rms_m", 100.0),
        Panel("largest payload error (cm)", "payload_max_m", 100.0),
        _ATTITUDE,
    ),
    "scaling": (
        Panel("agent's CPU per step (ms)", "cpu_step_p50_ms"),
        Panel("team's CPU per tick (ms)", "cpu_team_tick_ms"),
        Panel("plans sent (kB/s)", "plan_bytes_per_s", 1e-3),
        Panel("mean cost ($10^{-3}$)", "cost_mean", 1e3),
    ),
}

# More values than this get round ticks instead of one each, and no line between them.
_MOST_TICKS = 10


def _draw_curves(figure: Figure, experiment: Experiment, scenarios: Scenarios) -> None:
    """Draw the panels: when runs diverge, if any does, and the numbers; each with the curves of all scenarios.

    Names and thresholds are in equal distances; growth with the team has logarithmic axes.
    """
    x, is_growth = axis(experiment.x), experiment.drawn_as == "scaling"
    values = list(dict.fromkeys(m.point.labels[x.label] for own in scenarios.values() for m in own))
    is_few = len(values) <= _MOST_TICKS
    is_number = is_growth or (isinstance(values[0], float) and experiment.drawn_as != "sharing")
    places = {
        value: x.factor * float(value) if is_number else float(i) for i, value in enumerate(values)
    }
    curves = list(_curves(experiment, scenarios, joined=is_few and not isinstance(values[0], str)))
    diverged_s = [time_s for own in scenarios.values() for m in own for time_s in m.diverged_s]
    shown = _PANELS[experiment.drawn_as]
    panels = column_panels(
        figure,
        [_PANEL_IN] * (len(shown) + bool(diverged_s)),
        legend=[Line2D([], [], **curve.style) for curve in curves],
        x_label=x.title,
        top_in=_ABOVE_IN,
    )
    span = max(places.values()) - min(places.values()) or 1.0
    gap = min(
        (high - low for low, high in itertools.pairwise(sorted(places.values()))), default=span
    )
    # Distance between neighbouring curves, so that markers and error bars do not overlap: only
    # between names. On an axis of numbers a marker stands on its value.
    apart = 0.0 if is_number else min(0.035 * span, 0.7 * gap / len(curves))
    xs = [
        [
            places[m.point.labels[x.label]] + apart * (index - (len(curves) - 1) / 2.0)
            for m in curve.points
        ]
        for index, curve in enumerate(curves)
    ]
    for panel in panels:
        margin = 0.04 * span + apart * (len(curves) + 1) / 2.0
        panel.set_xlim(min(places.values()) - margin, max(places.values()) + margin)
        if is_growth:
            panel.set_xscale("log")
            panel.xaxis.set_minor_locator(NullLocator())
        if is_few or not is_number:
            names = [
                value if isinstance(value, str) else f"{x.factor * value:g}" for value in values
            ]
            panel.set_xticks(list(places.values()), names)
    if diverged_s:
        _draw_divergence(panels.pop(0), curves, xs, 1.25 * max(diverged_s))
    for panel, (title, number, factor) in zip(panels, shown, strict=True):
        head(panel, title, legend=False)
        means = []
        for at, curve in zip(xs, curves, strict=True):
            found = [(m.mean(number), m.numbers.get(number)) for m in curve.points]
            drawn = [math.nan if mean is None else factor * mean for mean, _ in found]
            halves = [factor * ((value.half_width if value else None) or 0.0) for _, value in found]
            panel.errorbar(at, drawn, halves, capsize=1.5, elinewidth=0.8, **curve.style)
            means += [mean for mean in drawn if not math.isnan(mean)]
        _scale(panel, means or [0.0], is_ratio=number == COST_RATIO, is_growth=is_growth)


def _curves(experiment: Experiment, scenarios: Scenarios, *, joined: bool) -> Iterator[_Curve]:
    """Yield each curve of each scenario; points labelled `NONE` belong to all curves of their scenario."""
    column = experiment.curves
    for place, (scenario, found) in enumerate(scenarios.items()):
        values = dict.fromkeys(m.point.labels[column] if column else "" for m in found)
        for index, value in enumerate(value for value in values if value != NONE):
            # The last of several points at one x belongs to the curve: the constant delay, not the perfect network.
            own = {
                m.point.labels[experiment.x]: m
                for m in found
                if column is None or m.point.labels[column] in (NONE, value)
            }
            text = value if isinstance(value, str) or column is None else axis(column).text(value)
            name = experiment.legend.get(value, text)
            label = (
                scenario
                if column is None
                else name
                if len(scenarios) == 1
                else f"{scenario}, {name}"
            )
            shape = index if column else place
            colour = (
                shape if len(scenarios) == 1 else place
            )  # with one scenario, curves have colours of their own
            _, marker, line = CURVES[(shape + shape // len(CURVES)) % len(CURVES)]
            style = {
                "color": CURVES[colour % len(CURVES)][0],
                "marker": marker,
                "linestyle": line if joined else "",
            }
            yield _Curve(list(own.values()), {**style, "markersize": MARKER, "label": label})


def _scale(axes: Axes, means: Sequence[float], *, is_ratio: bool, is_growth: bool) -> None:
    """Fit the vertical axis to the means; logarithmic for growth, or if nearly diverged runs are far above the rest."""
    lowest, highest = min(means), max(means)
    if is_ratio:
        axes.margins(y=0.12)
    elif lowest > 0.0 and (is_growth or highest > 5.0 * statistics.median(means)):
        axes.set_yscale("log")
        axes.set_ylim(lowest / 1.4, 1.4 * highest)
        label_decades(axes.yaxis)
    else:
        axes.set_ylim(
            0.0, min(max(axes.get_ylim()[1], 1.12 * highest), 2.0 * highest) or 1.0
        )  # cuts wide intervals


def _draw_divergence(
    axes: Axes, curves: Sequence[_Curve], xs: Sequence[Sequence[float]], never_s: float
) -> None:
    """Draw the mean time at which runs diverged and its range; a run that completes at the height of "never"."""
    for x, (points, style) in zip(xs, curves, strict=True):
        dots = style | {"linestyle": "none"}
        for at, m in zip(x, points, strict=True):
            if m.completed:
                axes.plot([at], [never_s], **dots)
            if m.diverged_s:
                axes.plot(
                    [at, at],
                    [m.diverged_s[0], m.diverged_s[-1]],
                    color=style["color"],
                    linewidth=0.8,
                )
                axes.plot([at], [statistics.fmean(m.diverged_s)], **dots | DIVERGED)
    head(axes, "time at which runs diverge (s, hollow), or never", legend=False)
    axes.set_ylim(0.0, 1.12 * never_s)
    ticks = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < 0.85 * never_s]
    axes.set_yticks([*ticks, never_s], [*(f"{tick:g}" for tick in ticks), "never"])
