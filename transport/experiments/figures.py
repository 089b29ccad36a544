"""Figures of an experiment as PNG, and as SVG for papers: curves, maps of two quantities, variants.

A map has cost as colour and completed runs as numbers. Variants have a row each, and a colour for each network.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import Affine2D, ScaledTranslation

from transport.experiments.curve_figure import draw_curves
from transport.experiments.declaration import Axis, Experiment, axis
from transport.experiments.statistics import PointStatistics
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

# Height of a row of a map; room above a panel, and at the right for the colour scale and its numbers.
_CELL_IN, _ABOVE_IN, _RIGHT_IN = 0.27, 0.2, 0.42

# Height of a row of variants, room around their panels, and width of the strip of diverged runs beside them.
_ROW_IN, _GAP_IN, _BELOW_IN, _STRIP_IN = 0.185, 0.28, 0.38, 0.5
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
    columns, rows = (sorted({float(m.point.labels[one.label]) for m in measured}) for one in (x, y))
    heights_in = [_CELL_IN * len(rows)] * len(scenarios)
    panels = column_panels(figure, heights_in, x_label=x.title, right_in=_RIGHT_IN, top_in=_ABOVE_IN)
    costs = [1e3 * cost for m in measured if (cost := m.mean("cost_mean"))] or [1.0]
    scale = LogNorm(min(costs), max(max(costs), 1.001 * min(costs)))
    for panel, scenario in zip(panels, scenarios, strict=True):
        shown = np.full((len(rows), len(columns)), np.nan)
        for m in (m for m in measured if m.point.scenario == scenario):
            column, row = (where.index(float(m.point.labels[one.label])) for where, one in ((columns, x), (rows, y)))
            cost = m.mean("cost_mean")
            text = f"diverges\n{m.diverged_s[0]:.1f} s" if m.diverged_s else "-"
            if cost is not None:
                shown[row, column] = max(1e3 * cost, min(costs))
                text = f"{1e3 * cost:.2f}" + f"\n{m.completed} of {m.runs}" * (m.completed < m.runs)
            dark = cost is not None and scale(shown[row, column]) < 0.55
            how: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "linespacing": 1.0}
            behind = None if cost is not None else {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6}
            panel.text(column, row, text, color="#ffffff" if dark else "#000000", bbox=behind, **how)
        panel.patch.set(hatch="////", edgecolor="#c8c8c8", linewidth=0.0)  # behind cells without a completed run
        image = panel.pcolormesh(shown, norm=scale, edgecolors="#ffffff", linewidth=1.5)
        image.set_transform(Affine2D().translate(-0.5, -0.5) + panel.transData)
        head(panel, scenario, legend=False)
        panel.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
        panel.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
        panel.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-0.5, len(rows) - 0.5), ylabel=y.title)
        panel.tick_params(length=0.0)
        panel.grid(visible=False)
        panel.spines[:].set_visible(False)
    bottom, top = panels[-1].get_position().y0, panels[0].get_position().y1
    place = (panels[0].get_position().x1 + 0.08 / COLUMN_IN, bottom, 0.09 / COLUMN_IN, top - bottom)
    bar = figure.colorbar(ScalarMappable(scale), cax=figure.add_axes(place))
    label_decades(bar.ax.yaxis)
    bar.outline.set_visible(False)
    above = top + 2.0 / 72.0 / figure.get_figheight()
    figure.text(0.99, above, "mean cost ($10^{-3}$)", ha="right", va="bottom", fontsize=TEXT)


def _draw_variants(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant.

    Points with diverged runs have a mark beside the panel.
    """
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    networks = list(dict.fromkeys(str(m.point.labels["network"]) for m in measured))
    styles: list[dict[str, Any]] = [
        {"color": colour, "marker": marker, "markersize": MARKER, "linestyle": "none"}
        for colour, marker, _ in (CURVES[i % len(CURVES)] for i in range(len(networks)))
    ]
    rows = [list(dict.fromkeys(_name(m) for m in measured if m.point.scenario == name)) for name in scenarios]
    panels = column_panels(
        figure,
        [_ROW_IN * len(names) for names in rows],
        legend=[Line2D([], [], label=name, **style) for name, style in zip(networks, styles, strict=True)],
        x_label="",
        left_in=max(text_width_in(name) for names in rows for name in names) + 0.08,
        right_in=_STRIP_IN,
        top_in=_ABOVE_IN,
        gap_in=_GAP_IN,
        bottom_in=_BELOW_IN,
    )
    figure.text(0.5, 0.02 / figure.get_figheight(), _TITLE, ha="center", va="bottom", fontsize=TEXT, linespacing=1.1)
    ratios = [1.0, *(min(m.cost_ratio, _HIGHEST) for m in measured if m.cost_ratio is not None)]
    low, high = min(ratios), max(ratios)
    for panel, scenario, names in zip(panels, scenarios, rows, strict=True):
        diverged = False
        for m in (m for m in measured if m.point.scenario == scenario):
            network = networks.index(str(m.point.labels["network"]))
            y, style = names.index(_name(m)) + 0.25 * (2 * network - (len(networks) - 1)), styles[network]
            if m.cost_ratio is not None:
                panel.plot([min(m.cost_ratio, _HIGHEST)], [y], **style)
            if m.completed < m.runs:
                diverged = True
                beside = panel.get_yaxis_transform() + ScaledTranslation(0.12, 0.0, figure.dpi_scale_trans)
                panel.plot([1.0], [y], transform=beside, clip_on=False, **style | DIVERGED)
        if diverged:
            panel.annotate("diverged", (1.0, 1.0), (8.0, 2.0), "axes fraction", "offset points", fontsize=SMALL)
        head(panel, scenario, legend=False)
        panel.axvline(1.0, color=REFERENCE, linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set(xscale="log", xlim=(low / 1.15, high * 1.15), ylim=(len(names) - 0.5, -0.5))
        label_decades(panel.xaxis)
        if high / low < _NARROW:
            panel.xaxis.set_major_locator(FixedLocator(_FINE_TICKS))


def _name(m: PointStatistics) -> str:
    """Return the name of a variant: its texts, and its numbers with their names."""
    labels = {name: value for name, value in m.point.labels.items() if name != "network"}
    numbers = [f"{axis(name).name} {value:g}" for name, value in labels.items() if not isinstance(value, str)]
    texts = [value for value in labels.values() if isinstance(value, str) and value]
    return ", ".join([*numbers, ": ".join(texts)] if texts else numbers).replace("_", " ")
