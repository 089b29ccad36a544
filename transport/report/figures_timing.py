"""Figure of wall-clock times: agent steps per tick, stages of a step, and the rest of a tick."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, StepReport
from transport.analysis.metrics import rest_of_tick_ms
from transport.log.run_log import RunLog
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.style import REFERENCE, label_decades, shade_phases
from transport.scene.colours import UAV_COLOURS, uav_style

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


def _look(setup: Setup, agent: int) -> dict[str, str]:
    """Return colour and marker of an agent, those of its first UAV."""
    uav = setup.owned[agent - 1][0]
    return {"color": uav_style(uav)["color"], "marker": _MARKERS[uav // len(UAV_COLOURS) % len(_MARKERS)]}
