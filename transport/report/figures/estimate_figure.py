"""Figure of an agent's estimate of the payload's pose beside the true one."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.estimates import estimates_of
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import head, widen
from transport.report.figures.curves_over_time import ANGLES, LEAST_DEG, LEAST_M, PLACES, Panels
from transport.report.figures.style import COMPONENTS

_HEIGHT_IN = 0.7
_TITLES = (
    *(f"payload error {axis} (m)" for axis in PLACES),
    *(f"payload {axis} (deg)" for axis in ANGLES),
)
_LEAST = (*[LEAST_M] * len(PLACES), *[LEAST_DEG] * len(ANGLES))
# Standard deviations that the bars show, either side.
_SIGMAS = 3.0
_BARS: Any = {"fmt": "o", "markersize": 2.0, "elinewidth": 0.8, "color": COMPONENTS[1]}


def draw_estimate(_: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw the payload's pose, an agent's estimate of it and three standard deviations.

    Positions are those from the reference. There is no panel without a Kalman filter.
    """
    estimates = estimates_of(series, log)
    if estimates is None:
        return []

    agent = int(estimates.agents.min())
    own = estimates.agents == agent
    rows = estimates.rows[own]
    true = np.hstack([series.payload_error_I, series.attitude_deg])

    variances = np.diagonal(estimates.P[own], axis1=1, axis2=2)
    deviations = _SIGMAS * np.sqrt(variances)
    deviations[:, 3:] = np.degrees(deviations[:, 3:])
    pose = estimates.pose[own]
    pose[:, :3] -= series.payload_reference_I[rows]
    pose[:, 3:] = np.degrees(pose[:, 3:])

    panels = panels_of([_HEIGHT_IN] * len(_TITLES))
    label = f"agent {agent}, {_SIGMAS:g} sigma"
    for i, panel in enumerate(panels):
        panel.plot(series.times_s, true[:, i], color="#000000", label="true", linewidth=1.2)
        panel.errorbar(series.times_s[rows], pose[:, i], deviations[:, i], label=label, **_BARS)
        widen(panel, -_LEAST[i], _LEAST[i])
        head(panel, _TITLES[i], legend=i == 0)
    return panels
