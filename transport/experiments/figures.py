"""Figures of an experiment as PNG, and as SVG for papers: curves, maps of two quantities, variants.

A map has cost as colour and completed runs as numbers. Variants have a row each, and a colour for each network.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from transport.experiments.curve_figure import draw_curves
from transport.experiments.declaration import Axis, Experiment, axis
from transport.experiments.statistics import PointStatistics
from transport.report.column import column_panels, draw_legend, head, legend_height_in, text_width_in
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

# Maps.
_CELL_IN, _ABOVE_IN = 0.27, 0.2
# Room at the right of the maps for the colour scale and its numbers.
_RIGHT_IN, _SCALE_IN = 0.42, 0.09
_COLOURS = "viridis"

# A cell without a completed run.
_DIVERGED: dict[str, Any] = {"facecolor": "#ffffff", "edgecolor": "#c8c8c8", "hatch": "////", "linewidth": 0.0}
_LIGHT, _DARK = "#ffffff", "#000000"
_MIDDLE = 0.55  # text is light below this share of the colour scale

# Variants.
_ROW_IN, _ABOVE_ROWS_IN, _GAP_IN, _BELOW_IN = 0.185, 0.2, 0.28, 0.38
# Width of the strip of diverged runs, and its distance from the panel, inches.
_STRIP_IN, _APART_IN = 0.5, 0.08
_TITLE = "mean cost over that of the unchanged scenario\non a perfect network"
# Larger ratios are drawn at this value.
_HIGHEST = 100.0
# Ratios that span less than this factor have finer ticks than 1, 2, 5.
_NARROW, _FINE_TICKS = 3.0, (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0)


def draw(experiment: Experiment, measured: Sequence[PointStatistics], folder: Path) -> list[Path]:
    """Draw an experiment to figure.png and figure.svg, which replace older ones; return these files."""
    with mpl.rc_context({**RC, "svg.hashsalt": experiment.name}):
        figure = Figure()
        fill(figure, experiment, measured)
        return save(figure, folder / "figure.png")


def fill(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw an experiment into an empty figure, in the style of `matplotlib.rcParams`."""
    if experiment.drawn_as == "variants":
        _draw_variants(figure, measured)
    elif experiment.y is not None:
        _draw_maps(figure, experiment.x, experiment.y, measured)
    else:
        draw_curves(figure, experiment, measured)


def _draw_maps(figure: Figure, x: Axis, y: Axis, measured: Sequence[PointStatistics]) -> None:
    """Draw a map of two axes for each scenario, one below another, with one colour scale."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    rows = len({m.point.labels[y.label] for m in measured})
    panels = column_panels(
        figure, [_CELL_IN * rows] * len(scenarios), x_label=x.title, right_in=_RIGHT_IN, top_in=_ABOVE_IN
    )
    costs = [value.mean for m in measured if (value := m.numbers["cost_mean"]) is not None and value.mean > 0.0]
    low, high = (1e3 * min(costs), 1e3 * max(costs)) if costs else (1.0, 1.0)
    high = max(high, 1.001 * low)
    for panel, scenario in zip(panels, scenarios, strict=True):
        _draw_map(panel, x, y, [m for m in measured if m.point.scenario == scenario], low, high)
        head(panel, scenario, legend=False)
        panel.set_ylabel(y.title)
    if costs:
        _draw_scale(figure, panels, low, high)


def _draw_scale(figure: Figure, panels: Sequence[Axes], low: float, high: float) -> None:
    """Draw the colour scale beside all maps."""
    bottom, top = panels[-1].get_position().y0, panels[0].get_position().y1
    left = panels[0].get_position().x1 + 0.08 / COLUMN_IN
    place = figure.add_axes((left, bottom, _SCALE_IN / COLUMN_IN, top - bottom))
    bar = figure.colorbar(ScalarMappable(LogNorm(low, high), _COLOURS), cax=place)
    label_decades(bar.ax.yaxis)
    title = "mean cost ($10^{-3}$)"
    figure.text(0.99, top + 2.0 / 72.0 / figure.get_figheight(), title, ha="right", va="bottom", fontsize=TEXT)
    bar.outline.set_visible(False)


def _draw_map(axes: Axes, x: Axis, y: Axis, measured: Sequence[PointStatistics], low: float, high: float) -> None:
    columns = sorted({float(m.point.labels[x.label]) for m in measured})
    rows = sorted({float(m.point.labels[y.label]) for m in measured})
    for m in measured:
        column, row = columns.index(float(m.point.labels[x.label])), rows.index(float(m.point.labels[y.label]))
        cost = m.numbers["cost_mean"]
        if cost is None:
            style, ink = _DIVERGED, _DARK
            text = f"diverges\n{m.diverged_s[0]:.1f} s" if m.diverged_s else "-"
        else:
            value = 1e3 * cost.mean
            share = math.log(max(value, low) / low) / math.log(high / low)
            style = {"facecolor": mpl.colormaps[_COLOURS](share), "edgecolor": "none"}
            ink = _LIGHT if share < _MIDDLE else _DARK
            text = f"{value:.2f}" + (f"\n{m.completed} of {m.runs}" if m.completed < m.runs else "")
        place = (column - 0.49, row - 0.48)
        axes.add_patch(Rectangle(place, 0.98, 0.96, **style))
        behind: Any = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6} if cost is None else None
        how: Any = {"ha": "center", "va": "center", "color": ink, "fontsize": SMALL, "linespacing": 1.0}
        axes.text(column, row, text, bbox=behind, **how)
    axes.set_xlim(-0.5, len(columns) - 0.5)
    axes.set_ylim(-0.5, len(rows) - 0.5)
    axes.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
    axes.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
    axes.tick_params(length=0.0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_variants(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant.

    Diverged runs are beside the panel, with the time of divergence, or their number if there are several.
    """
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    networks = list(dict.fromkeys(str(m.point.labels["network"]) for m in measured))
    styles = dict(zip(networks, (CURVES[i % len(CURVES)][:2] for i in range(len(networks))), strict=True))
    dots: Any = {"linestyle": "none", "markersize": MARKER}
    legend = {"": [Line2D([], [], label=n, color=c, marker=m, **dots) for n, (c, m) in styles.items()]}
    rows = [list(dict.fromkeys(_name(m) for m in measured if m.point.scenario == name)) for name in scenarios]
    panels = column_panels(
        figure,
        [_ROW_IN * len(names) for names in rows],
        x_label="",
        left_in=max(text_width_in(name) for names in rows for name in names) + 0.08,
        right_in=_STRIP_IN + _APART_IN,
        top_in=legend_height_in(legend) + _ABOVE_ROWS_IN,
        gap_in=_GAP_IN,
        bottom_in=_BELOW_IN,
    )
    draw_legend(figure, legend)
    figure.text(0.5, 0.02 / figure.get_figheight(), _TITLE, ha="center", va="bottom", fontsize=TEXT, linespacing=1.1)
    ratios = [m.cost_ratio for m in measured if m.cost_ratio is not None]
    low, high = min([1.0, *ratios]), min(max([1.0, *ratios]), _HIGHEST)
    for panel, scenario, names in zip(panels, scenarios, rows, strict=True):
        own = [m for m in measured if m.point.scenario == scenario]
        _draw_rows(panel, own, names, styles)
        head(panel, scenario, legend=False)
        panel.axvline(1.0, color=REFERENCE, linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set_ylim(len(names) - 0.5, -0.5)
        panel.set_xscale("log")
        panel.set_xlim(low / 1.15, high * 1.15)
        label_decades(panel.xaxis)
        if high / low < _NARROW:
            panel.xaxis.set_major_locator(FixedLocator(_FINE_TICKS))


def _draw_rows(
    panel: Axes, measured: Sequence[PointStatistics], names: Sequence[str], styles: dict[str, tuple[str, str]]
) -> None:
    """Draw the points of a scenario, and its diverged runs beside the panel."""
    width_in = panel.get_position().width * COLUMN_IN
    beside = blended_transform_factory(panel.transAxes, panel.transData)
    left = 1.0 + (_APART_IN + 0.04) / width_in
    if any(m.completed < m.runs for m in measured):
        up = ScaledTranslation(0.0, 2.0 / 72.0, panel.figure.dpi_scale_trans)
        panel.text(left, 1.0, "diverged", transform=panel.transAxes + up, va="bottom", fontsize=SMALL)
    for place, (network, (colour, marker)) in enumerate(styles.items()):
        shift = 0.25 * (2 * place - (len(styles) - 1))
        for m in (m for m in measured if m.point.labels["network"] == network):
            y = names.index(_name(m)) + shift
            how: dict[str, Any] = {"color": colour, "marker": marker, "markersize": MARKER, "linestyle": "none"}
            if m.cost_ratio is not None:
                panel.plot([min(m.cost_ratio, _HIGHEST)], [y], **how)
            if m.completed < m.runs:
                text = f"{m.runs - m.completed} of {m.runs}" if m.runs > 1 else f"{m.diverged_s[0]:.1f} s"
                panel.plot([left], [y], transform=beside, clip_on=False, **how | DIVERGED)
                at = left + 0.07 / width_in
                panel.text(at, y, text, transform=beside, va="center_baseline", fontsize=SMALL, color=colour)


def _name(m: PointStatistics) -> str:
    """Return the name of a variant: its texts, and its numbers with their names."""
    labels = {name: value for name, value in m.point.labels.items() if name != "network"}
    numbers = [f"{axis(name).name} {value:g}" for name, value in labels.items() if not isinstance(value, str)]
    texts = [value for value in labels.values() if isinstance(value, str) and value]
    return ", ".join([*numbers, ": ".join(texts)] if texts else numbers).replace("_", " ")
