"""Maneuver figure: the paper's Fig. 3, 5 and 6 side by side, one maneuver under different controllers."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.series import series_of
from transport.experiments.simulation import run_in_memory
from transport.report.figures import PERFORMANCE, plot_performance
from transport.report.style import RC, save

_COLUMN_IN, _HEIGHT_IN = 3.0, 7.4

# Smallest visible share of the highest cost: smaller values are rounding errors.
_DECADES = 1e-5


def draw_maneuver(runs: Sequence[tuple[str, Setup]], folder: Path) -> list[Path]:
    """Simulate each run again and draw all side by side on the same axes.

    Returns: maneuver.png and maneuver.svg.
    """
    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure(figsize=(_COLUMN_IN * len(runs), _HEIGHT_IN), layout="constrained")
        panels = figure.subplots(len(PERFORMANCE), len(runs), sharex=True, squeeze=False)
        for index, (title, setup) in enumerate(runs):
            column = list(panels[:, index])
            plot_performance(setup, series_of(setup, run_in_memory(setup)), column)
            column[0].set_title(title, pad=18.0)
            column[-1].set_xlabel("time (s)")
        for label, row in zip(PERFORMANCE, panels, strict=True):
            row[0].set_ylabel(label)
            low = min(panel.get_ylim()[0] for panel in row)
            high = max(panel.get_ylim()[1] for panel in row)
            for panel in row:
                panel.set_ylim(max(low, high * _DECADES) if panel.get_yscale() == "log" else low, high)
                panel.label_outer()
        for panel in panels[:-1, -1]:
            panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
        figure.align_ylabels(panels[:, 0])
        return [save(figure, folder / f"maneuver.{kind}") for kind in ("png", "svg")]
