"""Report of the comparison: measure processor time, simulate, compare, and write tables, figures and verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.console import Console
from rich.table import Table

from transport.analysis.series import series_of
from transport.experiments import comparison
from transport.experiments.cases import Point, cases_of, run_in_memory
from transport.experiments.cases import simulate as simulate_here
from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    CLOSED_LOOP,
    PAPER,
    SECONDS,
    STEPS,
    STILL,
    Cell,
    Curve,
)
from transport.experiments.declaration import Experiment
from transport.experiments.statistics import COST_RATIO, Column, console_table
from transport.experiments.sweep import Results, Simulate, Swept, sweep, write_markdown
from transport.protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.setup import Setup
from transport.report.column import Room, column_panels, head
from transport.report.compare import fill_overlaid
from transport.report.report import write_csv
from transport.report.style import (
    CURVES,
    DIVERGED,
    MARKER,
    RC,
    REFERENCE,
    SMALL,
    label_decades,
    save,
)

TITLE = "paper: means of completed runs; ± 95 % confidence of the ratio to centralized, taken seed by seed"

_LABELS = {"weather": "weather", "controller": "controller", "kept": "horizon\nkept"}
# Only the ratio has a confidence interval: the spread of the others is that of the wind.
_COLUMNS = (
    Column("T_s\n(ms)", "period_s", 1e3, 1),
    Column("N_p", "horizon", digits=0),
    Column("cost\n(1e-3)", "cost_mean", 1e3, 3),
    Column("cost over\ncentralized", COST_RATIO, digits=3, interval=True),
    Column("attitude\n(deg)", "attitude_max_deg"),
    Column("swing\n(m)", "swing_m", digits=3),
    Column("CPU step\n(ms)", "cpu_step_ms"),
    Column("agent\n(s/s)", "cpu_agent_s_per_s", digits=3),
    Column("team\n(s/s)", "cpu_team_s_per_s", digits=3),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonOptions:
    """Options of the comparison.

    Attributes:
        settings: Changes KEY=VALUE of the centralized scenario.
        seeds: Repetitions of each run in gusts.
        gust_mps: Standard deviation of gusts; 0 for still air only.
        quick: Whether this is a trial with few points.
    """

    settings: Sequence[str]
    seeds: int
    gust_mps: float
    quick: bool = False

    def reference(self) -> Cell:
        """Return the centralized controller at the period of its scenario.

        Raises: ScenarioError: wrong settings.
        """
        path = find_scenario(comparison.SCENARIOS[CENTRALIZED])
        scenario = read_scenario(path, self.settings)
        agents = len(scenario.owned)
        if agents > 1:
            expected = f"expected one agent that owns all, got {agents}"
            raise ScenarioError(str(path), "agents.owned", expected)

        controller = scenario.controller
        return Cell(CENTRALIZED, controller.sampling_period_s, controller.horizon)


def compare(
    options: ComparisonOptions, folder: Path, simulate: Simulate, console: Console
) -> tuple[list[str], Table]:
    """Measure processor time, simulate every controller at every period, and write all files.

    Returns: Lines for the console, and the table above them.
    Raises: ScenarioError: wrong settings. ExperimentError: unusable folder, or a run that raised an
        error.
    """
    reference = options.reference()
    cells = comparison.cells_of(reference, quick=options.quick)
    # Curves meet at the reference.
    distinct = list(dict.fromkeys(cell for own in cells.values() for cell in own))
    experiment = comparison.experiment(distinct, options.gust_mps)
    cases = cases_of(experiment.points, options.settings, options.seeds)

    with Results(comparison.NAME, folder) as results:
        timed = _measured(experiment.points[: len(distinct)], options, results, console)
        swept = sweep(experiment, cases, simulate, results, console)

    curves = comparison.curves_of(cells, timed, swept, reference)
    rows = [row for curve in curves for row in curve.rows()]
    verdicts = list(comparison.verdicts(curves, reference))

    files = [
        timed.write_cases(folder / "computation.csv"),
        swept.write_cases(folder / "cases.csv"),
        _written(folder / "curves.csv", rows),
        _written(folder / "verdict.csv", verdicts),
        *draw_costs(curves, reference, folder),
        *draw_maneuver(curves, reference, swept, folder),
    ]
    table = console_table(TITLE, _LABELS, _COLUMNS, rows)
    sentences = list(map(comparison.sentence, verdicts))
    return write_markdown(folder, sentences, table, files), table


def _measured(
    points: Sequence[Point], options: ComparisonOptions, results: Results, console: Console
) -> Swept:
    """Measure the processor time of every controller at every period.

    One run at a time, all controllers in turns: a slow period of the machine affects all alike.

    Raises: ExperimentError: a run raised an error.
    """
    measurement = Experiment(name="processor time", points=tuple(points))
    maneuver = comparison.QUICK_MEASUREMENT if options.quick else comparison.MANEUVER
    repeats = comparison.QUICK_REPEATS if options.quick else comparison.REPEATS
    cases = cases_of(measurement.points, [*options.settings, maneuver], repeats, timed=True)

    timed = sweep(measurement, cases, partial(map, simulate_here), results, console)
    timed.check()
    return timed


def _written(path: Path, rows: Sequence[comparison.Row]) -> Path:
    """Write a table with the columns of its first row; return its path."""
    write_csv(path, rows, list(rows[0]))
    return path


# Colour of each controller; marker and line of a horizon with as many steps and of one with as many seconds.
_COLOURS = {CENTRALIZED: "#000000", PAPER: CURVES[0][0], CLOSED_LOOP: CURVES[1][0]}
_SHAPES = {STEPS: ("o", "-"), SECONDS: ("D", "--")}
_PANEL_IN, _ABOVE_IN = 0.95, 0.17

# Larger cost ratios are drawn at the upper edge of the panel, diverged runs above it.
_HIGHEST, _STRIP = 3.0, 3.35
_LOWEST, _NAME = 0.6, 2.65  # lower end, height of the name of the vertical line


def draw_costs(curves: Sequence[Curve], reference: Cell, folder: Path) -> list[Path]:
    """Draw a panel for each weather: cost over the computation of the team; then the same over that of one agent.

    A vertical line marks the computation of the reference, the centralized cell.

    Returns: figure.png and figure.svg.
    """
    kept_at = {
        STEPS: f"{reference.horizon} steps",
        SECONDS: f"{reference.horizon * reference.period_s:g} s",
    }
    legend = [
        Line2D([], [], label=f"{controller}, {kept_at[kept]}", **_style(controller, kept))
        for controller, kept in comparison.CURVES
    ]
    weathers = dict.fromkeys(curve.weather for curve in curves)
    shown = [(budget, weather) for budget in curves[0].loads for weather in weathers]
    with mpl.rc_context({**RC, "svg.hashsalt": "costs"}):
        figure = Figure()
        x_label = "processor time per second of the run (s/s)"
        panels = column_panels(
            figure,
            [_PANEL_IN] * len(shown),
            legend=legend,
            x_label=x_label,
            room=Room(top_in=_ABOVE_IN),
        )
        for panel, (budget, weather) in zip(panels, shown, strict=True):
            for curve in (curve for curve in curves if curve.weather == weather):
                _draw(panel, curve, budget)
            x = np.median(curves[0].loads[budget][curves[0].cells.index(reference)])
            panel.axvline(x, color=REFERENCE, linewidth=0.8, zorder=0)
            name = f"centralized\nat {1e3 * reference.period_s:g} ms"
            how: Any = {
                "ha": "right",
                "va": "center",
                "fontsize": SMALL,
                "color": "#555555",
                "linespacing": 1.0,
            }
            panel.annotate(name, (x, _NAME), (-3.0, 0.0), textcoords="offset points", **how)
            panel.set_xscale("log")
            label_decades(panel.xaxis)
            head(panel, f"mean cost over centralized; {weather}, time of {budget}", legend=False)
            ticks = (1.0, 1.5, 2.0, 2.5, _HIGHEST)
            panel.set_yticks([*ticks, _STRIP], [*(f"{tick:g}" for tick in ticks), "diverged"])
            panel.set_ylim(_LOWEST, _STRIP + 0.2)
        for panel in panels[1:]:
            panel.sharex(panels[0])
        panels[0].autoscale(axis="x")
        return save(figure, folder / "figure.png")


def _style(controller: str, kept: str) -> dict[str, Any]:
    marker, line = _SHAPES[kept]
    return {
        "color": _COLOURS[controller],
        "marker": marker,
        "linestyle": line,
        "markersize": MARKER,
    }


def _draw(axes: Axes, curve: Curve, budget: str) -> None:
    """Draw a curve, with the confidence interval of the cost."""
    style, rows = _style(curve.controller, curve.kept), list(curve.rows())
    x = np.median(curve.loads[budget], axis=1)
    cost, half = (
        np.array([row[f"{COST_RATIO}{end}"] or 0.0 for row in rows]) for end in ("", "_ci95")
    )
    diverged = np.isinf(curve.ratios).any(axis=1)
    cost[diverged] = np.nan
    axes.errorbar(x, np.minimum(cost, _HIGHEST), half, linewidth=1.0, elinewidth=0.8, **style)
    axes.plot(x[diverged], np.full(diverged.sum(), _STRIP), **style | DIVERGED)


def draw_maneuver(
    curves: Sequence[Curve], reference: Cell, swept: Swept, folder: Path
) -> list[Path]:
    """Draw the runs of the paper's Fig. 3, 5 and 6 over one another, in still air with as many steps of horizon.

    These are the centralized controller, the paper's algorithm at the same rate, and at the period of the grid nearest
    to the same computation of one agent. They are simulated again: the runs are deterministic.

    Returns: maneuver.png and maneuver.svg.
    """
    of = {(curve.controller, curve.kept): curve for curve in curves if curve.weather == STILL}
    whole, own = of[CENTRALIZED, STEPS], of[PAPER, STEPS]
    times_s = np.median(own.loads[AGENT], axis=1)
    away = np.abs(np.log(times_s / np.median(whole.loads[AGENT][whole.cells.index(reference)])))
    shown = {
        reference: CENTRALIZED,
        reference._replace(controller=PAPER): f"{PAPER}, same rate",
        own.cells[int(np.argmin(away))]: f"{PAPER}, same computation",
    }
    overlaid = []
    for cell, name in shown.items():
        labels = {"weather": STILL, **cell._asdict()}
        case = next(
            case for case in swept.cases if swept.experiment.points[case.point].labels == labels
        )
        setup = Setup.of(case.scenario, case.source)
        overlaid.append(
            (f"{name}, {1e3 * cell.period_s:g} ms", setup, series_of(setup, run_in_memory(setup)))
        )
    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure()
        fill_overlaid(figure, overlaid, shaded=True)
        return save(figure, folder / "maneuver.png")
