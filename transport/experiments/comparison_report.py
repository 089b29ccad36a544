"""Report of the comparison: measure processor time, simulate, compare, and write tables, figures and verdicts."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.console import Console
from rich.table import Table

from protocol.scenario.setup import Setup
from transport.analysis.series import series_of
from transport.experiments import comparison
from transport.experiments.cases import cases_of
from transport.experiments.comparison import CENTRALIZED, CLOSED_LOOP, PAPER, SECONDS, STEPS, Cell, Curve, Row
from transport.experiments.simulation import run_in_memory
from transport.experiments.statistics import Column, console_table
from transport.experiments.sweep import Results, Simulate, Swept, sweep
from transport.flight.header import machine
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.compare import Overlaid, fill_overlaid
from transport.report.report import write_csv, write_whole
from transport.report.style import CURVES, DIVERGED, MARKER, RC, REFERENCE, SMALL, label_decades, save

WIDTH = 130
TITLE = "paper: means of completed runs; ± 95 % confidence of the ratio to centralized, taken seed by seed"

_LABELS = {"weather": "weather", "controller": "controller", "kept": "horizon\nkept"}
# Only the ratios have confidence intervals: the spread of the others is that of the wind.
_COLUMNS = (
    Column("T_s\n(ms)", "period_s", 1e3, 1),
    Column("N_p", "horizon", digits=0),
    Column("cost\n(1e-3)", "cost_mean", 1e3, 3),
    Column("cost over\ncentralized", "cost_mean_ratio", digits=3, interval=True),
    Column("peak over\ncentralized", "cost_max_ratio", digits=3, interval=True),
    Column("attitude\n(deg)", "attitude_max_deg"),
    Column("swing\n(m)", "swing_m", digits=3),
    Column("CPU step\n(ms)", "cpu_step_ms"),
    Column("agent\n(s/s)", "cpu_agent_s_per_s", digits=3),
    Column("team\n(s/s)", "cpu_team_s_per_s", digits=3),
)


def compare(
    settings: Sequence[str],
    seeds: int,
    gust_mps: float,
    folder: Path,
    simulate: Simulate,
    console: Console,
    *,
    quick: bool = False,
) -> tuple[list[str], Table]:
    """Measure processor time, simulate every controller at every period, and write all files.

    Returns: Lines for the console, and the table above them.
    Raises: ScenarioError: wrong settings. ExperimentError: unusable folder, or a run that raised an error.
    """

    def notify(line: str) -> None:
        console.print(line, highlight=False, soft_wrap=True)

    controller = comparison.setup_of(CENTRALIZED, settings).settings
    reference = Cell(CENTRALIZED, controller.sampling_period_s, controller.horizon)
    cells = comparison.cells_of(reference, quick=quick)
    every = list(dict.fromkeys(cell for own in cells.values() for cell in own))  # curves meet at the reference
    experiment = comparison.experiment(every, reference, gust_mps)
    cases = cases_of(experiment.points, settings, seeds)  # refuses wrong cases before the measurement
    with Results(comparison.NAME, folder) as results:
        loads = comparison.processor_times(folder, settings, every, quick=quick, notify=notify)
        swept = sweep(experiment, cases, simulate, results, console)
    files = [swept.write_cases(folder)]
    curves = comparison.cost_curves(cells, swept, loads)
    rows = [row for curve in curves for row in curve.rows]
    judged = comparison.verdicts(curves, loads, reference)
    for name, content in (("curves.csv", rows), ("verdict.csv", judged)):
        files.append(folder / name)
        write_csv(files[-1], content, list(content[0]))
    text = [*comparison.sentences(judged), "", *comparison.statements(judged), "", f"machine: {machine()}"]
    files.append(folder / "verdict.txt")
    write_whole(files[-1], "\n".join([*text, ""]).encode())
    shown = _maneuver_runs(curves, judged, reference, swept)
    files += [*draw_costs(curves, reference, folder), *draw_maneuver(shown, folder)]
    return ["", *text, *(f" {path}" for path in files)], console_table(TITLE, _LABELS, _COLUMNS, rows)


def _maneuver_runs(
    curves: Sequence[Curve], judged: Sequence[Row], reference: Cell, swept: Swept
) -> Iterator[tuple[str, Setup]]:
    """Yield name and setup of the runs of the paper's Fig. 3, 5 and 6, in still air with as many steps of horizon.

    These are the centralized controller, the paper's algorithm at the same rate, and at the period of the grid
    nearest to the same computation of one agent.
    """
    wanted = {"weather": comparison.STILL, "controller": PAPER, "kept": STEPS}
    (curve,) = (curve for curve in curves if all(getattr(curve, name) == value for name, value in wanted.items()))
    shown = {f"{CENTRALIZED}, ": reference, f"{PAPER}, same rate, ": reference._replace(controller=PAPER)}
    (row,) = (row for row in judged if row.items() >= {**wanted, "budget": comparison.AGENT}.items())
    if row["period_low_s"] and row["period_high_s"]:
        middle_s = math.sqrt(row["period_low_s"] * row["period_high_s"])
        nearest = min(curve.cells, key=lambda cell: abs(math.log(cell.period_s / middle_s)))
        if nearest not in shown.values():
            shown[f"{PAPER}, same computation, "] = nearest
    for title, cell in shown.items():
        labels = {"weather": comparison.STILL, **cell._asdict()}
        case = next(case for case in swept.cases if swept.experiment.points[case.point].labels == labels)
        yield f"{title}{1e3 * cell.period_s:g} ms", Setup.of(case.scenario, case.source)


# Colour of each controller; marker and line of a horizon with as many steps and of one with as many seconds.
_COLOURS = {CENTRALIZED: "#000000", PAPER: CURVES[0][0], CLOSED_LOOP: CURVES[1][0]}
_SHAPES = {STEPS: ("o", "-"), SECONDS: ("D", "--")}
_TIMES = {"the team": "cpu_team_s_per_s", "an agent": "cpu_agent_s_per_s"}
_PANEL_IN, _ABOVE_IN = 0.95, 0.17

# Larger cost ratios are drawn at the upper edge of the panel, diverged runs above it.
_HIGHEST, _STRIP = 3.0, 3.35
_LOWEST, _NAME = 0.6, 2.65  # lower end, height of the name of the vertical line


def draw_costs(curves: Sequence[Curve], reference: Cell, folder: Path) -> list[Path]:
    """Draw a panel for each weather: cost over the computation of the team; then the same over that of one agent.

    A vertical line marks the computation of the reference, the centralized cell.

    Returns: figure.png and figure.svg.
    """
    kept_at = {STEPS: f"{reference.horizon} steps", SECONDS: f"{reference.horizon * reference.period_s:g} s"}
    legend: dict[str, list[Line2D]] = {}
    for controller, kept in dict.fromkeys((curve.controller, curve.kept) for curve in curves):
        line = Line2D([], [], label=f"horizon {kept_at[kept]}", markersize=MARKER, **_style(controller, kept))
        legend.setdefault(controller, []).append(line)
    shown = [(whose, weather) for whose in _TIMES for weather in dict.fromkeys(curve.weather for curve in curves)]
    with mpl.rc_context({**RC, "svg.hashsalt": "costs"}):
        figure = Figure()
        panels = column_panels(
            figure,
            [_PANEL_IN] * len(shown),
            x_label="processor time per second of the run (s/s)",
            top_in=legend_height_in(legend) + _ABOVE_IN,
        )
        draw_legend(figure, legend)
        rows = [row for curve in curves for row in curve.rows]
        ends = [row[f"{name}{end}"] for row in rows for name in _TIMES.values() for end in ("_min", "_max")]
        for panel, (whose, weather) in zip(panels, shown, strict=True):
            for curve in (curve for curve in curves if curve.weather == weather):
                _draw(panel, curve, _TIMES[whose])
                if curve.controller == CENTRALIZED and curve.kept == STEPS:
                    x = curve.rows[curve.cells.index(reference)][_TIMES[whose]]
            panel.axvline(x, color=REFERENCE, linewidth=0.8, zorder=0)
            name = f"centralized\nat {1e3 * reference.period_s:g} ms"
            how: Any = {"ha": "right", "va": "center", "fontsize": SMALL, "color": "#555555", "linespacing": 1.0}
            panel.annotate(name, (x, _NAME), (-3.0, 0.0), textcoords="offset points", **how)
            panel.set_xscale("log")
            label_decades(panel.xaxis)
            panel.set_xlim(min(ends) / 1.15, max(ends) * 1.15)
            head(panel, f"mean cost over centralized; {weather}, time of {whose}", legend=False)
            ticks = (1.0, 1.5, 2.0, 2.5, _HIGHEST)
            panel.set_yticks([*ticks, _STRIP], [*(f"{tick:g}" for tick in ticks), "diverged"])
            panel.set_ylim(_LOWEST, _STRIP + 0.2)
        return save(figure, folder / "figure.png")


def _style(controller: str, kept: str) -> dict[str, Any]:
    marker, line = _SHAPES[kept]
    return {"color": _COLOURS[controller], "marker": marker, "linestyle": line}


def _draw(axes: Axes, curve: Curve, time: str) -> None:
    """Draw a curve, with the spread of the processor time and the confidence interval of the cost."""
    style = _style(curve.controller, curve.kept)
    dot: dict[str, Any] = {**style, "markersize": MARKER, "linestyle": "none"}
    x, y = [], []
    for row in curve.rows:
        at, ratio = row[time], row["cost_mean_ratio"]
        if row["first_lost_s"] is not None:
            axes.plot([at], [_STRIP], **dot | DIVERGED)
        elif ratio > _HIGHEST:
            axes.plot([at], [_HIGHEST], **dot | {"marker": "$\\uparrow$"})
        else:
            spread = [[at - row[f"{time}_min"]], [row[f"{time}_max"] - at]]
            half = row["cost_mean_ratio_ci95"] or 0.0
            axes.errorbar([at], [ratio], half, spread, color=style["color"], linestyle="none", elinewidth=0.8)
        x.append(at)
        y.append(ratio if row["first_lost_s"] is None and ratio <= _HIGHEST else math.nan)
    axes.plot(x, y, linewidth=1.0, markersize=MARKER, **style)


def draw_maneuver(runs: Iterator[tuple[str, Setup]], folder: Path) -> list[Path]:
    """Simulate each run again and draw all over one another, each with its name.

    The runs are deterministic, so they equal the measured ones.

    Returns: maneuver.png and maneuver.svg.
    """
    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure()
        overlaid = [Overlaid(label, setup, series_of(setup, run_in_memory(setup))) for label, setup in runs]
        fill_overlaid(figure, overlaid, shaded=True)
        return save(figure, folder / "maneuver.png")
