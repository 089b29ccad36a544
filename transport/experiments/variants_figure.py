"""Variants figure: a row for each variant of a scenario, a colour for each network."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from transport.experiments.quantities import quantity
from transport.experiments.statistics import PointStatistics
from transport.report.column import column_panels, draw_legend, head, legend_height_in, text_width_in
from transport.report.style import COLUMN_IN, CURVES, DIVERGED, MARKER, REFERENCE, SMALL, TEXT, label_decades

_ROW_IN, _ABOVE_IN, _GAP_IN, _BELOW_IN = 0.185, 0.2, 0.28, 0.38
# Width of the strip of diverged runs, and its distance from the panel, inches.
_STRIP_IN, _APART_IN = 0.5, 0.08
_TITLE = "mean cost over that of the unchanged scenario\non a perfect network"
# Larger ratios are drawn at this value.
_HIGHEST = 100.0
# Ratios that span less than this factor have finer ticks than 1, 2, 5.
_NARROW, _FINE_TICKS = 3.0, (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0)


def draw_variants(figure: Figure, measured: Sequence[PointStatistics]) -> None:
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
        top_in=legend_height_in(legend) + _ABOVE_IN,
        gap_in=_GAP_IN,
        bottom_in=_BELOW_IN,
    )
    draw_legend(figure, legend)
    figure.text(0.5, 0.02 / figure.get_figheight(), _TITLE, ha="center", va="bottom", fontsize=TEXT, linespacing=1.1)
    ratios = [m.cost_ratio for m in measured if m.cost_ratio is not None]
    low, high = min([1.0, *ratios]), min(max([1.0, *ratios]), _HIGHEST)
    for panel, scenario, names in zip(panels, scenarios, rows, strict=True):
        own = [m for m in measured if m.point.scenario == scenario]
        _draw(panel, own, names, styles)
        head(panel, scenario, legend=False)
        panel.axvline(1.0, color=REFERENCE, linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set_ylim(len(names) - 0.5, -0.5)
        panel.set_xscale("log")
        panel.set_xlim(low / 1.15, high * 1.15)
        label_decades(panel.xaxis)
        if high / low < _NARROW:
            panel.xaxis.set_major_locator(FixedLocator(_FINE_TICKS))


def _draw(
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
    numbers = [f"{quantity(name).name} {value:g}" for name, value in labels.items() if not isinstance(value, str)]
    texts = [value for value in labels.values() if isinstance(value, str) and value]
    return ", ".join([*numbers, ": ".join(texts)] if texts else numbers).replace("_", " ")
