"""Figure of several runs: cost, payload attitude and payload error over time."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from transport.report.compare import Compared, same_maneuver
from transport.report.style import CURVES, RC, WIDTH_IN, line_width, save, scale_cost, shade_phases

# Shown decades of the cost.
_COST_DECADES = 5
_PANELS = ("stage cost (-)", "payload attitude,\nlargest angle (deg)", "payload position\nerror, norm (m)")
_HEIGHT_IN, _LEGEND_IN = 5.6, 0.2


def draw_compared(runs: Sequence[Compared], folder: Path) -> list[Path]:
    """Draw compare.png and compare.svg of runs, at least one of them with a tick, in a folder; return the files."""
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN + _LEGEND_IN * len(runs)), layout="constrained")
        panels = list(figure.subplots(3, 1, sharex=True))
        shown = [compared for compared in runs if len(compared.series.ticks)]
        until_s = max(float(c.series.times_s[-1]) + c.run.setup.settings.sampling_period_s for c in shown)
        if same_maneuver(shown):
            shade_phases(shown[0].run.setup, panels, until_s)
        top = 0.0
        for i, compared in enumerate(runs):
            if compared not in shown:
                continue
            series, (colour, _, line) = compared.series, CURVES[i % len(CURVES)]
            style = {"color": colour, "linestyle": line, "linewidth": line_width(i, len(runs), 2.0)}
            error_m = np.linalg.norm(series.payload_error_I, axis=1)
            positive = np.where(series.cost > 0.0, series.cost, np.nan)
            for panel, values in zip(panels, (positive, series.attitude_max_deg, error_m), strict=True):
                panel.plot(series.times_s, values, label=compared.label, **style)
            top = max(top, float(np.nanmax(np.append(series.cost, 0.0))))
        scale_cost(panels[0], top, _COST_DECADES)
        for panel, label in zip(panels, _PANELS, strict=True):
            panel.set_ylabel(label)
        for panel in panels[1:]:
            panel.set_ylim(bottom=0.0)
        panels[0].set_xlim(0.0, until_s)
        panels[-1].set_xlabel("time (s)")
        figure.align_ylabels(panels)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=1)
        return [save(figure, folder / f"compare.{ending}") for ending in ("png", "svg")]
