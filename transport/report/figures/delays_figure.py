"""Figure of the delays of the plans that agents used, over time."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.plan_delays import first_uses, plan_delays
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import head
from transport.report.figures.curves_over_time import Panels
from transport.scene.uav_and_link_colours import uav_marker, uav_style

_HEIGHT_IN = 1.1
_MS_PER_S = 1e3
_DOTS: Any = {"linestyle": "none", "markersize": 1.4, "markeredgewidth": 0.0}
_SAMPLE: Any = _DOTS | {"markersize": 4.0}  # in the legend


def draw_delays(setup: Setup, log: RunLog, _: Series, panels_of: Panels) -> list[Axes]:
    """Draw the delay of each plan that an agent used, at its first use; no panel if none had any."""
    uses = first_uses(setup, log, plan_delays(setup, log))
    delays_ms = _MS_PER_S * np.array([delay_s for own in uses.values() for _, delay_s in own])
    if not delays_ms.any():
        return []

    panels = panels_of([_HEIGHT_IN])
    (panel,) = panels
    for i, (agent, own) in enumerate(sorted(uses.items())):
        times_s, delays_s = np.array(own).T
        uav = setup.owned[agent - 1][0]
        look = {"color": uav_style(uav)["color"], "marker": uav_marker(uav)}
        panel.plot(times_s, _MS_PER_S * delays_s, **look, **_DOTS)
        label = f"agent {agent}" if i == 0 else str(agent)
        panel.plot([], [], label=label, **look, **_SAMPLE)

    panel.set_ylim(bottom=0.0)
    head(panel, "delay of plans used (ms)")
    return panels
