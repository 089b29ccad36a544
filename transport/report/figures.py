"""Figures of a run: performance over time (paper Fig. 3, 5), inputs with limits, trajectories (Fig. 4), timing."""

from collections.abc import Mapping, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from model.arrays import Array
from model.state import INPUTS
from protocol.scenario.setup import Setup
from protocol.scenario.targets import with_targets
from protocol.wire.messages import STAGES, StepReport, Target
from transport.analysis.estimates import estimates_of
from transport.analysis.metrics import rest_of_tick_ms
from transport.analysis.replay import Comparison
from transport.analysis.series import SWING_S, Series, series_of, swing_of
from transport.log.run_log import RunLog
from transport.report.column import column_panels, draw_legend, finish, head, legend_height_in, limits, marks_of
from transport.report.figures_3d import draw_trajectories
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
from transport.scene.drawing import UAV_COLOURS, uav_style

# Names of the figures of a run.
FIGURES = ("performance", "inputs", "trajectories", "timing", "estimate")
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

    With `forks` a forked process draws the first two, half of the work, beside the others. Only processes of one thread
    may fork.

    Returns: The PNG files, without those that have no data.
    Raises: ChildProcessError: the forked process failed; its traceback is on standard error.
    """
    series = series_of(setup, log)
    if not len(series.ticks):
        return []
    folder.mkdir(parents=True, exist_ok=True)

    def write(names: Sequence[str]) -> list[Path]:
        files = []
        for name in names:
            figure = Figure()
            if fill(figure, name, setup, log, series):
                files.append(save(figure, folder / f"{name}.png", cropped=name in CROPPED, pdf=pdf)[0])
        return files

    with mpl.rc_context(RC):
        if not forks:
            return write(FIGURES)
        process = get_context("fork").Process(target=write, args=(FIGURES[:_BESIDE],), daemon=True)
        process.start()
        others = write(FIGURES[_BESIDE:])
        process.join()
    if process.exitcode:
        raise ChildProcessError(f"a forked process of the report failed (exit status {process.exitcode})")
    return [*(folder / f"{name}.png" for name in FIGURES[:_BESIDE]), *others]  # those have data at any tick


def fill(figure: Figure, name: str, setup: Setup, log: RunLog, series: Series) -> bool:
    """Draw one of `FIGURES` of a run with at least one tick into an empty figure; return whether there is any data.

    Figure and drawing take the style from `matplotlib.rcParams`: call it within `rc_context(RC)`.
    """
    setup = with_targets(setup, log.of(Target))
    match name:
        case "performance":
            _draw_performance(figure, setup, log, series)
        case "inputs":
            draw_inputs(figure, setup, log, series)
        case "trajectories":
            draw_trajectories(figure, setup, series)
        case "estimate":
            return _draw_estimate(figure, setup, log, series)
        case _:
            return draw_timing(figure, setup, log)
    return True


def _draw_performance(figure: Figure, setup: Setup, log: RunLog, series: Series) -> None:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    marks, t = marks_of(setup, log), series.times_s
    has_cost = bool((series.cost > 0.0).any())
    panels = column_panels(figure, [_HEIGHT_IN] * (3 + has_cost), marks)
    errors_m = np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), np.nan)  # released ones have left
    _plot_uavs(panels[0], t, errors_m, widest=2.6)
    panels[0].set_ylim(0.0, max(panels[0].get_ylim()[1], _SMALLEST_M))
    for values, panel, names, smallest in (
        (series.payload_error_I, panels[1], ("x", "y", "z (down)"), _SMALLEST_M),
        (series.attitude_deg, panels[2], ("roll", "pitch", "yaw"), _SMALLEST_DEG),
    ):
        _plot(panel, t, values, names, [{"color": colour} for colour in COMPONENTS])
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -smallest), max(high, smallest))
    swing_m = swing_of(setup, series).largest_m
    if swing_m is not None:
        span_s = [max(0.0, float(t[-1]) - SWING_S), float(t[-1])]
        for sign in (-1.0, 1.0):
            panels[1].plot(span_s, [sign * swing_m] * 2, color=REFERENCE, linestyle="--", linewidth=0.8)
    if has_cost:
        panels[3].plot(t, np.where(series.cost > 0.0, series.cost, np.nan), color="#000000")
        scale_cost(panels[3], float(series.cost.max()), _COST_DECADES)
    swing = "" if swing_m is None else f", swing {swing_m:.2f} m"
    titles = ("UAV position error (m)", f"payload error (m){swing}", "payload attitude (deg)", "stage cost")
    for panel, title in zip(panels, titles, strict=False):
        head(panel, title)
    finish(figure, panels, setup, float(t[-1]) + setup.settings.sampling_period_s, marks)


def _draw_estimate(figure: Figure, setup: Setup, log: RunLog, series: Series) -> bool:
    """Draw the payload's pose, an agent's estimate of it and three standard deviations; False without a Kalman filter.

    Positions are those from the reference.
    """
    found = estimates_of(series, log)
    if found is None:
        return False
    marks, agent = marks_of(setup, log), int(found.agents.min())
    own = found.agents == agent
    rows, t = found.rows[own], series.times_s
    panels = column_panels(figure, [_INPUT_IN] * 6, marks)
    true = np.hstack([series.payload_error_I, series.attitude_deg])
    pose, deviations = found.pose[own].copy(), 3.0 * found.deviations[own]
    pose[:, :3] -= series.payload_reference_I[rows]
    pose[:, 3:], deviations[:, 3:] = np.degrees(pose[:, 3:]), np.degrees(deviations[:, 3:])
    titles = (*(f"payload error {axis} (m)" for axis in ("x", "y", "z (down)")), *(f"payload {a} (deg)" for a in _AXES))
    for i, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        panel.plot(t, true[:, i], color="#000000", label="true", linewidth=1.2)
        style: dict[str, Any] = {"fmt": "o", "markersize": 2.0, "elinewidth": 0.8, "color": COMPONENTS[1]}
        panel.errorbar(t[rows], pose[:, i], deviations[:, i], label=f"agent {agent}, 3 sigma", **style)
        head(panel, title, legend=i == 0)
    finish(figure, panels, setup, float(t[-1]) + setup.settings.sampling_period_s, marks)
    return True


def _plot(
    panel: Axes, t: Array, values: Array, names: Sequence[str], styles: Sequence[dict[str, Any]], widest: float = 1.8
) -> None:
    """Plot values, (T, k), over time, so that curves that coincide stay visible."""
    for i, (name, style) in enumerate(zip(names, styles, strict=True)):
        panel.plot(t, values[:, i], label=name, linewidth=line_width(i, len(names), widest), **style)


def _plot_uavs(panel: Axes, t: Array, values: Array, widest: float = 1.8) -> None:
    """Plot a value of each UAV, (T, N), over time."""
    uavs = range(values.shape[1])
    _plot(panel, t, values, [f"UAV{i + 1}" for i in uavs], [uav_style(i) for i in uavs], widest)


_INPUT_IN = 0.7
# Smallest range of an axis either side of zero, N and N m.
_LEAST = 1e-3
# Shown distances from obstacles as a multiple of the largest margin.
_NEAR = 6.0
_AXES = ("roll", "pitch", "yaw")


def draw_inputs(figure: Figure, setup: Setup, log: RunLog, series: Series) -> None:
    """Draw inputs, separation and age of plans into an empty figure; panels without data are left out."""
    marks, t = marks_of(setup, log), series.times_s
    used_s, ages_s, agents = _oldest_plans_s(setup, log)
    separation_m = np.where(np.isfinite(series.separation_m), series.separation_m, np.nan)
    separated = bool(np.isfinite(separation_m).any())
    obstacles = setup.obstacles
    panels = column_panels(figure, [_INPUT_IN] * (INPUTS + separated + bool(obstacles) + bool(agents)), marks)
    others = iter(panels[INPUTS:])
    lower, upper = (bound(1) for bound in (setup.settings.lower, setup.settings.upper))
    kind = "rate command (rad/s)" if setup.system.commands_rates else "moment (N m)"
    names = ["thrust (N)", *(f"{axis} {kind}" for axis in _AXES)]
    for k, (panel, name) in enumerate(zip(panels, names, strict=False)):
        _plot_uavs(panel, t, series.u[:, k::INPUTS])
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, high - _LEAST), max(high, low + _LEAST))
        limits(panel, float(lower[k]), float(upper[k]))
        both = lower[k] == -upper[k]
        text = f"± {upper[k]:g}" if both else f"{lower[k]:g}, {upper[k]:g}"
        head(panel, f"{name}, limits {text}", legend=not both)
    if separated:
        panel, text = next(others), "smallest distance between UAVs (m)"
        panel.plot(t, separation_m, color="#000000")
        if setup.settings.separation is not None:
            minimum_m = setup.settings.separation.minimum_m
            limits(panel, minimum_m)
            text += f", limit {minimum_m:g}"
        head(panel, text)
    if obstacles:
        panel = next(others)
        _plot(panel, t, series.clearance_m, ("UAVs", "rods", "payload"), [{"color": colour} for colour in COMPONENTS])
        margins_m = {margin_m for obstacle in obstacles for margin_m in (obstacle.margin_m, obstacle.load_margin_m)}
        limits(panel, *sorted(margins_m))
        panel.set_ylim(0.0, _NEAR * max(margins_m))
        head(panel, "distance from obstacles (m)")
    if agents:
        panel = next(others)
        names = [f"agent {agents[0]}", *map(str, agents[1:])]
        _plot(panel, used_s, ages_s, names, [uav_style(setup.owned[agent - 1][0]) for agent in agents])
        panel.set_ylim(0.0, 1.1 * float(np.nanmax(ages_s)) or 1.0)
        head(panel, "oldest plan used (s)")
    finish(figure, panels, setup, float(t[-1]) + setup.settings.sampling_period_s, marks)


def _oldest_plans_s(setup: Setup, log: RunLog) -> tuple[Array, Array, list[int]]:
    """Return the age of the oldest plan of another agent in use, by the agents that used any.

    Returns: Times, (T,), s; ages, (T, agents), s, NaN where an agent made no step; these agents.
    """
    used = {
        (report.agent, report.tick): max(report.plan_ages)
        for report in log.of(StepReport)
        if report.agent in setup.agents and any(age >= 0 for age in report.plan_ages)
    }
    agents = sorted({agent for agent, _ in used})
    recorded = [tick for _, tick in used] or [0]
    ticks = np.arange(min(recorded), max(recorded) + 1)
    ages = [[used.get((agent, int(tick)), np.nan) for agent in agents] for tick in ticks]
    period_s = setup.settings.sampling_period_s
    return np.asarray(ticks * period_s, dtype=float), np.array(ages, dtype=float) * period_s, agents


_OVER_TIME_IN, _BAR_IN = 1.5, 0.14
# Room: for the names of the bars; between the panels; for title and phases above the first.
_LEFT_IN, _GAP_IN, _ABOVE_IN = 0.6, 0.62, 0.3
_PERIOD = "#B2182B"

# Dots, since lines would hide other agents behind every outlier.
_DOTS: dict[str, Any] = {"linestyle": "none", "markersize": 1.4, "markeredgewidth": 0.0}
# Markers of agents whose colours repeat.
_MARKERS = ("o", "^", "s", "D")
_SAMPLE: dict[str, Any] = {"linestyle": "none", "markersize": 4.0, "markeredgewidth": 0.0}


def draw_timing(figure: Figure, setup: Setup, log: RunLog) -> bool:
    """Draw step times and rest of each tick above, medians by stage below; return False without any step."""
    reports = list(log.of(StepReport))
    if not reports:
        return False
    rest_ms = rest_of_tick_ms(setup, log)
    steps = {agent: [r.times_ms for r in reports if r.agent == agent] for agent in setup.agents}
    medians_ms = {agent: np.median(np.array(times), axis=0) for agent, times in steps.items() if times}
    handles = [_sample(f"agent {agent}", **_look(setup, agent)) for agent in medians_ms]
    if rest_ms:
        handles.append(_sample("rest of tick", marker="o", color=REFERENCE))
    handles.append(Line2D([], [], label="sampling period", color=_PERIOD, linestyle="--", linewidth=0.8))
    rows = {"": handles}
    over_time, by_stage = column_panels(
        figure,
        [_OVER_TIME_IN, _BAR_IN * (len(medians_ms) + bool(rest_ms))],
        left_in=_LEFT_IN,
        top_in=legend_height_in(rows) + _ABOVE_IN,
        gap_in=_GAP_IN,
        x_label="median time per tick (ms)",
    )
    draw_legend(figure, rows)
    _draw_over_time(setup, over_time, reports, rest_ms)
    _draw_by_stage(figure, by_stage, medians_ms, rest_ms)
    return True


def _draw_over_time(setup: Setup, panel: Axes, reports: Sequence[StepReport], rest_ms: Mapping[int, float]) -> None:
    """Draw the computation of each agent and the rest of each tick over time, and the sampling period."""
    period_s = setup.settings.sampling_period_s
    head(panel, "time per tick (ms)", legend=False)
    if rest_ms:
        ticks = sorted(rest_ms)
        panel.plot([k * period_s for k in ticks], [rest_ms[k] for k in ticks], color=REFERENCE, marker="o", **_DOTS)
    for agent in setup.agents:
        own = [report for report in reports if report.agent == agent]
        times_ms = [float(report.times_ms[-1]) for report in own]
        panel.plot([report.tick * period_s for report in own], times_ms, **_look(setup, agent), **_DOTS)
    panel.axhline(1e3 * period_s, color=_PERIOD, linestyle="--", linewidth=0.8)
    panel.set_yscale("log")
    label_decades(panel.yaxis)
    shade_phases(setup, [panel], (max(report.tick for report in reports) + 1) * period_s)
    panel.tick_params(labelbottom=True)
    panel.set_xlabel("time (s)")


def _draw_by_stage(figure: Figure, panel: Axes, medians_ms: Mapping[int, Array], rest_ms: Mapping[int, float]) -> None:
    """Draw a bar of the stages of a step for each agent, and one for the rest of a tick."""
    names = [f"agent {agent}" for agent in medians_ms]
    left = np.zeros(len(names))
    stages = STAGES[STAGES.index("estimate") : -1]  # without waiting
    colours = [mpl.colormaps["cividis"](share) for share in np.linspace(0.05, 0.95, len(stages))]
    for stage, colour in zip(stages, colours, strict=True):
        widths = np.array([median_ms[STAGES.index(stage)] for median_ms in medians_ms.values()])
        panel.barh(names, widths, left=left, color=colour, height=0.7)
        left += widths
    if rest_ms:
        panel.barh(["rest of tick"], [float(np.median(list(rest_ms.values())))], color=REFERENCE, height=0.7)
    panel.invert_yaxis()
    panel.grid(visible=False, axis="y")
    rows = {"": [_sample(stage, marker="s", color=colour) for stage, colour in zip(stages, colours, strict=True)]}
    top = panel.get_position().y1 * figure.get_figheight()
    draw_legend(figure, rows, top_in=figure.get_figheight() - top - legend_height_in(rows) - 0.02)


def _sample(label: str, *, marker: str, color: Any) -> Line2D:
    return Line2D([], [], label=label, marker=marker, color=color, **_SAMPLE)


def _look(setup: Setup, agent: int) -> dict[str, Any]:
    """Return colour and marker of an agent, those of its first UAV."""
    uav = setup.owned[agent - 1][0]
    return {"color": uav_style(uav)["color"], "marker": _MARKERS[uav // len(UAV_COLOURS) % len(_MARKERS)]}


_REPLAY_IN = 1.1


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg: largest difference of the inputs at each tick; return the files."""
    ticks = np.array([row[0] for row in comparison.rows])
    differences = np.array([row[1:5] for row in comparison.rows])
    times_s = ticks * setup.settings.sampling_period_s
    turning = "commanded rate (rad/s)" if setup.system.commands_rates else "moment (N m)"
    with mpl.rc_context(RC):
        figure = Figure()
        panels = column_panels(figure, [_REPLAY_IN] * 2)
        for column, (panel, label) in enumerate(zip(panels, ("thrust (N)", turning), strict=True)):
            for name, values, colour, width in (
                ("largest of the horizon", differences[:, 2 + column], COMPONENTS[1], 1.8),
                ("first step", differences[:, column], COMPONENTS[0], 0.9),
            ):
                panel.plot(times_s, np.where(values > 0.0, values, np.nan), label=name, color=colour, linewidth=width)
            if (differences[:, [column, 2 + column]] > 0.0).any():
                panel.set_yscale("log")
                low, high = panel.get_ylim()
                if high < 1e3 * low:
                    label_decades(panel.yaxis)
            head(panel, f"difference of {label}", legend=column == 0)
        finish(figure, panels, setup, float(times_s[-1]) + setup.settings.sampling_period_s, [])
        return save(figure, folder / "replay.png")
