"""Figure of wall-clock times: agent steps per tick, stages of a step, and the rest of a tick."""

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, StepReport
from transport.analysis.metrics import rest_of_tick_ms
from transport.log.run_log import RunLog
from transport.report.style import WIDTH_IN, shade_phases
from transport.scene.colours import uav_style

_REST = "#8c8c8c"

# Dots, since lines would hide other agents behind every outlier.
_DOTS: dict[str, Any] = {
    "linestyle": "none",
    "marker": ".",
    "markersize": 2.5,
    "markeredgewidth": 0.0,
    "color": _REST,
}


def draw_timing(figure: Figure, setup: Setup, log: RunLog) -> bool:
    """Draw step times and rest of each tick above, medians by stage below; return False without any step."""
    reports = list(log.of(StepReport))
    if not reports:
        return False
    figure.set_size_inches(WIDTH_IN, 4.6)
    figure.set_layout_engine("constrained")
    over_time, by_agent = figure.subplots(2, 1, height_ratios=(1.5, 1.0))
    rest_ms = rest_of_tick_ms(setup, log)
    _over_time(setup, over_time, reports, rest_ms)

    steps = {agent: [r.times_ms for r in reports if r.agent == agent] for agent in setup.agents}
    medians = {agent: np.median(np.array(times), axis=0) for agent, times in steps.items() if times}
    names = [f"agent {agent}" for agent in medians]
    left = np.zeros(len(names))
    stages = STAGES[STAGES.index("estimate") : -1]  # without waiting
    for stage, colour in zip(stages, mpl.colormaps["cividis"](np.linspace(0.1, 0.95, len(stages))), strict=True):
        widths = np.array([median[STAGES.index(stage)] for median in medians.values()])
        by_agent.barh(names, widths, left=left, color=colour, label=stage, height=0.7)
        left += widths
    if rest_ms:
        by_agent.barh(["rest of tick"], [float(np.median(list(rest_ms.values())))], color=_REST, height=0.7)
    by_agent.invert_yaxis()
    by_agent.grid(visible=False, axis="y")
    by_agent.set_xlabel("median time per tick (ms)")
    by_agent.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    return True


def _over_time(setup: Setup, axes: Axes, reports: list[StepReport], rest_ms: dict[int, float]) -> None:
    period_s = setup.settings.sampling_period_s
    shade_phases(setup, [axes], (max(report.tick for report in reports) + 1) * period_s)
    if rest_ms:
        ticks = sorted(rest_ms)
        axes.plot([k * period_s for k in ticks], [rest_ms[k] for k in ticks], label="rest of\ntick", **_DOTS)
    for agent, owned in zip(setup.agents, setup.owned, strict=True):
        own = [report for report in reports if report.agent == agent]
        axes.plot(
            [report.tick * period_s for report in own],
            [float(report.times_ms[-1]) for report in own],
            label=f"agent {agent}",
            **_DOTS | {"color": uav_style(owned[0])["color"]},
        )
    axes.axhline(1e3 * period_s, color="#000000", linestyle="--", linewidth=1.0, label="sampling\nperiod")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xlabel("time (s)")
    axes.set_ylabel("time per tick (ms)")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, markerscale=4.0)
