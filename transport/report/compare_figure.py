"""Figure of several runs, one over another: errors of UAVs and payload, payload attitude and cost over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from model.arrays import Array
from protocol.scenario.setup import Setup
from transport.analysis.series import Series
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.compare import Compared, same_maneuver
from transport.report.style import CURVES, RC, line_width, save, scale_cost, shade_phases

# Shown decades of the cost.
_COST_DECADES = 5
_PANELS = (
    "largest UAV position error (m)",
    "payload position error (m)",
    "payload attitude, largest angle (deg)",
    "stage cost",
)
_HEIGHT_IN = 0.9
# Room above the first panel for its title and the names of the phases.
_ABOVE_IN = 0.3


class Overlaid(NamedTuple):
    """A run in the figure."""

    label: str
    setup: Setup
    series: Series  # at least one tick


def draw_compared(runs: Sequence[Compared], folder: Path) -> list[Path]:
    """Draw compare.png and compare.svg of runs, at least one of them with a tick, in a folder; return the files."""
    shown = [compared for compared in runs if len(compared.series.ticks)]
    with mpl.rc_context(RC):
        figure = Figure()
        overlaid = [Overlaid(compared.label, compared.run.setup, compared.series) for compared in shown]
        fill_overlaid(figure, overlaid, shaded=same_maneuver(shown))
        return [save(figure, folder / f"compare.{ending}") for ending in ("png", "svg")]


def fill_overlaid(figure: Figure, runs: Sequence[Overlaid], *, shaded: bool) -> None:
    """Draw runs over one another into an empty figure, perhaps with the phases of the first."""
    styles: list[dict[str, Any]] = [
        {"color": colour, "linestyle": line, "linewidth": line_width(i, len(runs), 1.8)}
        for i in range(len(runs))
        for colour, _, line in [CURVES[i % len(CURVES)]]
    ]
    rows = {"": [Line2D([], [], label=run.label, **style) for run, style in zip(runs, styles, strict=True)]}
    has_cost = any((run.series.cost > 0.0).any() for run in runs)
    titles = _PANELS if has_cost else _PANELS[:-1]
    panels = column_panels(figure, [_HEIGHT_IN] * len(titles), top_in=legend_height_in(rows) + _ABOVE_IN)
    draw_legend(figure, rows)
    for run, style in zip(runs, styles, strict=True):
        for panel, values in zip(panels, _curves(run.series), strict=False):
            panel.plot(run.series.times_s, values, **style)
    until_s = max(float(run.series.times_s[-1]) + run.setup.settings.sampling_period_s for run in runs)
    for panel, title in zip(panels, titles, strict=True):
        head(panel, title, legend=False)
        panel.set_xlim(0.0, until_s)
        panel.set_ylim(bottom=0.0)
    if has_cost:
        scale_cost(panels[-1], max(float(np.nanmax(run.series.cost)) for run in runs), _COST_DECADES)
    if shaded:
        shade_phases(runs[0].setup, panels, until_s)


def _curves(series: Series) -> tuple[Array, Array, Array, Array]:
    """Return the quantities of the panels, (T,) each; UAVs that have been released and costs of zero are left out."""
    uavs_m = np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), 0.0).max(axis=1)
    payload_m = np.linalg.norm(series.payload_error_I, axis=1)
    return uavs_m, payload_m, series.attitude_max_deg, np.where(series.cost > 0.0, series.cost, np.nan)
