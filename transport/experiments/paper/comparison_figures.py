"""Figures of the comparison: cost over computation, and the maneuver of the paper's figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.series import series_of
from transport.experiments.paper import controllers_and_periods
from transport.experiments.paper.comparison_curves import ComparisonCurve
from transport.experiments.paper.controllers_and_periods import (
    AGENT,
    CENTRALIZED,
    CLOSED_LOOP,
    PAPER,
    SECONDS,
    STEPS,
    STILL,
    Cell,
)
from transport.experiments.simulation import run_in_memory
from transport.experiments.statistics import COST_RATIO
from transport.experiments.sweep import Swept
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import (
    DIVERGED,
    RC,
    REFERENCE,
    TEXT,
    Look,
    label_decades,
    looks_of,
    save,
)
from transport.report.overlaid_runs import fill_overlaid

# Colour of each controller; marker and line of a horizon with as many steps and of one with as many
# seconds.
_COLOURS = {name: look.colour for name, look in looks_of([CENTRALIZED, PAPER, CLOSED_LOOP]).items()}
_SHAPES = {STEPS: ("o", "-"), SECONDS: ("D", "--")}

# Height of a panel, and room about it, in.
_PANEL_IN = 1.25
_ROOM = Room(left_in=0.6, top_in=0.17, bottom_in=0.38)

# Cost ratios about 1 are what the paper's claims are about; above the break the scale is a part of that below.
_LOWEST = 0.88
_BREAK = 1.25
_COARSE = 0.1
_SHADE = "#f1f1f1"
# Larger cost ratios, and parts of intervals, are drawn at the largest one shown, diverged runs above.
_LARGEST = 3.0
_DIVERGED_Y = _LARGEST + 0.6
_TICKS = (0.95, 1.0, 1.05, 1.1, 1.2, 1.5, 2.0, _LARGEST)
_ABOVE_DIVERGED = 0.3


def draw_costs(curves: Sequence[ComparisonCurve], reference: Cell, folder: Path) -> list[Path]:
    """Draw the cost over the computation of the team and of one agent, a panel for each budget and weather.

    A vertical line marks the computation of the reference, the centralized cell.

    Returns: figure.png and figure.svg.
    """
    weathers = dict.fromkeys(curve.weather for curve in curves)
    shown = [(budget, weather) for budget in curves[0].loads for weather in weathers]
    legend = _legend(reference)
    with mpl.rc_context({**RC, "svg.hashsalt": "costs"}):
        figure = Figure()
        panels = column_panels(
            figure,
            [_PANEL_IN] * len(shown),
            legend=legend,
            x_label="processor time per second of the run (s/s)\n"
            f"line: {_named(reference)}; shaded: one tenth of the scale",
            room=_ROOM,
        )
        figure.supylabel(f"mean cost over {_named(reference)}", fontsize=TEXT, x=0.0)
        for panel, (budget, weather) in zip(panels, shown, strict=True):
            for curve in curves:
                if curve.weather == weather:
                    _draw_curve(panel, curve, budget)
            # The first curve is the one of the reference.
            x = _median_load(curves[0], reference, budget)
            panel.axvline(x, color=REFERENCE, linewidth=0.8, zorder=0)
            head(panel, f"{weather}, time of {budget}", legend=False)
            _scale(panel)

        for panel in panels[1:]:
            panel.sharex(panels[0])
        panels[0].autoscale(axis="x")
        return save(figure, folder / "figure.png")


def _legend(reference: Cell) -> list[Line2D]:
    """Return the legend of all curves: the controller and its horizon."""
    horizon_s = reference.horizon * reference.period_s
    horizons = {STEPS: f"{reference.horizon} steps", SECONDS: f"{horizon_s:g} s"}
    return [
        Line2D([], [], label=f"{controller}, {horizons[kept]}", **_style(controller, kept))
        for controller, kept in controllers_and_periods.CURVES
    ]


def _style(controller: str, kept: str) -> dict[str, Any]:
    """Return the style of a curve."""
    marker, line = _SHAPES[kept]
    return Look(_COLOURS[controller], marker, line).style(line)


def _draw_curve(panel: Axes, curve: ComparisonCurve, budget: str) -> None:
    """Draw a curve, with the confidence interval of the cost."""
    style = _style(curve.controller, curve.kept)
    rows = list(curve.rows())
    x = np.median(curve.loads[budget], axis=1)
    is_diverged = np.isinf(curve.ratios).any(axis=1)

    # None: no run completed, drawn as diverged.
    means = np.array([row[COST_RATIO] or 0.0 for row in rows])
    # None: a single run has no interval.
    half_widths = np.array([row[f"{COST_RATIO}_ci95"] or 0.0 for row in rows])
    ratios = np.where(is_diverged, np.nan, means)
    heights = np.minimum(ratios, _LARGEST)
    below = heights - np.minimum(ratios - half_widths, _LARGEST)
    above = np.minimum(ratios + half_widths, _LARGEST) - heights
    panel.errorbar(x, heights, yerr=[below, above], linewidth=1.0, elinewidth=0.8, **style)
    panel.plot(x[is_diverged], np.full(is_diverged.sum(), _DIVERGED_Y), **style | DIVERGED)


def _median_load(curve: ComparisonCurve, cell: Cell, budget: str) -> float:
    """Return the computation of a cell, the median over repetitions, s/s."""
    place = curve.cells.index(cell)
    return float(np.median(curve.loads[budget][place]))


def _named(reference: Cell) -> str:
    """Return the reference in words."""
    return f"{reference.controller} at {1e3 * reference.period_s:g} ms"


def _squeezed(ratios: Array) -> Array:
    """Return the heights of cost ratios: a part of their distance above the break."""
    return np.where(ratios <= _BREAK, ratios, _BREAK + _COARSE * (ratios - _BREAK))


def _stretched(heights: Array) -> Array:
    """Return the cost ratios of heights."""
    return np.where(heights <= _BREAK, heights, _BREAK + (heights - _BREAK) / _COARSE)


def _scale(panel: Axes) -> None:
    """Set the axes of a panel: a logarithmic time, and cost ratios up to diverged runs, coarse above the break."""
    panel.set_xscale("log")
    label_decades(panel.xaxis)
    panel.set_yscale("function", functions=(_squeezed, _stretched))
    panel.axhspan(_BREAK, _DIVERGED_Y + _ABOVE_DIVERGED, color=_SHADE, linewidth=0.0, zorder=-1)
    panel.set_yticks([*_TICKS, _DIVERGED_Y], [*(f"{tick:g}" for tick in _TICKS), "diverged"])
    lowest = min(_LOWEST, panel.dataLim.y0)
    panel.set_ylim(lowest, _DIVERGED_Y + _ABOVE_DIVERGED)


def draw_maneuver(
    curves: Sequence[ComparisonCurve], reference: Cell, swept: Swept, folder: Path
) -> list[Path]:
    """Draw the runs of the paper's Fig. 3, 5 and 6 over one another, in still air.

    Three runs with a horizon of the same number of steps: the centralized controller; the paper's
    algorithm at the same rate; and at the period of the grid nearest to the same computation of one
    agent, if that is another one. They are simulated again: the runs are deterministic.

    Returns: maneuver.png and maneuver.svg.
    """
    overlaid = []
    for cell, name in _shown_cells(curves, reference).items():
        setup = _setup_of(cell, swept)
        label = f"{name}, {1e3 * cell.period_s:g} ms"
        overlaid.append((label, setup, series_of(setup, run_in_memory(setup))))

    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure()
        fill_overlaid(figure, overlaid, shaded=True)
        return save(figure, folder / "maneuver.png")


def _shown_cells(curves: Sequence[ComparisonCurve], reference: Cell) -> dict[Cell, str]:
    """Return the cells whose maneuvers are drawn, with their names."""
    still = {(curve.controller, curve.kept): curve for curve in curves if curve.weather == STILL}
    centralized = still[CENTRALIZED, STEPS]
    distributed = still[PAPER, STEPS]

    # The cell whose computation differs least from the reference's, as a ratio.
    reference_load = _median_load(centralized, reference, AGENT)
    loads = np.median(distributed.loads[AGENT], axis=1)
    # A cell whose runs end before a step is measured has no computation.
    nearest = int(np.nanargmin(np.abs(np.log(loads / reference_load))))
    same_rate = reference._replace(controller=PAPER)
    same_computation = distributed.cells[nearest]
    if same_computation == same_rate:
        return {reference: CENTRALIZED, same_rate: f"{PAPER}, same rate and computation"}
    return {
        reference: CENTRALIZED,
        same_rate: f"{PAPER}, same rate",
        same_computation: f"{PAPER}, same computation",
    }


def _setup_of(cell: Cell, swept: Swept) -> Setup:
    """Return the run of a cell in still air."""
    labels = {"weather": STILL, **cell._asdict()}
    points = swept.experiment.points
    case = next(case for case in swept.cases if points[case.point].labels == labels)
    return Setup.of(case.scenario, case.source)
