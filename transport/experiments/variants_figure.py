"""Variants figure: a row for each variant of a scenario, a colour for each network."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import blended_transform_factory

from transport.experiments.curve_figure import draw_legend
from transport.experiments.statistics import PointStatistics
from transport.report.style import WIDTH_IN, label_decades

# Colour (Okabe and Ito 2008) and marker of each network.
_STYLES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"))
_ROW_IN, _FRAME_IN = 0.19, 1.1
# Larger ratios are drawn at this value.
_HIGHEST = 100.0
# Ratios that span less than this factor have finer ticks than 1, 2, 5.
_NARROW, _FINE_TICKS = 3.0, (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0)


def draw_variants(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw the cost over the baseline's: a panel for each scenario, a row for each variant."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    networks = list(dict.fromkeys(str(m.point.labels["network"]) for m in measured))
    rows = [list(dict.fromkeys(_name(m) for m in measured if m.point.scenario == name)) for name in scenarios]
    figure.set_size_inches(WIDTH_IN, _FRAME_IN + _ROW_IN * sum(len(names) + 2 for names in rows))
    heights = [len(names) + 1 for names in rows]
    panels = figure.subplots(len(scenarios), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    ratios = [m.cost_ratio for m in measured if m.cost_ratio is not None]
    low, high = min([1.0, *ratios]), min(max([1.0, *ratios]), _HIGHEST)
    for panel, scenario, names in zip(panels, scenarios, rows, strict=True):
        across = blended_transform_factory(panel.transAxes, panel.transData)
        for place, network in enumerate(networks):
            colour, marker = _STYLES[place % len(_STYLES)]
            shift = 0.22 * (2 * place - (len(networks) - 1))
            own = [m for m in measured if (m.point.scenario, m.point.labels["network"]) == (scenario, network)]
            label: str | None = network
            for m in own:
                y = names.index(_name(m)) + shift
                if m.cost_ratio is not None:
                    x = min(m.cost_ratio, _HIGHEST)
                    panel.plot([x], [y], marker, color=colour, markersize=4.0, label=label, linestyle="none")
                    label = None
                if m.completed < m.runs:
                    count, at = f"{m.runs - m.completed} of {m.runs} diverged", f"diverged at {m.diverged_s[0]:.1f} s"
                    text = count if m.runs > 1 else at
                    panel.text(1.01, y, text, transform=across, va="center", fontsize=6.5, color=colour)
        panel.axvline(1.0, color="#8c8c8c", linewidth=0.8, zorder=0)
        panel.set_yticks(range(len(names)), names)
        panel.set_ylim(len(names) - 0.4, -0.6)
        panel.set_xscale("log")
        panel.set_xlim(low / 1.15, high * 1.15)
        label_decades(panel.xaxis)
        if high / low < _NARROW:
            panel.xaxis.set_major_locator(FixedLocator(_FINE_TICKS))
        panel.set_title(scenario, loc="left")
    panels[-1].set_xlabel("mean cost over that as it is on a perfect network")
    draw_legend(figure, *panels[::-1])


def _name(m: PointStatistics) -> str:
    labels = ((name, value) for name, value in m.point.labels.items() if name != "network")
    texts = (value if isinstance(value, str) else f"{name} {value:g}" for name, value in labels)
    return " ".join(texts).replace("_", " ").strip()
