"""Figures of a run: performance over time (paper Fig. 3, 5), inputs with limits, trajectories (Fig. 4), timing."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.series import Series, series_of
from transport.analysis.swing import SWING_S, swing_of
from transport.log.run_log import RunLog
from transport.report.beside import beside
from transport.report.column import column_panels, finish, head
from transport.report.figures_3d import draw_trajectories
from transport.report.figures_inputs import draw_inputs
from transport.report.figures_timing import draw_timing
from transport.report.marks import marks_of
from transport.report.style import COMPONENTS, RC, REFERENCE, line_width, save_both, scale_cost
from transport.scene.colours import uav_style

# Names of the figures of a run.
FIGURES = ("performance", "inputs", "trajectories", "timing")
# Of these, the ones whose files are cropped, since the size of the drawing depends on the maneuver.
CROPPED = ("trajectories",)
# Number of figures that a forked process draws.
_BESIDE = 2

# Shown decades of the cost; below is the rounding error of a hover.
_COST_DECADES = 5
# Smallest ranges of the axes, either side of zero; smaller errors are negligible.
_SMALLEST_M, _SMALLEST_DEG = 1e-3, 1e-2
_HEIGHT_IN = 0.95


def draw(setup: Setup, log: RunLog, folder: Path, *, forks: bool = False, pdf: bool = False) -> list[Path]:
    """Draw `FIGURES` of a run as PNG and SVG, with `pdf` as PDF too, as far as its log goes.

    With `forks` a forked process draws the first two, half of the work, beside the others (`transport.report.beside`).

    Returns: The PNG files, without those that have no data.
    """
    series = series_of(setup, log)
    if not len(series.ticks):
        return []
    folder.mkdir(parents=True, exist_ok=True)

    def write(names: Sequence[str]) -> list[Path]:
        return [path for name in names if (path := _write(name, setup, log, series, folder, pdf=pdf)) is not None]

    with mpl.rc_context(RC), beside(partial(write, FIGURES[:_BESIDE]), forks=forks):
        others = write(FIGURES[_BESIDE:])
    return [*(folder / f"{name}.png" for name in FIGURES[:_BESIDE]), *others]  # those have data at any tick


def _write(name: str, setup: Setup, log: RunLog, series: Series, folder: Path, *, pdf: bool) -> Path | None:
    """Write one of `FIGURES` as PNG and SVG, perhaps PDF; return the PNG file, None without data."""
    figure = Figure()
    if not fill(figure, name, setup, log, series):
        return None
    return save_both(figure, folder / f"{name}.png", cropped=name in CROPPED, pdf=pdf)


def fill(figure: Figure, name: str, setup: Setup, log: RunLog, series: Series) -> bool:
    """Draw one of `FIGURES` of a run with at least one tick into an empty figure; return whether there is any data.

    Figure and drawing take the style from `matplotlib.rcParams`: call it within `rc_context(RC)`.
    """
    match name:
        case "performance":
            _draw_performance(figure, setup, log, series)
        case "inputs":
            draw_inputs(figure, setup, log, series)
        case "trajectories":
            draw_trajectories(figure, setup, series)
        case _:
            return draw_timing(figure, setup, log)
    return True


def _draw_performance(figure: Figure, setup: Setup, log: RunLog, series: Series) -> None:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    marks = marks_of(setup, log)
    has_cost = bool((series.cost > 0.0).any())
    panels = column_panels(figure, [_HEIGHT_IN] * (3 + has_cost), marks)
    _plot_performance(setup, series, panels)
    swing_m = swing_of(setup, series).largest_m
    swing = "" if swing_m is None else f", swing {swing_m:.2f} m"
    if swing_m is not None:
        last_s = float(series.times_s[-1])
        for sign in (-1.0, 1.0):
            span_s = [max(0.0, last_s - SWING_S), last_s]
            panels[1].plot(span_s, [sign * swing_m] * 2, color=REFERENCE, linestyle="--", linewidth=0.8)
    head(panels[0], "UAV position error (m)")
    head(panels[1], f"payload error (m){swing}")
    head(panels[2], "payload attitude (deg)")
    if has_cost:
        head(panels[3], "stage cost")
    finish(figure, panels, setup, float(series.times_s[-1]) + setup.settings.sampling_period_s, marks)


def _plot_performance(setup: Setup, series: Series, panels: list[Axes]) -> None:
    """Plot errors, attitude and cost into four panels, or all but the cost into three, without labels."""
    t = series.times_s
    errors_m = np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), np.nan)  # released ones have left
    N = setup.system.N
    for i in range(N):
        panels[0].plot(t, errors_m[:, i], label=f"UAV{i + 1}", linewidth=line_width(i, N, 2.6), **uav_style(i))
    panels[0].set_ylim(0.0, max(panels[0].get_ylim()[1], _SMALLEST_M))
    for values, panel, names, smallest in (
        (series.payload_error_I, panels[1], ("x", "y", "z (down)"), _SMALLEST_M),
        (series.attitude_deg, panels[2], ("roll", "pitch", "yaw"), _SMALLEST_DEG),
    ):
        for column, (name, colour) in enumerate(zip(names, COMPONENTS, strict=True)):
            panel.plot(t, values[:, column], color=colour, label=name, linewidth=line_width(column, 3, 1.8))
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -smallest), max(high, smallest))

    if len(panels) > 3:
        panels[3].plot(t, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
        scale_cost(panels[3], float(series.cost.max()), _COST_DECADES)
