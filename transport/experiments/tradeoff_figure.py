"""Tradeoff figure: cost and attitude over the share of plans sent, for each network."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from transport.experiments.curve_figure import MARKER, PRINT, curve_style, draw_legend
from transport.experiments.statistics import PointStatistics
from transport.report.style import WIDTH_IN

# Panels: title, number ("" for the cost ratio).
_PANELS = (("mean cost over that\nwith all plans sent", ""), ("largest payload\nattitude (deg)", "attitude_max_deg"))
_PANEL_IN, _AROUND_IN = 1.7, 0.9

# Margin of the logarithmic axis, as a factor.
_MARGIN = 0.75


def draw_tradeoff(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw a column of panels for each scenario, with a curve for each network and a marker for each threshold."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    figure.set_size_inches(WIDTH_IN, _PANEL_IN * len(_PANELS) + _AROUND_IN)
    panels = figure.subplots(len(_PANELS), len(scenarios), sharex=True, sharey="row", squeeze=False)
    networks = list(dict.fromkeys(m.point.group for m in measured))
    sent = [share.mean for m in measured if (share := m.numbers["plans_shared_share"]) is not None]
    for scenario, column in zip(scenarios, panels.T, strict=True):
        for index, network in enumerate(networks):
            points = [m for m in measured if (m.point.scenario, m.point.group) == (scenario, network)]
            shares = [_mean(m, "plans_shared_share") * 100.0 for m in points]
            for panel, (_, name) in zip(column, _PANELS, strict=True):
                values = [_mean(m, name) if name else m.cost_ratio or math.nan for m in points]
                panel.plot(shares, values, **curve_style(index), label=network, markersize=MARKER)
                for x, y, m in zip(shares, values, points, strict=True):
                    if index == 0 and math.isfinite(x) and math.isfinite(y):
                        text, offset = f"{m.point.labels['share_threshold']:g}", (0.0, 1.2 * MARKER)
                        panel.annotate(text, (x, y), offset, textcoords="offset points", ha="center", fontsize=PRINT)
        bottom = column[-1]
        bottom.set_xlabel("plans sent (%); numbers in the figure: threshold")
        bottom.set_xscale("log")
        bottom.set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
        bottom.minorticks_off()
        bottom.set_xlim(_MARGIN * 100.0 * min(sent, default=0.01), 100.0 / _MARGIN)
        if len(scenarios) > 1:
            column[0].set_title(scenario)
    for panel, (title, _) in zip(panels[:, 0], _PANELS, strict=True):
        panel.set_ylabel(title)
        panel.margins(y=0.2)
    panels[1, 0].set_ylim(bottom=0.0)
    figure.align_ylabels(panels[:, 0])
    draw_legend(figure, panels[0, 0])


def _mean(m: PointStatistics, name: str) -> float:
    value = m.numbers[name]
    return math.nan if value is None else value.mean
