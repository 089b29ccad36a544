"""Figures of a run: performance over time (paper Fig.

3, 5), inputs with limits, trajectories (Fig. 4), timing.
"""

from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.communication import rest_of_tick_ms
from transport.analysis.comparison import Comparison
from transport.analysis.estimates import estimates_of
from transport.analysis.series import SWING_S, Series, swing_of
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import STAGES, StepReport
from transport.report.column import (
    CLOSE,
    MOST_BESIDE,
    column_panels,
    finish,
    head,
    limits,
    marks_of,
    widen,
)
from transport.report.figures_3d import draw_trajectories
from transport.report.radio_figure import draw_radio
from transport.report.style import (
    COMPONENTS,
    RC,
    REFERENCE,
    label_decades,
    line_width,
    save,
    scale_cost,
    shade_phases,
)
from transport.scene.drawing import uav_style

# Makes the panels of a figure, given their heights, inches, and a legend above them.
Panels = Callable[..., list[Axes]]
# Names of the figures of a run.
FIGURES = ("performance", "inputs", "trajectories", "timing", "estimate", "radio")
# Number of figures that a forked process draws.
_BESIDE = 2

# Shown decades of the cost; below is the rounding error of a hover.
_COST_DECADES = 5
# Smallest ranges of the axes, either side of zero, m and deg; smaller errors are negligible; and of
# inputs, N and N m.
_SMALLEST_M, _SMALLEST_DEG, _LEAST = 1e-3, 1e-2, 1e-3
_HEIGHT_IN, _INPUT_IN, _REPLAY_IN = 0.95, 0.7, 1.1
# Shown distances from obstacles as a multiple of the largest margin.
_NEAR = 6.0
_AXES, _PLACES = ("roll", "pitch", "yaw"), ("x", "y", "z (down)")
_BY_COMPONENT: list[dict[str, Any]] = [{"color": colour} for colour in COMPONENTS]

_OVER_TIME_IN, _BAR_IN = 1.5, 0.14  # heights of the figure of times
_PERIOD: Any = {"color": "#B2182B", "linestyle": "--", "linewidth": 0.8}
# Dots, since lines would hide other agents behind every outlier; those of the legend are larger.
_DOTS: Any = {"linestyle": "none", "markersize": 1.4, "markeredgewidth": 0.0}
_SAMPLE: Any = _DOTS | {"markersize": 4.0}
_REST: Any = {"color": REFERENCE, "marker": "o"}


def draw(run: AnalysedRun, folder: Path, *, forks: bool = False, pdf: bool = False) -> list[Path]:
    """Draw `FIGURES` of a run as PNG and SVG, with `pdf` as PDF too, as far as its log goes.

    With `forks`, which only processes of one thread may do, a forked process draws the first two,
    half of the work.
    Returns: The PNG files, without those that have no data. Raises: ChildProcessError: the forked
        process failed.
    """
    if not len(run.series.ticks):
        return []
    folder.mkdir(parents=True, exist_ok=True)

    def write(names: Sequence[str]) -> list[Path]:
        files = []
        for name in names:
            figure = Figure()
            if fill(figure, name, run):
                files.append(save(figure, folder / f"{name}.png", pdf=pdf)[0])
        return files

    with mpl.rc_context(RC):
        if not forks:
            return write(FIGURES)
        process = get_context("fork").Process(target=write, args=(FIGURES[:_BESIDE],), daemon=True)
        process.start()
        others = write(FIGURES[_BESIDE:])
        process.join()
    if process.exitcode:
        raise ChildProcessError(
            f"a forked process of the report failed (exit status {process.exitcode})"
        )
    return [
        *(folder / f"{name}.png" for name in FIGURES[:_BESIDE]),
        *others,
    ]  # those have data at any tick


def fill(figure: Figure, name: str, run: AnalysedRun) -> bool:
    """Draw one of `FIGURES` of a run with at least one tick into an empty figure.

    Return whether there is any data.

    Figure and drawing take the style from `matplotlib.rcParams`: call it within `rc_context(RC)`.
    """
    setup = run.setup
    log = run.log
    series = run.series
    if name == "trajectories":
        draw_trajectories(figure, setup, series)
        return True
    if name == "timing":
        return _draw_timing(figure, setup, log)
    over_time: dict[str, Callable[..., list[Axes]]] = {
        "performance": _draw_performance,
        "inputs": _draw_inputs,
        "estimate": _draw_estimate,
        "radio": draw_radio,
    }
    marks = marks_of(setup, log)
    panels = over_time[name](setup, log, series, partial(column_panels, figure, marks=marks))
    if panels:
        finish(
            figure,
            panels,
            setup,
            float(series.times_s[-1]) + setup.settings.sampling_period_s,
            marks,
        )
    return bool(panels)


def _draw_performance(setup: Setup, _: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    t, swing_m = series.times_s, swing_of(setup, series)
    panels = panels_of([_HEIGHT_IN] * 4, legend=_long_legend(setup))
    errors_m = np.where(
        series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), np.nan
    )  # released ones have left
    _plot_uavs(panels[0], t, errors_m, widest=2.6)
    panels[0].set_ylim(0.0, max(panels[0].get_ylim()[1], _SMALLEST_M))
    _plot(panels[1], t, series.payload_error_I, _PLACES, _BY_COMPONENT)
    widen(panels[1], -_SMALLEST_M, _SMALLEST_M)
    _plot(panels[2], t, series.attitude_deg, _AXES, _BY_COMPONENT)
    widen(panels[2], -_SMALLEST_DEG, _SMALLEST_DEG)
    if swing_m is not None:
        span_s = [max(0.0, float(t[-1]) - SWING_S), float(t[-1])]
        for sign in (-1.0, 1.0):
            panels[1].plot(
                span_s, [sign * swing_m] * 2, color=REFERENCE, linestyle="--", linewidth=0.8
            )
    panels[3].plot(t, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
    scale_cost(panels[3], float(series.cost.max()), _COST_DECADES)
    swing = "" if swing_m is None else f", swing {swing_m:.2f} m"
    titles = (
        "UAV position error (m)",
        f"payload error (m){swing}",
        "payload attitude (deg)",
        "stage cost",
    )
    for panel, title in zip(panels, titles, strict=True):
        head(panel, title)
    return panels


def _draw_estimate(_: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw the payload's pose, an agent's estimate of it and three standard deviations.

    None without a Kalman filter.

    Positions are those from the reference.
    """
    found = estimates_of(series, log)
    if found is None:
        return []
    agent = int(found.agents.min())
    own = found.agents == agent
    rows, t = found.rows[own], series.times_s
    true = np.hstack([series.payload_error_I, series.attitude_deg])
    pose, deviations = found.pose[own], 3.0 * np.sqrt(np.diagonal(found.P[own], axis1=1, axis2=2))
    pose[:, :3] -= series.payload_reference_I[rows]
    pose[:, 3:], deviations[:, 3:] = np.degrees(pose[:, 3:]), np.degrees(deviations[:, 3:])
    titles = [
        *(f"payload error {axis} (m)" for axis in _PLACES),
        *(f"payload {axis} (deg)" for axis in _AXES),
    ]
    panels = panels_of([_INPUT_IN] * len(titles))
    for i, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        panel.plot(t, true[:, i], color="#000000", label="true", linewidth=1.2)
        style: dict[str, Any] = {
            "fmt": "o",
            "markersize": 2.0,
            "elinewidth": 0.8,
            "color": COMPONENTS[1],
        }
        panel.errorbar(
            t[rows], pose[:, i], deviations[:, i], label=f"agent {agent}, 3 sigma", **style
        )
        smallest = _SMALLEST_M if i < len(_PLACES) else _SMALLEST_DEG
        widen(panel, -smallest, smallest)
        head(panel, title, legend=i == 0)
    return panels


def _draw_inputs(setup: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw inputs, separation, distance from obstacles and age of plans.

    Panels without data are left out.
    """
    t, obstacles, separation = series.times_s, setup.obstacles, setup.settings.separation
    used: dict[
        int, list[tuple[int, int]]
    ] = {}  # ticks and ages of the oldest plan of another agent, by agent
    for report in log.of(StepReport):
        if max(report.plan_ages, default=-1) >= 0:
            used.setdefault(report.agent, []).append((report.tick, max(report.plan_ages)))
    panels = panels_of(
        [_INPUT_IN] * (INPUTS + (setup.system.N > 1) + bool(obstacles) + bool(used)),
        legend=_long_legend(setup),
    )
    others = iter(panels[INPUTS:])
    kind = "rate command (rad/s)" if setup.system.commands_rates else "moment (N m)"
    bounds = zip(setup.settings.lower(1), setup.settings.upper(1), strict=True)
    names = ("thrust (N)", *(f"{axis} {kind}" for axis in _AXES))
    for k, (panel, name, (lower, upper)) in enumerate(zip(panels, names, bounds, strict=False)):
        _plot_uavs(panel, t, series.u[:, k::INPUTS])
        middle = sum(panel.get_ylim()) / 2.0
        widen(panel, middle - _LEAST, middle + _LEAST)
        limits(panel, float(lower), float(upper))
        both = lower == -upper
        head(
            panel,
            f"{name}, limits " + (f"± {upper:g}" if both else f"{lower:g}, {upper:g}"),
            legend=not both,
        )
    if setup.system.N > 1:
        panel, text = next(others), "smallest distance between UAVs (m)"
        panel.plot(t, series.separation_m, color="#000000")
        middle_m = sum(panel.get_ylim()) / 2.0
        widen(panel, middle_m - _SMALLEST_M, middle_m + _SMALLEST_M)
        if separation is not None:
            limits(panel, separation.minimum_m)
            text += f", limit {separation.minimum_m:g}"
        head(panel, text)
    if obstacles:
        panel = next(others)
        _plot(panel, t, series.clearance_m, ("UAVs", "rods", "payload"), _BY_COMPONENT)
        margins_m = {
            margin_m
            for obstacle in obstacles
            for margin_m in (obstacle.margin_m, obstacle.load_margin_m)
        }
        limits(panel, *sorted(margins_m))
        panel.set_ylim(0.0, _NEAR * max(margins_m))
        head(panel, "distance from obstacles (m)")
    if used:
        panel = next(others)
        for i, (agent, found) in enumerate(sorted(used.items())):
            used_s, ages_s = setup.settings.sampling_period_s * np.array(found).T
            style = uav_style(setup.owned[agent - 1][0]) | {
                "linewidth": line_width(i, len(used), 1.8)
            }
            panel.plot(used_s, ages_s, label=f"agent {agent}" if i == 0 else str(agent), **style)
        widen(panel, 0.0, setup.settings.sampling_period_s)
        head(panel, "oldest plan used (s)")
    return panels


def _long_legend(setup: Setup) -> list[Line2D]:
    """Return a legend of the UAVs for the top of a figure if it is too long for one beside a title.

    The curve of an agent looks like that of its first UAV.
    """
    N = setup.system.N
    if N <= MOST_BESIDE:
        return []
    return [Line2D([], [], label=f"UAV{i + 1}", **uav_style(i)) for i in range(N)]


def _plot(
    panel: Axes,
    t: Array,
    values: Array,
    names: Sequence[str],
    styles: Sequence[dict[str, Any]],
    widest: float = 1.8,
) -> None:
    """Plot values, (T, k), over time, so that curves that coincide stay visible."""
    for i, (name, style) in enumerate(zip(names, styles, strict=True)):
        panel.plot(
            t, values[:, i], label=name, linewidth=line_width(i, len(names), widest), **style
        )


def _plot_uavs(panel: Axes, t: Array, values: Array, widest: float = 1.8) -> None:
    """Plot a value of each UAV, (T, N), over time."""
    uavs = range(values.shape[1])
    _plot(panel, t, values, [f"UAV{i + 1}" for i in uavs], [uav_style(i) for i in uavs], widest)


def _draw_timing(figure: Figure, setup: Setup, log: RunLog) -> bool:
    """Draw step times and rest of each tick above, medians by stage below.

    Return False without any step.
    """
    reports, rest_ms = list(log.of(StepReport)), rest_of_tick_ms(setup, log)
    steps: dict[int, list[StepReport]] = {}
    for report in sorted(reports, key=lambda report: (report.agent, report.tick)):
        steps.setdefault(report.agent, []).append(report)
    if not steps:
        return False
    period_s, looks = setup.settings.sampling_period_s, dict[str, Any]()
    for agent in steps:  # the colour of an agent is that of its first UAV
        looks[f"agent {agent}"] = {
            "color": uav_style(setup.owned[agent - 1][0])["color"],
            "marker": "o",
        }
    samples = looks | ({"rest of tick": _REST} if rest_ms else {})
    handles = [Line2D([], [], label=name, **look, **_SAMPLE) for name, look in samples.items()]
    handles.append(Line2D([], [], label="sampling period", **_PERIOD))
    heights_in = [_OVER_TIME_IN, _BAR_IN * len(samples)]
    room: Any = {"left_in": 0.6, "top_in": 0.3, "gap_in": 0.62}
    over_time, by_stage = column_panels(
        figure, heights_in, legend=handles, x_label="median time per tick (ms)", **room
    )
    head(over_time, "time per tick (ms)", legend=False)
    over_time.plot([tick * period_s for tick in rest_ms], list(rest_ms.values()), **_REST, **_DOTS)
    for own, look in zip(steps.values(), looks.values(), strict=True):
        times_ms = [float(report.times_ms[-1]) for report in own]
        over_time.plot([report.tick * period_s for report in own], times_ms, **look, **_DOTS)
    over_time.axhline(1e3 * period_s, **_PERIOD)
    over_time.set_yscale("log")
    label_decades(over_time.yaxis)
    shade_phases(setup, [over_time], (max(report.tick for report in reports) + 1) * period_s)
    over_time.tick_params(labelbottom=True)
    over_time.set_xlabel("time (s)")
    first = STAGES.index("estimate")  # without waiting
    medians_ms = np.array(
        [np.median([report.times_ms for report in own], axis=0)[first:-1] for own in steps.values()]
    )
    stages, left = STAGES[first:-1], np.cumsum(medians_ms, axis=1) - medians_ms
    colours = mpl.colormaps["cividis"](np.linspace(0.05, 0.95, len(stages)))
    for k, stage in enumerate(stages):
        by_stage.barh(
            list(looks),
            medians_ms[:, k],
            left=left[:, k],
            color=colours[k],
            height=0.7,
            label=stage,
        )
    if rest_ms:
        by_stage.barh(
            ["rest of tick"],
            [float(np.median(list(rest_ms.values())))],
            color=REFERENCE,
            height=0.7,
        )
    by_stage.invert_yaxis()
    by_stage.grid(visible=False, axis="y")
    by_stage.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, handlelength=0.7, **CLOSE)
    return True


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg.

    Largest difference of the inputs at each tick; return the files.
    """
    table = np.array(comparison.rows, dtype=float)
    times_s, differences = (
        table[:, 0] * setup.settings.sampling_period_s,
        np.where(table > 0.0, table, np.nan),
    )
    turning = "commanded rate (rad/s)" if setup.system.commands_rates else "moment (N m)"
    with mpl.rc_context(RC):
        figure = Figure()
        panels = column_panels(figure, [_REPLAY_IN] * 2)
        for column, (panel, label) in enumerate(
            zip(panels, ("thrust (N)", turning), strict=True), start=1
        ):
            horizon, first = differences[:, column + 2], differences[:, column]
            panel.plot(
                times_s, horizon, label="largest of the horizon", color=COMPONENTS[1], linewidth=1.8
            )
            panel.plot(times_s, first, label="first step", color=COMPONENTS[0], linewidth=0.9)
            panel.set_yscale("log")
            head(panel, f"difference of {label}", legend=column == 1)
        finish(figure, panels, setup, float(times_s[-1]) + setup.settings.sampling_period_s, [])
        return save(figure, folder / "replay.png")
