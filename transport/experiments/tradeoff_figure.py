"""Messages against cost: what it costs to send fewer plans, for each network."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from transport.experiments.curves import MARKER, PRINT
from transport.experiments.statistics import Measured
from transport.report.style import CURVES, WIDTH_IN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What is drawn against the share of plans sent: title, number ("" for the cost over that with all plans sent).
_PANELS = (("mean cost over that\nwith all plans sent", ""), ("largest payload\nattitude (deg)", "attitude_max_deg"))
_PANEL_IN, _AROUND_IN = 1.7, 0.9

# Room on either side of a logarithmic axis, as a factor.
_MARGIN = 0.75


def draw_tradeoff(figure: "Figure", measured: Sequence[Measured]) -> None:
    """A column of panels for each scenario, a curve for each network, a point for each threshold.

    Args:
        figure: Empty.
        measured: What came of each point; points without a completed flight are left out.
    """
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    figure.set_size_inches(WIDTH_IN, _PANEL_IN * len(_PANELS) + _AROUND_IN)
    panels = figure.subplots(len(_PANELS), len(scenarios), sharex=True, sharey="row", squeeze=False)
    networks = list(dict.fromkeys(m.point.group for m in measured))
    for scenario, column in zip(scenarios, panels.T, strict=True):
        for index, network in enumerate(networks):
            points = [m for m in measured if (m.point.scenario, m.point.group) == (scenario, network)]
            shares = [_mean(m, "plans_shared_share") * 100.0 for m in points]
            style = dict(zip(("color", "marker", "linestyle"), CURVES[index % len(CURVES)], strict=True))
            for panel, (_, name) in zip(column, _PANELS, strict=True):
                values = [_mean(m, name) if name else m.cost_ratio or math.nan for m in points]
                panel.plot(shares, values, **style, label=network, markersize=MARKER)
                for x, y, m in zip(shares, values, points, strict=True):
                    if index == 0 and math.isfinite(x) and math.isfinite(y):
                        text, away = f"{m.point.labels['share_threshold']:g}", (0.0, 1.2 * MARKER)
                        panel.annotate(text, (x, y), away, textcoords="offset points", ha="center", fontsize=PRINT)
        column[-1].set_xlabel("plans sent (%); numbers in the figure: threshold")
        column[-1].set_xscale("log")
        column[-1].set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
        column[-1].minorticks_off()
        sent = [share.mean for m in measured if (share := m.numbers["plans_shared_share"]) is not None]
        column[-1].set_xlim(_MARGIN * 100.0 * min(sent, default=0.01), 100.0 / _MARGIN)
        if len(scenarios) > 1:
            column[0].set_title(scenario)
    for panel, (title, _) in zip(panels[:, 0], _PANELS, strict=True):
        panel.set_ylabel(title)
        panel.margins(y=0.2)
    panels[1, 0].set_ylim(bottom=0.0)
    figure.align_ylabels(panels[:, 0])
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def _mean(m: Measured, name: str) -> float:
    value = m.numbers[name]
    return math.nan if value is None else value.mean
