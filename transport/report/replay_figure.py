"""Figure of the differences between replayed and recorded plans over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.replay_compare import Comparison
from transport.report.column import column_panels, finish, head
from transport.report.style import COMPONENTS, RC, label_decades, save

_HEIGHT_IN = 1.1


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg: largest difference of thrust and of moments at each tick; return the files."""
    ticks = np.array([row[0] for row in comparison.rows])
    differences = np.array([row[1:5] for row in comparison.rows])
    times_s = ticks * setup.settings.sampling_period_s
    with mpl.rc_context(RC):
        figure = Figure()
        panels = column_panels(figure, [_HEIGHT_IN] * 2)
        for column, (panel, label) in enumerate(zip(panels, ("thrust (N)", "moment (N m)"), strict=True)):
            for name, values, colour, width in (
                ("largest of the horizon", differences[:, 2 + column], COMPONENTS[1], 1.8),
                ("first step", differences[:, column], COMPONENTS[0], 0.9),
            ):
                panel.plot(times_s, np.where(values > 0.0, values, np.nan), label=name, color=colour, linewidth=width)
            if (differences[:, [column, 2 + column]] > 0.0).any():
                panel.set_yscale("log")
                low, high = panel.get_ylim()
                if high < 1e3 * low:
                    label_decades(panel.yaxis)
            head(panel, f"difference of {label}", legend=column == 0)
        finish(figure, panels, setup, float(times_s[-1]) + setup.settings.sampling_period_s, [])
        return [save(figure, folder / name) for name in ("replay.png", "replay.svg")]
