"""Figure of a replay: differences of its inputs from the recorded ones over time."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.analysis.replay.replay_difference import Comparison
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import column_panels, head
from transport.report.figures.event_marks import finish
from transport.report.figures.style import COMPONENTS, RC, save

_HEIGHT_IN = 1.1


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg, the largest difference of the inputs at each tick.

    Return the files.
    """
    period_s = setup.settings.sampling_period_s
    rows = comparison.inputs_apart
    times_s = np.array([row.tick for row in rows]) * period_s
    thrust_N = np.array([[row.first_thrust_N, row.thrust_N] for row in rows])
    turning = np.array([[row.first_turning, row.turning] for row in rows])
    quantity = "commanded rate (rad/s)" if setup.system.commands_rates else "moment (N m)"

    with mpl.rc_context(RC):
        figure = Figure()
        upper, lower = column_panels(figure, [_HEIGHT_IN] * 2)
        _draw_differences(upper, times_s, thrust_N)
        _draw_differences(lower, times_s, turning)
        head(upper, "difference of thrust (N)")
        head(lower, f"difference of {quantity}", legend=False)
        finish(figure, [upper, lower], setup, float(times_s[-1]) + period_s, [])
        return save(figure, folder / "replay.png")


def _draw_differences(panel: Axes, times_s: Array, differences: Array) -> None:
    """Draw the difference of the first step and the largest of the horizon, (T, 2)."""
    # A logarithmic axis has no place for zero.
    first, horizon = np.where(differences > 0.0, differences, np.nan).T
    wide: Any = {"color": COMPONENTS[1], "linewidth": 1.8}
    panel.plot(times_s, horizon, label="largest of the horizon", **wide)
    panel.plot(times_s, first, label="first step", color=COMPONENTS[0], linewidth=0.9)
    panel.set_yscale("log")
