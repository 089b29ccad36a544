"""Figure of wall-clock times: steps of the agents over time, and their median stages."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.communication_metrics import rest_of_tick_ms
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import STAGES, StepReport
from transport.report.figures.column import CLOSE, Room, column_panels, head
from transport.report.figures.style import REFERENCE, label_decades, shade_phases
from transport.scene.uav_and_link_colours import uav_marker, uav_style

# Heights of the panel over time, and of a bar below it, inches.
_OVER_TIME_IN = 1.5
_BAR_IN = 0.14
_BAR = 0.7  # height of a bar as a share of its place
_ROOM = Room(left_in=0.6, top_in=0.3, gap_in=0.62)
_MS_PER_S = 1e3
# Stages of a step that are work, without waiting and their sum.
_FIRST_STAGE = STAGES.index("estimate")
_WORK = STAGES[_FIRST_STAGE:-1]

_PERIOD: Any = {"color": "#B2182B", "linestyle": "--", "linewidth": 0.8}
# Dots, since lines would hide other agents behind every outlier; those of the legend are larger.
_DOTS: Any = {"linestyle": "none", "markersize": 1.4, "markeredgewidth": 0.0}
_SAMPLE: Any = _DOTS | {"markersize": 4.0}
_REST_NAME = "rest of tick"
_REST: Any = {"color": REFERENCE, "marker": "o"}

# Reports of each agent, ascending, in the order of their ticks.
_Steps = Mapping[int, Sequence[StepReport]]


def draw_timing(figure: Figure, setup: Setup, log: RunLog) -> bool:
    """Draw step times and rest of each tick above, medians by stage below.

    Return False without any step.
    """
    steps = _steps_by_agent(log)
    if not steps:
        return False

    rest_ms = rest_of_tick_ms(setup, log)
    samples = {f"agent {agent}": _look(setup, agent) for agent in steps}
    if rest_ms:
        samples[_REST_NAME] = _REST
    handles = [Line2D([], [], label=name, **look, **_SAMPLE) for name, look in samples.items()]
    handles.append(Line2D([], [], label="sampling period", **_PERIOD))

    over_time, by_stage = column_panels(
        figure,
        [_OVER_TIME_IN, _BAR_IN * len(samples)],
        legend=handles,
        x_label="median time per tick (ms)",
        room=_ROOM,
    )
    _draw_over_time(over_time, setup, steps, rest_ms)
    _draw_by_stage(by_stage, steps, rest_ms)
    return True


def _steps_by_agent(log: RunLog) -> dict[int, list[StepReport]]:
    """Return the reports of each agent in the order of their ticks."""
    steps: dict[int, list[StepReport]] = {}
    for report in sorted(log.of(StepReport), key=lambda report: (report.agent, report.tick)):
        steps.setdefault(report.agent, []).append(report)
    return steps


def _look(setup: Setup, agent: int) -> dict[str, Any]:
    """Return the style of an agent, whose colour and marker are those of its first UAV."""
    first_uav = setup.owned[agent - 1][0]
    return {"color": uav_style(first_uav)["color"], "marker": uav_marker(first_uav)}


def _draw_over_time(panel: Axes, setup: Setup, steps: _Steps, rest_ms: Mapping[int, float]) -> None:
    """Draw the time of each step and the rest of each tick."""
    period_s = setup.settings.sampling_period_s
    head(panel, "time per tick (ms)", legend=False)
    panel.plot([tick * period_s for tick in rest_ms], list(rest_ms.values()), **_REST, **_DOTS)
    for agent, reports in steps.items():
        times_s = [report.tick * period_s for report in reports]
        times_ms = [float(report.times_ms[-1]) for report in reports]
        panel.plot(times_s, times_ms, **_look(setup, agent), **_DOTS)
    panel.axhline(_MS_PER_S * period_s, **_PERIOD)

    panel.set_yscale("log")
    label_decades(panel.yaxis)
    last_tick = max(reports[-1].tick for reports in steps.values())
    shade_phases(setup, [panel], (last_tick + 1) * period_s)
    panel.tick_params(labelbottom=True)
    panel.set_xlabel("time (s)")


def _draw_by_stage(panel: Axes, steps: _Steps, rest_ms: Mapping[int, float]) -> None:
    """Draw the medians of the stages of each agent's steps, and of the rest of a tick, as bars."""
    medians_ms = np.array([_medians_ms(reports) for reports in steps.values()])
    left_ms = np.cumsum(medians_ms, axis=1) - medians_ms
    colours = mpl.colormaps["cividis"](np.linspace(0.05, 0.95, len(_WORK)))
    names = [f"agent {agent}" for agent in steps]
    for k, stage in enumerate(_WORK):
        style: Any = {"color": colours[k], "height": _BAR, "label": stage}
        panel.barh(names, medians_ms[:, k], left=left_ms[:, k], **style)

    if rest_ms:
        median_ms = float(np.median(list(rest_ms.values())))
        panel.barh([_REST_NAME], [median_ms], color=REFERENCE, height=_BAR)
    panel.invert_yaxis()
    panel.grid(visible=False, axis="y")
    panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, handlelength=0.7, **CLOSE)


def _medians_ms(reports: Sequence[StepReport]) -> Array:
    """Return the median time of each stage of `_WORK`, ms."""
    medians_ms: Array = np.median([report.times_ms for report in reports], axis=0)
    return medians_ms[_FIRST_STAGE:-1]
