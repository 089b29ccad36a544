"""Figures of a run: performance over time (paper Fig. 3, 5), inputs with limits, trajectories (Fig. 4), timing."""

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
from transport.report.style import COMPONENTS, RC, REFERENCE, label_decades, line_width, save, scale_cost, shade_phases
from transport.scene.drawing import UAV_COLOURS, uav_style

# Makes the panels of a figure, given their heights, inches.
Panels = Callable[[Sequence[float]], list[Axes]]

# Names of the figures of a run.
FIGURES = ("performance", "inputs", "trajectories", "timing", "estimate")
# Of these, the ones whose files are cropped, since the size of the drawing depends on the maneuver.
CROPPED = ("trajectories",)
# Number of figures that a forked process draws.
_BESIDE = 2

# Shown decades of the cost; below is the rounding error of a hover.
_COST_DECADES = 5
# Smallest ranges of the axes, either side of zero, m and deg; smaller errors are negligible; and of inputs, N and N m.
_SMALLEST_M, _SMALLEST_DEG, _LEAST = 1e-3, 1e-2, 1e-3
_HEIGHT_IN, _INPUT_IN, _REPLAY_IN = 0.95, 0.7, 1.1
# Shown distances from obstacles as a multiple of the largest margin.
_NEAR = 6.0
_AXES, _PLACES = ("roll", "pitch", "yaw"), ("x", "y", "z (down)")
_BY_COMPONENT: list[dict[str, Any]] = [{"color": colour} for colour in COMPONENTS]

# Figure of times: heights; room for the names of the bars, between the panels, for title and phases above the first.
_OVER_TIME_IN, _BAR_IN = 1.5, 0.14
_LEFT_IN, _GAP_IN, _ABOVE_IN = 0.6, 0.62, 0.3
_PERIOD: Any = {"color": "#B2182B", "linestyle": "--", "linewidth": 0.8}
# Dots, since lines would hide other agents behind every outlier; those of the legend are larger.
_DOTS: Any = {"linestyle": "none", "markersize": 1.4, "markeredgewidth": 0.0}
_SAMPLE: Any = _DOTS | {"markersize": 4.0}
_REST: Any = {"color": REFERENCE, "marker": "o"}
# Markers of agents whose colours repeat.
_MARKERS = ("o", "^", "s", "D")


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
    if name == "trajectories":
        draw_trajectories(figure, setup, series)
        return True
    if name == "timing":
        return _draw_timing(figure, setup, log)
    over_time = {"performance": _draw_performance, "inputs": _draw_inputs, "estimate": _draw_estimate}
    marks = marks_of(setup, log)
    panels = over_time[name](setup, log, series, partial(column_panels, figure, marks=marks))
    if panels:
        finish(figure, panels, setup, float(series.times_s[-1]) + setup.settings.sampling_period_s, marks)
    return bool(panels)


def _draw_performance(setup: Setup, _: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw position errors of UAVs and payload, payload attitude and cost over time."""
    t, has_cost, swing_m = series.times_s, bool((series.cost > 0.0).any()), swing_of(setup, series)
    panels = panels_of([_HEIGHT_IN] * (3 + has_cost))
    errors_m = np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), np.nan)  # released ones have left
    _plot_uavs(panels[0], t, errors_m, widest=2.6)
    panels[0].set_ylim(0.0, max(panels[0].get_ylim()[1], _SMALLEST_M))
    for values, panel, names, smallest in (
        (series.payload_error_I, panels[1], _PLACES, _SMALLEST_M),
        (series.attitude_deg, panels[2], _AXES, _SMALLEST_DEG),
    ):
        _plot(panel, t, values, names, _BY_COMPONENT)
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -smallest), max(high, smallest))
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
    return panels


def _draw_estimate(_: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw the payload's pose, an agent's estimate of it and three standard deviations; none without a Kalman filter.

    Positions are those from the reference.
    """
    found = estimates_of(series, log)
    if found is None:
        return []
    agent = int(found.agents.min())
    own = found.agents == agent
    rows, t = found.rows[own], series.times_s
    true = np.hstack([series.payload_error_I, series.attitude_deg])
    pose, deviations = found.pose[own].copy(), 3.0 * found.deviations[own]
    pose[:, :3] -= series.payload_reference_I[rows]
    pose[:, 3:], deviations[:, 3:] = np.degrees(pose[:, 3:]), np.degrees(deviations[:, 3:])
    titles = [*(f"payload error {axis} (m)" for axis in _PLACES), *(f"payload {axis} (deg)" for axis in _AXES)]
    panels = panels_of([_INPUT_IN] * len(titles))
    for i, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        panel.plot(t, true[:, i], color="#000000", label="true", linewidth=1.2)
        style: dict[str, Any] = {"fmt": "o", "markersize": 2.0, "elinewidth": 0.8, "color": COMPONENTS[1]}
        panel.errorbar(t[rows], pose[:, i], deviations[:, i], label=f"agent {agent}, 3 sigma", **style)
        head(panel, title, legend=i == 0)
    return panels


def _draw_inputs(setup: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw inputs, separation, distance from obstacles and age of plans; panels without data are left out."""
    t, obstacles, separation = series.times_s, setup.obstacles, setup.settings.separation
    used_s, ages_s, agents = _oldest_plans_s(setup, log)
    separation_m = np.where(np.isfinite(series.separation_m), series.separation_m, np.nan)
    separated = bool(np.isfinite(separation_m).any())
    panels = panels_of([_INPUT_IN] * (INPUTS + separated + bool(obstacles) + bool(agents)))
    others = iter(panels[INPUTS:])
    kind = "rate command (rad/s)" if setup.system.commands_rates else "moment (N m)"
    bounds = zip(setup.settings.lower(1), setup.settings.upper(1), strict=True)
    names = ("thrust (N)", *(f"{axis} {kind}" for axis in _AXES))
    for k, (panel, name, (lower, upper)) in enumerate(zip(panels, names, bounds, strict=False)):
        _plot_uavs(panel, t, series.u[:, k::INPUTS])
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, high - _LEAST), max(high, low + _LEAST))
        limits(panel, float(lower), float(upper))
        both = lower == -upper
        head(panel, f"{name}, limits " + (f"± {upper:g}" if both else f"{lower:g}, {upper:g}"), legend=not both)
    if separated:
        panel, text = next(others), "smallest distance between UAVs (m)"
        panel.plot(t, separation_m, color="#000000")
        if separation is not None:
            limits(panel, separation.minimum_m)
            text += f", limit {separation.minimum_m:g}"
        head(panel, text)
    if obstacles:
        panel = next(others)
        _plot(panel, t, series.clearance_m, ("UAVs", "rods", "payload"), _BY_COMPONENT)
        margins_m = {margin_m for obstacle in obstacles for margin_m in (obstacle.margin_m, obstacle.load_margin_m)}
        limits(panel, *sorted(margins_m))
        panel.set_ylim(0.0, _NEAR * max(margins_m))
        head(panel, "distance from obstacles (m)")
    if agents:
        panel = next(others)
        styles = [uav_style(setup.owned[agent - 1][0]) for agent in agents]
        _plot(panel, used_s, ages_s, [f"agent {agents[0]}", *map(str, agents[1:])], styles)
        panel.set_ylim(0.0, 1.1 * float(np.nanmax(ages_s)) or 1.0)
        head(panel, "oldest plan used (s)")
    return panels


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


def _oldest_plans_s(setup: Setup, log: RunLog) -> tuple[Array, Array, list[int]]:
    """Return the age of the oldest plan of another agent in use, by the agents that used any.

    Returns: Times, (T,), s; ages, (T, agents), s, NaN where an agent made no step; these agents.
    """
    used = {
        (report.agent, report.tick): max(report.plan_ages)
        for report in log.of(StepReport)
        if report.agent in setup.agents and any(age >= 0 for age in report.plan_ages)
    }
    agents, recorded = sorted({agent for agent, _ in used}), [tick for _, tick in used] or [0]
    ticks = np.arange(min(recorded), max(recorded) + 1)
    ages = [[used.get((agent, int(tick)), np.nan) for agent in agents] for tick in ticks]
    period_s = setup.settings.sampling_period_s
    return np.asarray(ticks * period_s, dtype=float), np.array(ages, dtype=float) * period_s, agents


def _draw_timing(figure: Figure, setup: Setup, log: RunLog) -> bool:
    """Draw step times and rest of each tick above, medians by stage below; return False without any step."""
    reports, rest_ms = list(log.of(StepReport)), rest_of_tick_ms(setup, log)
    steps = {agent: [report for report in reports if report.agent == agent] for agent in setup.agents}
    steps = {agent: own for agent, own in steps.items() if own}
    if not steps:
        return False
    period_s, looks = setup.settings.sampling_period_s, {}
    for agent in steps:  # colour and marker of an agent are those of its first UAV
        uav = setup.owned[agent - 1][0]
        marker = _MARKERS[uav // len(UAV_COLOURS) % len(_MARKERS)]
        looks[f"agent {agent}"] = {"color": uav_style(uav)["color"], "marker": marker}
    samples = looks | ({"rest of tick": _REST} if rest_ms else {})
    handles = [Line2D([], [], label=name, **look, **_SAMPLE) for name, look in samples.items()]
    handles.append(Line2D([], [], label="sampling period", **_PERIOD))
    over_time, by_stage = column_panels(
        figure,
        [_OVER_TIME_IN, _BAR_IN * len(samples)],
        legend=handles,
        left_in=_LEFT_IN,
        top_in=_ABOVE_IN,
        gap_in=_GAP_IN,
        x_label="median time per tick (ms)",
    )
    head(over_time, "time per tick (ms)", legend=False)
    if rest_ms:
        ticks = sorted(rest_ms)
        over_time.plot([k * period_s for k in ticks], [rest_ms[k] for k in ticks], **_REST, **_DOTS)
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
    medians_ms = np.array([np.median([report.times_ms for report in own], axis=0)[first:-1] for own in steps.values()])
    stages, left = STAGES[first:-1], np.cumsum(medians_ms, axis=1) - medians_ms
    colours = [mpl.colormaps["cividis"](share) for share in np.linspace(0.05, 0.95, len(stages))]
    for k, colour in enumerate(colours):
        by_stage.barh(list(looks), medians_ms[:, k], left=left[:, k], color=colour, height=0.7)
    if rest_ms:
        by_stage.barh(["rest of tick"], [float(np.median(list(rest_ms.values())))], color=REFERENCE, height=0.7)
    by_stage.invert_yaxis()
    by_stage.grid(visible=False, axis="y")
    squares = zip(stages, colours, strict=True)
    handles = [Line2D([], [], label=stage, marker="s", color=colour, **_SAMPLE) for stage, colour in squares]
    top = by_stage.get_position().y1 * figure.get_figheight()
    draw_legend(figure, handles, top_in=figure.get_figheight() - top - legend_height_in(handles))
    return True


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg: largest difference of the inputs at each tick; return the files."""
    table = np.array(comparison.rows, dtype=float)
    times_s, differences = table[:, 0] * setup.settings.sampling_period_s, np.where(table > 0.0, table, np.nan)
    turning = "commanded rate (rad/s)" if setup.system.commands_rates else "moment (N m)"
    with mpl.rc_context(RC):
        figure = Figure()
        panels = column_panels(figure, [_REPLAY_IN] * 2)
        for column, (panel, label) in enumerate(zip(panels, ("thrust (N)", turning), strict=True), start=1):
            horizon, first = differences[:, column + 2], differences[:, column]
            panel.plot(times_s, horizon, label="largest of the horizon", color=COMPONENTS[1], linewidth=1.8)
            panel.plot(times_s, first, label="first step", color=COMPONENTS[0], linewidth=0.9)
            if np.isfinite([horizon, first]).any():
                panel.set_yscale("log")
                low, high = panel.get_ylim()
                if high < 1e3 * low:
                    label_decades(panel.yaxis)
            head(panel, f"difference of {label}", legend=column == 1)
        finish(figure, panels, setup, float(times_s[-1]) + setup.settings.sampling_period_s, [])
        return save(figure, folder / "replay.png")
