"""Figure of inputs and constraints over time: thrust and moments, separation, age of plans, with their limits."""

import numpy as np
from matplotlib.figure import Figure

from model.arrays import Array
from model.state import INPUTS
from protocol.scenario.setup import Setup
from protocol.wire.messages import StepReport
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.report.column import column_panels, finish, head, limits
from transport.report.marks import marks_of
from transport.report.style import line_width
from transport.scene.colours import uav_style

_HEIGHT_IN = 0.7
# Smallest range of an axis either side of zero, N and N m.
_SMALLEST = 1e-3
_NAMES = ("thrust (N)", "roll moment (N m)", "pitch moment (N m)", "yaw moment (N m)")


def draw_inputs(figure: Figure, setup: Setup, log: RunLog, series: Series) -> None:
    """Draw inputs, separation and age of plans into an empty figure; panels without data are left out."""
    marks, t = marks_of(setup, log), series.times_s
    until_s = float(t[-1]) + setup.settings.sampling_period_s
    ages = _oldest_plans_s(setup, log)
    separated = bool(np.isfinite(series.separation_m).any())
    panels = column_panels(figure, [_HEIGHT_IN] * (INPUTS + separated + bool(ages)), marks)
    bounds = setup.settings.limits
    lower, upper = bounds.lower(1), bounds.upper(1)
    N = setup.system.N
    for k, (panel, name) in enumerate(zip(panels, _NAMES, strict=False)):
        for i in range(N):
            width = line_width(i, N, 1.8)
            panel.plot(t, series.u[:, INPUTS * i + k], label=f"UAV{i + 1}", linewidth=width, **uav_style(i))
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, high - _SMALLEST), max(high, low + _SMALLEST))
        limits(panel, float(lower[k]), float(upper[k]))
        if lower[k] == -upper[k]:
            head(panel, f"{name}, limits ± {upper[k]:g}", legend=False)
        else:
            head(panel, f"{name}, limits {lower[k]:g}, {upper[k]:g}")
    place = INPUTS
    if separated:
        panels[place].plot(t, np.where(np.isfinite(series.separation_m), series.separation_m, np.nan), color="#000000")
        text = "smallest distance between UAVs (m)"
        if setup.settings.separation is not None:
            minimum_m = setup.settings.separation.minimum_m
            limits(panels[place], minimum_m)
            text += f", limit {minimum_m:g}"
        head(panels[place], text)
        place += 1
    if ages:
        for k, (agent, (times_s, values_s)) in enumerate(ages.items()):
            style = uav_style(setup.owned[agent - 1][0])
            panels[place].plot(
                times_s,
                values_s,
                label=f"agent {agent}" if k == 0 else str(agent),
                linewidth=line_width(k, len(ages), 1.8),
                **style,
            )
        panels[place].set_ylim(0.0, 1.1 * max(float(np.nanmax(values_s)) for _, values_s in ages.values()) or 1.0)
        head(panels[place], "oldest plan used (s)")
    finish(figure, panels, setup, until_s, marks)


def _oldest_plans_s(setup: Setup, log: RunLog) -> dict[int, tuple[Array, Array]]:
    """Return times, s, and the age of the oldest plan of another agent in use, s, by agent; empty without any."""
    period_s = setup.settings.sampling_period_s
    rows: dict[int, dict[int, int]] = {agent: {} for agent in setup.agents}
    for report in log.of(StepReport):
        if report.agent in rows and any(age >= 0 for age in report.plan_ages):
            rows[report.agent][report.tick] = max(report.plan_ages)
    found: dict[int, tuple[Array, Array]] = {}
    for agent, ages in rows.items():
        if ages:
            ticks = np.arange(min(ages), max(ages) + 1)
            values: Array = np.array(
                [ages.get(int(tick), np.nan) for tick in ticks]
            )  # a gap while the agent made no step
            found[agent] = np.asarray(ticks * period_s, dtype=float), values * period_s
    return found
