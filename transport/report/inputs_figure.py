"""Figure of the inputs with their limits, distances of the team, and ages of plans."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.state import INPUTS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import StepReport
from transport.report.column import head, limits, widen
from transport.report.curves import (
    ANGLES,
    LEAST_INPUT,
    LEAST_M,
    WIDE,
    Panels,
    long_legend,
    plot_components,
    plot_uavs,
)
from transport.report.style import line_width
from transport.scene.colours import uav_style

_HEIGHT_IN = 0.7
# Shown distances from obstacles as a multiple of the largest margin.
_NEAR = 6.0

# Ticks and ages of the oldest plan of another agent in use, by agent.
_PlanAges = dict[int, list[tuple[int, int]]]


def draw_inputs(setup: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw inputs, separation, distance from obstacles and age of plans.

    Panels without data are left out.
    """
    plan_ages = _plan_ages(log)
    has_separation = setup.system.N > 1
    count = INPUTS + has_separation + bool(setup.obstacles) + bool(plan_ages)
    panels = panels_of([_HEIGHT_IN] * count, legend=long_legend(setup))

    _draw_limited(panels[:INPUTS], setup, series)
    others = iter(panels[INPUTS:])
    if has_separation:
        _draw_separation(next(others), setup, series)
    if setup.obstacles:
        _draw_clearance(next(others), setup, series)
    if plan_ages:
        _draw_plan_ages(next(others), setup, plan_ages)
    return panels


def _plan_ages(log: RunLog) -> _PlanAges:
    """Return ticks and ages of the oldest plan in use, of agents that use any."""
    ages: _PlanAges = {}
    for report in log.of(StepReport):
        oldest = max(report.plan_ages, default=-1)
        if oldest >= 0:
            ages.setdefault(report.agent, []).append((report.tick, oldest))
    return ages


def _draw_limited(panels: Sequence[Axes], setup: Setup, series: Series) -> None:
    """Draw each kind of input of the UAVs with its limits."""
    turning = "rate command (rad/s)" if setup.system.commands_rates else "moment (N m)"
    names = ("thrust (N)", *(f"{axis} {turning}" for axis in ANGLES))
    lower = setup.settings.lower(1)
    upper = setup.settings.upper(1)
    for k, panel in enumerate(panels):
        plot_uavs(panel, series.times_s, series.u[:, k::INPUTS])
        _widen_about_middle(panel, LEAST_INPUT)
        limits(panel, float(lower[k]), float(upper[k]))
        is_symmetric = lower[k] == -upper[k]
        bounds = f"± {upper[k]:g}" if is_symmetric else f"{lower[k]:g}, {upper[k]:g}"
        head(panel, f"{names[k]}, limits {bounds}", legend=not is_symmetric)


def _draw_separation(panel: Axes, setup: Setup, series: Series) -> None:
    """Draw the smallest distance between UAVs, with its limit if there is one."""
    panel.plot(series.times_s, series.separation_m, color="#000000")
    _widen_about_middle(panel, LEAST_M)

    title = "smallest distance between UAVs (m)"
    separation = setup.settings.separation
    if separation is not None:
        limits(panel, separation.minimum_m)
        title += f", limit {separation.minimum_m:g}"
    head(panel, title)


def _draw_clearance(panel: Axes, setup: Setup, series: Series) -> None:
    """Draw the smallest distances from obstacles, with their margins."""
    plot_components(panel, series.times_s, series.clearance_m, ("UAVs", "rods", "payload"))
    margins_m = {obstacle.margin_m for obstacle in setup.obstacles}
    margins_m |= {obstacle.load_margin_m for obstacle in setup.obstacles}
    limits(panel, *sorted(margins_m))
    panel.set_ylim(0.0, _NEAR * max(margins_m))
    head(panel, "distance from obstacles (m)")


def _draw_plan_ages(panel: Axes, setup: Setup, plan_ages: _PlanAges) -> None:
    """Draw the age of the oldest plan that each agent uses."""
    period_s = setup.settings.sampling_period_s
    for i, (agent, entries) in enumerate(sorted(plan_ages.items())):
        times_s, ages_s = period_s * np.array(entries).T
        style = uav_style(setup.owned[agent - 1][0])
        style |= {"linewidth": line_width(i, len(plan_ages), WIDE)}
        label = f"agent {agent}" if i == 0 else str(agent)
        panel.plot(times_s, ages_s, label=label, **style)
    widen(panel, 0.0, period_s)
    head(panel, "oldest plan used (s)")


def _widen_about_middle(panel: Axes, least: float) -> None:
    """Let an axis show at least a range about its middle."""
    middle = sum(panel.get_ylim()) / 2.0
    widen(panel, middle - least, middle + least)
