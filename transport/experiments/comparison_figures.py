"""Figures of the comparison: mean cost over processor time, and one maneuver under different controllers."""

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from protocol.scenario.setup import Setup
from transport.analysis.series import series_of
from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    CLOSED_LOOP,
    PAPER,
    SECONDS,
    STEPS,
    TEAM,
    Cell,
    Loads,
)
from transport.experiments.comparison_verdict import COST, Curve
from transport.experiments.simulation import run_in_memory
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.compare import Overlaid, fill_overlaid
from transport.report.style import CURVES, DIVERGED, MARKER, RC, REFERENCE, SMALL, label_decades, save

# Colour of each controller; marker and line of a horizon with as many steps and of one with as many seconds.
_COLOURS = {CENTRALIZED: "#000000", PAPER: CURVES[0][0], CLOSED_LOOP: CURVES[1][0]}
_SHAPES = {STEPS: ("o", "-"), SECONDS: ("D", "--")}
_WHOSE = {TEAM: "the team", AGENT: "an agent"}
_PANEL_IN, _ABOVE_IN = 0.95, 0.17

# Larger cost ratios are drawn at the upper edge of the panel, diverged runs above it.
_HIGHEST, _STRIP = 3.0, 3.35
_LOWEST, _NAME = 0.6, 2.65  # lower end, height of the name of the vertical line


def draw_costs(curves: Sequence[Curve], loads: Loads, reference: Cell, folder: Path) -> list[Path]:
    """Draw a panel for each weather: cost over the computation of the team; then the same over that of one agent.

    A vertical line marks the computation of the reference, the centralized cell.

    Returns: figure.png and figure.svg.
    """
    shown = [(budget, weather) for budget in (TEAM, AGENT) for weather in dict.fromkeys(c.weather for c in curves)]
    with mpl.rc_context({**RC, "svg.hashsalt": "costs"}):
        figure = Figure()
        rows = _legend(curves, reference)
        panels = column_panels(
            figure,
            [_PANEL_IN] * len(shown),
            x_label="processor time per second of the run (s/s)",
            top_in=legend_height_in(rows) + _ABOVE_IN,
        )
        draw_legend(figure, rows)
        every = [time for load in loads.values() for whose in (TEAM, AGENT) for time in load.seconds_per_second(whose)]
        for panel, (budget, weather) in zip(panels, shown, strict=True):
            for curve in (curve for curve in curves if curve.weather == weather):
                _draw(panel, curve, loads, budget)
            x = median(loads[reference].seconds_per_second(budget))
            panel.axvline(x, color=REFERENCE, linewidth=0.8, zorder=0)
            name = f"centralized\nat {1e3 * reference.period_s:g} ms"
            how: Any = {"ha": "right", "va": "center", "fontsize": SMALL, "color": "#555555", "linespacing": 1.0}
            panel.annotate(name, (x, _NAME), (-3.0, 0.0), textcoords="offset points", **how)
            panel.set_xscale("log")
            label_decades(panel.xaxis)
            panel.set_xlim(min(every) / 1.15, max(every) * 1.15)
            head(panel, f"mean cost over centralized; {weather}, time of {_WHOSE[budget]}", legend=False)
            ticks = (1.0, 1.5, 2.0, 2.5, _HIGHEST)
            panel.set_yticks([*ticks, _STRIP], [*(f"{tick:g}" for tick in ticks), "diverged"])
            panel.set_ylim(_LOWEST, _STRIP + 0.2)
        return save(figure, folder / "figure.png")


def _legend(curves: Sequence[Curve], reference: Cell) -> dict[str, list[Line2D]]:
    """Return the handles of the curves: a row for each controller."""
    kept_at = {STEPS: f"{reference.horizon} steps", SECONDS: f"{reference.horizon * reference.period_s:g} s"}
    rows: dict[str, list[Line2D]] = {}
    for controller, kept in dict.fromkeys((curve.controller, curve.kept) for curve in curves):
        marker, line = _SHAPES[kept]
        how: Any = {"color": _COLOURS[controller], "marker": marker, "linestyle": line, "markersize": MARKER}
        rows.setdefault(controller, []).append(Line2D([], [], label=f"horizon {kept_at[kept]}", **how))
    return rows


def _draw(axes: Axes, curve: Curve, loads: Loads, budget: str) -> None:
    """Draw a curve, with the spread of the processor time and the confidence interval of the cost."""
    marker, line = _SHAPES[curve.kept]
    colour = _COLOURS[curve.controller]
    dots: dict[str, Any] = {"color": colour, "marker": marker, "markersize": MARKER}
    x, y = [], []
    for node in curve.nodes:
        times = loads[node.cell].seconds_per_second(budget)
        ratio = node.ratio(COST)
        x.append(median(times))
        inside = not node.diverged_s and ratio is not None and ratio.mean <= _HIGHEST
        y.append(ratio.mean if inside and ratio is not None else math.nan)
        if node.diverged_s:
            axes.plot(x[-1:], [_STRIP], **dots | DIVERGED)
        elif ratio is not None and ratio.mean > _HIGHEST:
            axes.plot(x[-1:], [_HIGHEST], **dots | {"marker": "$\\uparrow$", "linestyle": "none"})
        elif ratio is not None:
            spread = [[x[-1] - min(times)], [max(times) - x[-1]]]
            how: Any = {"color": colour, "linestyle": "none", "elinewidth": 0.8}
            axes.errorbar(x[-1:], y[-1:], ratio.half_width or 0.0, spread, **how)
    axes.plot(x, y, linestyle=line, linewidth=1.0, **dots)


def draw_maneuver(runs: Sequence[tuple[str, Setup]], folder: Path) -> list[Path]:
    """Simulate each run again and draw all over one another, each with its name.

    The runs are deterministic, so they equal the measured ones.

    Returns: maneuver.png and maneuver.svg.
    """
    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure()
        overlaid = [Overlaid(label, setup, series_of(setup, run_in_memory(setup))) for label, setup in runs]
        fill_overlaid(figure, overlaid, shaded=True)
        return save(figure, folder / "maneuver.png")
