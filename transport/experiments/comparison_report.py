"""Report of the comparison: measure processor time, simulate, compare, and write tables, figures and verdicts."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
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
from transport.experiments.cases import Case, Point, cases_of
from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    CLOSED_LOOP,
    PAPER,
    SECONDS,
    STEPS,
    TEAM,
    Cell,
    Load,
    Loads,
)
from transport.experiments.comparison_verdict import (
    COST,
    SAME_RATE,
    Curve,
    Node,
    Verdict,
    cost_curves,
    lines,
    statements,
    verdicts,
)
from transport.experiments.simulation import NUMBERS, run_in_memory
from transport.experiments.statistics import Estimate, empty_table
from transport.experiments.sweep import Results, Simulate, Swept, sweep
from transport.flight.header import machine
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.compare import Overlaid, fill_overlaid
from transport.report.report import write_csv, write_whole
from transport.report.style import CURVES, DIVERGED, MARKER, RC, REFERENCE, SMALL, label_decades, save

WIDTH = 130
TITLE = "paper: means of completed runs; ± 95 % confidence of the ratio to centralized, taken seed by seed"

# Columns of the console's table: heading, number, factor, digits, whether the ratio to the centralized controller is
# shown. Only the ratio has a confidence interval: the spread of the others is that of the wind.
_COLUMNS = (
    ("cost\n(1e-3)", "cost_mean", 1e3, 3, False),
    ("cost over\ncentralized", "cost_mean", 1.0, 3, True),
    ("peak over\ncentralized", "cost_max", 1.0, 3, True),
    ("attitude\n(deg)", "attitude_max_deg", 1.0, 2, False),
    ("swing\n(m)", "swing_m", 1.0, 3, False),
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
) -> tuple[list[str], Table, Swept]:
    """Measure processor time, simulate every controller at every period, and write all files.

    Returns: Lines for the console, the table above them, and the sweep.
    Raises: ScenarioError: wrong settings. ExperimentError: unusable folder.
    """

    def notify(line: str) -> None:
        console.print(line, highlight=False, soft_wrap=True)

    controller = comparison.setup_of(comparison.CENTRALIZED, settings).settings
    period_s, horizon = controller.sampling_period_s, controller.horizon
    reference = Cell(controller=comparison.CENTRALIZED, period_s=period_s, horizon=horizon)
    curves = comparison.curves_of(period_s, horizon, quick=quick)
    cells = comparison.cells_of(curves)
    experiment = comparison.experiment(cells, reference, gust_mps)
    cases = cases_of(experiment.points, settings, seeds)  # refuses wrong cases before the measurement
    with Results(comparison.NAME, folder) as results:
        loads = comparison.processor_times(folder, settings, cells, quick=quick, notify=notify)
        swept = sweep(experiment, cases, simulate, results, console)
    costs = cost_curves(curves, swept)
    judged = verdicts(costs, loads, reference)
    text = [*lines(judged), "", *statements(judged)]
    tables = {
        "curves.csv": [_curve_row(curve, node, loads) for curve in costs for node in curve.nodes],
        "verdict.csv": [_verdict_row(verdict) for verdict in judged],
        "computation.csv": list(_computation_rows(loads.values())),
    }
    for name, rows in tables.items():
        write_csv(folder / name, rows, list(rows[0]))
    verdict = folder / "verdict.txt"
    write_whole(verdict, "\n".join([*text, "", f"machine: {machine()}", ""]).encode())
    files = [*(folder / name for name in tables), verdict, swept.write_cases(folder)]
    shown = list(_maneuver_runs(costs, judged, reference, experiment.points, cases))
    files += [*draw_costs(costs, loads, reference, folder), *draw_maneuver(shown, folder)]
    output = ["", *text, "", f"machine: {machine()}", *(f" {path}" for path in files)]
    return output, table_of(costs, loads), swept


def _maneuver_runs(
    costs: Sequence[Curve],
    judged: Sequence[Verdict],
    reference: Cell,
    points: Sequence[Point],
    cases: Sequence[Case],
) -> Iterator[tuple[str, Setup]]:
    """Yield name and setup of the runs of the paper's Fig. 3, 5 and 6, in still air with as many steps of horizon.

    These are the centralized controller, the paper's algorithm at the same rate, and at the period of the grid
    nearest to the same computation of one agent.
    """
    wanted = (comparison.PAPER, comparison.STEPS, comparison.STILL)
    curve = next(curve for curve in costs if (curve.controller, curve.kept, curve.weather) == wanted)
    own = [node.cell for node in curve.nodes]
    shown = {
        reference: f"{comparison.CENTRALIZED}, ",
        **{cell: f"{comparison.PAPER}, same rate, " for cell in own if cell.period_s == reference.period_s},
    }
    for verdict in judged:
        found = (verdict.controller, verdict.kept, verdict.weather)
        low_s, high_s = verdict.periods.low_s, verdict.periods.high_s
        if found == wanted and verdict.budget == AGENT and not verdict.periods.is_open:
            middle_s = math.sqrt(low_s * high_s)
            nearest = min(own, key=lambda cell: abs(math.log(cell.period_s / middle_s)))
            shown.setdefault(nearest, f"{comparison.PAPER}, same computation, ")
    still = {}
    for case in cases:
        labels: dict[str, Any] = dict(points[case.point].labels)
        if labels.pop("weather") == comparison.STILL:
            still[Cell(**labels)] = case
    for cell, title in shown.items():
        yield f"{title}{1e3 * cell.period_s:g} ms", Setup.of(still[cell].scenario, still[cell].source)


def table_of(costs: Sequence[Curve], loads: Loads) -> Table:
    """Return the table for the console, `WIDTH` characters wide."""
    times = ("CPU step\n(ms)", "agent\n(s/s)", "team\n(s/s)")
    right = ("T_s\n(ms)", "N_p", "done", *(heading for heading, *_ in _COLUMNS), *times)
    table = empty_table(TITLE, ("weather", "controller", "horizon\nkept"), right)
    before: tuple[str, ...] = ("", "", "")
    for curve in costs:
        for node in curve.nodes:
            cell = node.cell
            load = loads[cell]
            named = (curve.weather, curve.controller, curve.kept)
            table.add_row(
                *(("",) * 3 if named == before else named),
                f"{1e3 * cell.period_s:g}",
                str(cell.horizon),
                f"{node.completed}/{node.runs}",
                *(
                    _cell(node.ratio(name) if over else node.numbers.get(name), factor, digits, interval=over)
                    for _, name, factor, digits, over in _COLUMNS
                ),
                f"{statistics.median(load.step_ms):.2f}",
                *(f"{statistics.median(load.seconds_per_second(budget)):.3f}" for budget in (AGENT, TEAM)),
            )
            before = named
    return table


def _cell(value: Estimate | None, factor: float, digits: int, *, interval: bool) -> str:
    if value is None:
        return "-"
    text = f"{factor * value.mean:.{digits}f}"
    return f"{text} ±{factor * value.half_width:.{digits}f}" if interval and value.half_width else text


def _curve_row(curve: Curve, node: Node, loads: Loads) -> dict[str, Any]:
    cell = node.cell
    row: dict[str, Any] = {"weather": curve.weather, "controller": curve.controller, "kept": curve.kept}
    row |= {"period_s": cell.period_s, "horizon": cell.horizon, "flights": node.runs, "completed": node.completed}
    row["first_lost_s"] = min(node.diverged_s, default=None)
    for name in NUMBERS[1:]:
        for value, column in ((node.numbers.get(name), name), (node.ratio(name), f"{name}_ratio")):
            row |= {column: value and value.mean, f"{column}_ci95": value and value.half_width}
    load = loads[cell]
    for column, values in (
        ("cpu_step_ms", load.step_ms),
        ("cpu_agent_s_per_s", load.seconds_per_second(AGENT)),
        ("cpu_team_s_per_s", load.seconds_per_second(TEAM)),
    ):
        row |= {column: statistics.median(values), f"{column}_min": min(values), f"{column}_max": max(values)}
    return row


def _verdict_row(verdict: Verdict) -> dict[str, Any]:
    """Return a row of verdict.csv; an end beyond the grid is empty, the ratio of a diverged run infinite."""
    low_s, high_s = verdict.periods.low_s, verdict.periods.high_s
    low, high = verdict.ratios or (None, None)
    claimed = "slightly worse" if verdict.budget == SAME_RATE else "slightly better"
    return {
        "weather": verdict.weather,
        "controller": verdict.controller,
        "budget": verdict.budget,
        "kept": verdict.kept,
        "period_low_s": low_s if low_s > 0.0 and math.isfinite(low_s) else None,
        "period_high_s": high_s if high_s > 0.0 and math.isfinite(high_s) else None,
        "cost_ratio_low": low,
        "cost_ratio_high": high,
        "verdict": verdict.text,
        "claim": claimed if verdict.controller == comparison.PAPER else "",
        "supported": verdict.supports(claimed) if verdict.controller == comparison.PAPER else "",
    }


def _computation_rows(loads: Iterable[Load]) -> Iterator[dict[str, Any]]:
    for load in loads:
        named = {name: value for name, value in asdict(load).items() if not name.endswith("step_ms")}
        ratios = zip(load.ratios(TEAM), load.ratios(AGENT), strict=True)
        for repetition, (team, agent) in enumerate(ratios):
            times = {"step_ms": load.step_ms[repetition], "reference_step_ms": load.reference_step_ms[repetition]}
            yield {**named, "repetition": repetition, **times, "team_ratio": team, "agent_ratio": agent}


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
