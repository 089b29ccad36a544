"""Figure of a replay: differences of its inputs from the recorded ones over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from transport.analysis.comparison import Comparison
from transport.protocol.scenario.setup import Setup
from transport.report.column import column_panels, finish, head
from transport.report.style import COMPONENTS, RC, save

_HEIGHT_IN = 1.1


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg, the largest difference of the inputs at each tick.

    Return the files.
    """
    period_s = setup.settings.sampling_period_s
    table = np.array(comparison.rows, dtype=float)
    ticks, *columns = table.T
    times_s = ticks * period_s
    thrust_first, turning_first, thrust, turning = [
        np.where(column > 0.0, column, np.nan) for column in columns
    ]
    turning_name = "commanded rate (rad/s)" if setup.system.commands_rates else "moment (N m)"

    with mpl.rc_context(RC):
        figure = Figure()
        upper, lower = column_panels(figure, [_HEIGHT_IN] * 2)
        for panel, horizon, first in (
            (upper, thrust, thrust_first),
            (lower, turning, turning_first),
        ):
            wide = {"color": COMPONENTS[1], "linewidth": 1.8}
            panel.plot(times_s, horizon, label="largest of the horizon", **wide)
            panel.plot(times_s, first, label="first step", color=COMPONENTS[0], linewidth=0.9)
            panel.set_yscale("log")

        head(upper, "difference of thrust (N)")
        head(lower, f"difference of {turning_name}", legend=False)
        finish(figure, [upper, lower], setup, float(times_s[-1]) + period_s, [])
        return save(figure, folder / "replay.png")
