"""Figures of the comparison: mean cost over processor time, and one maneuver under different controllers."""

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.series import series_of
from transport.experiments.comparison import CENTRALIZED, CLOSED_LOOP, PAPER, STEPS, Cell, Loads
from transport.experiments.cost_curves import COST, Curve
from transport.experiments.processor_time import AGENT, TEAM
from transport.experiments.simulation import run_in_memory
from transport.report.figures import PERFORMANCE, plot_performance
from transport.report.style import RC, REFERENCE, WIDTH_IN, label_decades, save

# Colour (Okabe and Ito 2008) and marker of each controller; solid lines keep the steps of the horizon, dashed lines
# with open markers its seconds.
_STYLES = {CENTRALIZED: ("#000000", "s"), PAPER: ("#0072B2", "o"), CLOSED_LOOP: ("#D55E00", "^")}
_ROW_IN, _AROUND_IN = 2.1, 1.0

# Larger cost ratios, and diverged runs, are drawn at the upper edge of the panel.
_HIGHEST = 3.0

# Maneuver figure: size of a column; smallest visible share of the highest cost, below which values are rounding errors.
_COLUMN_IN, _HEIGHT_IN = 3.0, 7.4
_DECADES = 1e-5


def draw_costs(curves: Sequence[Curve], loads: Loads, reference: Cell, folder: Path) -> list[Path]:
    """Draw a row of panels for each weather: cost over the computation of the team and of one agent.

    A vertical line marks the computation of the reference, the centralized cell.

    Returns: figure.png and figure.svg.
    """
    weathers = list(dict.fromkeys(curve.weather for curve in curves))
    with mpl.rc_context({**RC, "svg.hashsalt": "costs"}):
        figure = Figure(figsize=(1.35 * WIDTH_IN, _AROUND_IN + _ROW_IN * len(weathers)), layout="constrained")
        panels = figure.subplots(len(weathers), 2, sharex="col", sharey="row", squeeze=False)
        for row, weather in zip(panels, weathers, strict=True):
            own = [curve for curve in curves if curve.weather == weather]
            for axes, budget in zip(row, (TEAM, AGENT), strict=True):
                for curve in own:
                    _draw(axes, curve, loads, budget)
                x = median(loads[reference].seconds_per_second(budget))
                axes.axvline(x, color=REFERENCE, linewidth=0.8, zorder=0)
                axes.set_xscale("log")
                label_decades(axes.xaxis)
            row[0].set_ylabel(f"{weather}\nmean cost over centralized")
            row[0].set_ylim(0.0, _HIGHEST * 1.05)
        for axes, budget in zip(panels[-1], (TEAM, AGENT), strict=True):
            axes.set_xlabel(f"processor time, {budget} (s/s)")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return [save(figure, folder / f"figure.{kind}") for kind in ("png", "svg")]


def _draw(axes: Axes, curve: Curve, loads: Loads, budget: str) -> None:
    colour, marker = _STYLES[curve.controller]
    style: dict[str, Any] = {"color": colour, "linestyle": "-" if curve.kept == STEPS else "--"}
    x, y = [], []
    for node in curve.nodes:
        times = loads[node.cell].seconds_per_second(budget)
        ratio = node.ratio(COST)
        beyond = bool(node.diverged_s) or (ratio is not None and ratio.mean > _HIGHEST)
        x.append(median(times))
        y.append(math.nan if beyond or ratio is None else ratio.mean)
        if beyond:
            sign = "x" if node.diverged_s else "$\\uparrow$"
            axes.plot([x[-1]], [_HIGHEST], marker=sign, color=colour, markersize=5.0)
        elif ratio is not None:
            spread = [[x[-1] - min(times)], [max(times) - x[-1]]]
            axes.errorbar(
                x[-1:], y[-1:], ratio.half_width or 0.0, spread, color=colour, linestyle="none", elinewidth=0.8
            )
    label = f"{curve.controller}, as many {curve.kept}"
    filled = colour if curve.kept == STEPS else "white"
    axes.plot(x, y, marker=marker, markersize=4.0, markerfacecolor=filled, label=label, **style)


def draw_maneuver(runs: Sequence[tuple[str, Setup]], folder: Path) -> list[Path]:
    """Simulate each run again and draw all side by side on the same axes, each under its heading.

    The runs are deterministic, so they equal the measured ones.

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
