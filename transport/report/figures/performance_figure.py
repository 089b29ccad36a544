"""Figure of the performance over time (paper Fig. 3): position errors, attitude and cost."""

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.cost_and_tracking_metrics import SWING_S, swing_of
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import head, label_ends, widen
from transport.report.figures.curves_over_time import (
    ANGLES,
    LEAST_DEG,
    LEAST_M,
    PLACES,
    WIDER,
    Panels,
    height_of_uavs_in,
    long_legend,
    plot_components,
    plot_uavs,
)
from transport.report.figures.style import REFERENCE, scale_cost

_HEIGHT_IN = 0.95
# Shown decades of the cost; below is the rounding error of a hover.
_COST_DECADES = 5


def draw_performance(setup: Setup, _: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    swing_m = swing_of(setup, series)
    heights_in = [height_of_uavs_in(setup, _HEIGHT_IN), *[_HEIGHT_IN] * 3]
    whole, payload, attitude, cost = panels_of(heights_in, legend=long_legend(setup))

    errors_m = np.linalg.norm(series.uav_errors_I, axis=2)
    errors_m = np.where(series.on_rods, errors_m, np.nan)  # released ones have left
    uavs = plot_uavs(whole, series.times_s, errors_m, widest=WIDER)
    for panel in uavs:
        panel.set_ylim(0.0, max(panel.get_ylim()[1], LEAST_M))
        if len(uavs) > 1:
            label_ends(panel)

    plot_components(payload, series.times_s, series.payload_error_I, PLACES)
    widen(payload, -LEAST_M, LEAST_M)
    plot_components(attitude, series.times_s, series.attitude_deg, ANGLES)
    widen(attitude, -LEAST_DEG, LEAST_DEG)
    if swing_m is not None:
        _draw_swing(payload, float(series.times_s[-1]), swing_m)

    cost.plot(series.times_s, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
    scale_cost(cost, float(series.cost.max()), _COST_DECADES)

    swing = "" if swing_m is None else f", swing {swing_m:.2f} m"
    head(uavs[0], "UAV position error (m)")
    head(payload, f"payload error (m){swing}")
    head(attitude, "payload attitude (deg)")
    head(cost, "stage cost")
    return [*uavs, payload, attitude, cost]


def _draw_swing(panel: Axes, end_s: float, swing_m: float) -> None:
    """Draw the swing at the end of a run, either sign."""
    span_s = [max(0.0, end_s - SWING_S), end_s]
    for height_m in (-swing_m, swing_m):
        panel.plot(span_s, [height_m] * 2, color=REFERENCE, linestyle="--", linewidth=0.8)
