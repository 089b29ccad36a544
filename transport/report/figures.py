"""Figures of a run: performance over time (paper Fig. 3, 5), trajectories (Fig. 4), timing."""

from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.series import Series, series_of
from transport.log.run_log import RunLog
from transport.report.beside import beside
from transport.report.figures_3d import draw_trajectories
from transport.report.figures_timing import draw_timing
from transport.report.style import COMPONENTS, RC, WIDTH_IN, line_width, save_both, scale_cost, shade_phases
from transport.scene.colours import uav_style

# Names of the figures of a run.
FIGURES = ("performance", "trajectories", "timing")
# Of these, the ones whose files are cropped, since the size of the drawing depends on the maneuver.
CROPPED = ("trajectories",)

# Labels of the four panels of the performance figure.
PERFORMANCE = (
    "UAV position\nerror, norm (m)",
    "payload position\nerror (m)",
    "payload\nattitude (deg)",
    "stage cost (-)",
)
# Shown decades of the cost; below is the rounding error of a hover.
_COST_DECADES = 5
# Smallest ranges of the axes, either side of zero; smaller errors are negligible.
_SMALLEST_M, _SMALLEST_DEG = 1e-3, 1e-2


def draw(setup: Setup, log: RunLog, folder: Path, *, forks: bool = False) -> list[Path]:
    """Draw performance, trajectories and timing of a run as PNG and SVG, as far as its log goes.

    With `forks` a forked process draws performance, half of the work, beside the others (`transport.report.beside`).

    Returns: The PNG files, without those that have no data.
    """
    series = series_of(setup, log)
    if not len(series.ticks):
        return []
    folder.mkdir(parents=True, exist_ok=True)
    first, *rest = (partial(_write, name, setup, log, series, folder) for name in FIGURES)
    with mpl.rc_context(RC), beside(first, forks=forks):
        others = [write() for write in rest]
    return [folder / f"{FIGURES[0]}.png", *(other for other in others if other is not None)]


def _write(name: str, setup: Setup, log: RunLog, series: Series, folder: Path) -> Path | None:
    """Write one of `FIGURES` as PNG and SVG; return the PNG file, None without data."""
    figure = Figure()
    if not fill(figure, name, setup, log, series):
        return None
    return save_both(figure, folder / f"{name}.png", cropped=name in CROPPED)


def fill(figure: Figure, name: str, setup: Setup, log: RunLog, series: Series) -> bool:
    """Draw one of `FIGURES` of a run with at least one tick into an empty figure; return whether there is any data.

    Figure and drawing take the style from `matplotlib.rcParams`: call it within `rc_context(RC)`.
    """
    match name:
        case "performance":
            _draw_performance(figure, setup, series)
        case "trajectories":
            draw_trajectories(figure, setup, series)
        case _:
            return draw_timing(figure, setup, log)
    return True


def _draw_performance(figure: Figure, setup: Setup, series: Series) -> None:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    figure.set_size_inches(WIDTH_IN, 7.0)
    figure.set_layout_engine("constrained")
    panels = list(figure.subplots(4, 1, sharex=True))
    plot_performance(setup, series, panels)
    for panel, label in zip(panels, PERFORMANCE, strict=True):
        panel.set_ylabel(label)
    panels[3].set_xlabel("time (s)")
    for panel in panels[:3]:
        panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    figure.align_ylabels(panels)


def plot_performance(setup: Setup, series: Series, panels: list[Axes]) -> None:
    """Plot the quantities of `PERFORMANCE` into four panels, without labels."""
    t, period_s = series.times_s, setup.settings.sampling_period_s
    shade_phases(setup, panels, float(t[-1]) + period_s)

    errors_m = np.linalg.norm(series.uav_errors_I, axis=2)
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

    panels[3].plot(t, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
    scale_cost(panels[3], float(series.cost.max()), _COST_DECADES)
