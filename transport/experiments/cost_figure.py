"""Cost figure of the comparison: mean cost over processor time, a curve for each controller and horizon."""

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.experiments.comparison import CENTRALIZED, CLOSED_LOOP, PAPER, STEPS, Cell, Loads
from transport.experiments.cost_curves import COST, Curve
from transport.experiments.processor_time import AGENT, TEAM
from transport.report.style import RC, REFERENCE, WIDTH_IN, label_decades, save

# Colour (Okabe and Ito 2008) and marker of each controller; solid lines keep the steps of the horizon, dashed lines
# with open markers its seconds.
_STYLES = {CENTRALIZED: ("#000000", "s"), PAPER: ("#0072B2", "o"), CLOSED_LOOP: ("#D55E00", "^")}
_ROW_IN, _AROUND_IN = 2.1, 1.0

# Larger cost ratios, and diverged runs, are drawn at the upper edge of the panel.
_HIGHEST = 3.0


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
                axes.axvline(
                    median(loads[reference].seconds_per_second(budget)), color=REFERENCE, linewidth=0.8, zorder=0
                )
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
            axes.plot(
                [x[-1]], [_HIGHEST], marker="x" if node.diverged_s else "$\\uparrow$", color=colour, markersize=5.0
            )
        elif ratio is not None:
            spread = [[x[-1] - min(times)], [max(times) - x[-1]]]
            axes.errorbar(
                x[-1:], y[-1:], ratio.half_width or 0.0, spread, color=colour, linestyle="none", elinewidth=0.8
            )
    label = f"{curve.controller}, as many {curve.kept}"
    filled = colour if curve.kept == STEPS else "white"
    axes.plot(x, y, marker=marker, markersize=4.0, markerfacecolor=filled, label=label, **style)
