"""Figure of the differences between replayed and recorded plans over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.replay_compare import Comparison
from transport.report.style import COMPONENTS, RC, WIDTH_IN, label_decades, save, shade_phases


def draw_replay(setup: Setup, comparison: Comparison, folder: Path) -> list[Path]:
    """Draw replay.png and replay.svg: largest difference of thrust and of moments at each tick; return the files."""
    ticks = np.array([row[0] for row in comparison.rows])
    differences = np.array([row[1:5] for row in comparison.rows])
    times_s = ticks * setup.settings.sampling_period_s
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
        panels = list(figure.subplots(2, 1, sharex=True))
        shade_phases(setup, panels, float(times_s[-1]) + setup.settings.sampling_period_s)
        for column, (panel, label) in enumerate(zip(panels, ("thrust (N)", "moment (N m)"), strict=True)):
            for name, values, colour in (
                ("largest of the horizon", differences[:, 2 + column], COMPONENTS[2]),
                ("first step", differences[:, column], COMPONENTS[0]),
            ):
                panel.plot(times_s, np.where(values > 0.0, values, np.nan), label=name, color=colour)
            if (differences[:, [column, 2 + column]] > 0.0).any():
                panel.set_yscale("log")
                low, high = panel.get_ylim()
                if high < 1e3 * low:
                    label_decades(panel.yaxis)
            panel.set_ylabel(f"difference of\n{label}")
        panels[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
        panels[1].set_xlabel("time (s)")
        figure.align_ylabels(panels)
        return [save(figure, folder / name) for name in ("replay.png", "replay.svg")]
