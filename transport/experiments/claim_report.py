"""`transport experiment paper` from its options to its folder: measure, run, compare, and report the result."""

import csv
import io
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from protocol.scenario.setup import Setup
from transport.experiments import claim, claim_figure
from transport.experiments.cases import Case, Point, cases_of
from transport.experiments.claim import Cell
from transport.experiments.computation import AGENT, TEAM, Load
from transport.experiments.cost_curves import Curve, Node, cost_curves
from transport.experiments.cost_figure import draw_costs
from transport.experiments.errors import ExperimentError
from transport.experiments.flight import NUMBERS, Result
from transport.experiments.results import Results
from transport.experiments.statistics import Estimate
from transport.experiments.sweep import Fly, sweep
from transport.experiments.table import cases_csv
from transport.experiments.verdict import SAME_RATE, Verdict, lines, statements, verdicts
from transport.flight.run import machine
from transport.report.report import write_whole

WIDTH = 130
TITLE = "paper: means of completed runs; ± 95 % confidence of the ratio to centralized, taken seed by seed"

# Columns that people read: heading, number, factor, digits, whether it is over the centralized controller's. Only that
# has its confidence interval: seed by seed it is of the controllers, the others' are of the wind.
_SHOWN = (
    ("cost\n(1e-3)", "cost_mean", 1e3, 3, False),
    ("cost over\ncentralized", "cost_mean", 1.0, 3, True),
    ("peak over\ncentralized", "cost_max", 1.0, 3, True),
    ("attitude\n(deg)", "attitude_max_deg", 1.0, 2, False),
    ("swing\n(m)", "swing_m", 1.0, 3, False),
)

Loads = Mapping[tuple[str, float, int], Load]


def conduct(
    settings: Sequence[str],
    seeds: int,
    gust_mps: float,
    folder: Path,
    simulate: Fly,
    console: Console,
    *,
    quick: bool = False,
) -> tuple[list[str], Table, list[Result]]:
    """Measure computation, run every controller at every period, write everything there is to read.

    Args:
        settings: Changes of every scenario.
        seeds: Runs of each cell in gusts.
        gust_mps: Their standard deviation; 0 for still air alone.
        folder: Of the experiment.
        simulate: Gives the results of cases.
        console: For progress.
        quick: Few periods, computation measured on the shortest of runs: a trial.
    Returns: Lines for people, a table to go above them, and the results.
    Raises: ScenarioError: settings that cannot be. ExperimentError: a folder that cannot be.
    """
    first = claim.reference_of(settings).settings
    reference = Cell(controller=claim.CENTRALIZED, period_s=first.sampling_period_s, horizon=first.horizon)
    curves = claim.curves_of(first.sampling_period_s, first.horizon, quick=quick)
    cells = claim.cells_of(curves)
    experiment = claim.experiment(cells, reference, gust_mps)
    cases = cases_of(experiment.points, settings, seeds)  # refuses what cannot exist before anything is measured
    with Results(folder, claim.NAME, machine()) as results:
        for notice in results.notices:
            console.print(notice, highlight=False, soft_wrap=True)

        def notify(line: str) -> None:
            console.print(line, highlight=False, soft_wrap=True)

        measured = claim.computation(folder, settings, cells, quick=quick, notify=notify)
        try:
            found = sweep(experiment, cases, simulate, results, console)
        except (KeyboardInterrupt, ExperimentError):
            done = sum(results.done(case.key) for case in cases)
            notify(f"{done} of {len(cases)} flights are kept; go on with: --out {folder}")
            raise
    loads = {(load.controller, load.period_s, load.horizon): load for load in measured}
    costs = cost_curves(curves, experiment.points, cases, found)
    judged = verdicts(costs, measured, reference)
    words = [*lines(judged), "", *statements(judged)]
    written = {
        "curves.csv": _csv([_row(curve, node, loads) for curve in costs for node in curve.nodes]),
        "verdict.csv": _csv([_verdict(verdict) for verdict in judged]),
        "computation.csv": _csv(list(_repetitions(measured))),
        "cases.csv": cases_csv(experiment.points, cases, found),
        "verdict.txt": "\n".join([*words, "", f"machine: {machine()}", ""]).encode(),
    }
    for name, content in written.items():
        write_whole(folder / name, content)
    drawn = [
        *draw_costs(costs, loads, reference, folder),
        *claim_figure.draw(list(_columns(costs, judged, reference, experiment.points, cases)), folder),
    ]
    files = [*(folder / name for name in written), *drawn]
    told = ["", *words, "", f"machine: {machine()}", *(f" {path}" for path in files)]
    return told, table_of(costs, loads), found


def _columns(
    costs: Sequence[Curve],
    judged: Sequence[Verdict],
    reference: Cell,
    points: Sequence[Point],
    cases: Sequence[Case],
) -> Iterator[tuple[str, Setup]]:
    """The runs of the paper's figures 3, 5 and 6, in still air with as many steps of horizon.

    The centralized controller, the paper's algorithm at its rate, and at the period of the grid that is nearest to
    the same computation of one agent.
    """
    curve = next(c for c in costs if (c.controller, c.kept, c.weather) == (claim.PAPER, claim.STEPS, claim.STILL))
    own = [node.cell for node in curve.nodes]
    shown = {
        reference: f"{claim.CENTRALIZED}\n",
        **{cell: f"{claim.PAPER}\nsame rate, " for cell in own if cell.period_s == reference.period_s},
    }
    for verdict in judged:
        wanted = (verdict.controller, verdict.weather, verdict.budget, verdict.kept)
        low_s, high_s = verdict.periods.low_s, verdict.periods.high_s
        if wanted == (claim.PAPER, claim.STILL, AGENT, claim.STEPS) and not verdict.periods.is_open:
            middle_s = math.sqrt(low_s * high_s)
            nearest = min(own, key=lambda cell: abs(math.log(cell.period_s / middle_s)))
            shown.setdefault(nearest, f"{claim.PAPER}\nsame computation, ")
    still = {}
    for case in cases:
        labels: dict[str, Any] = dict(points[case.point].labels)
        if labels.pop("weather") == claim.STILL:
            still[Cell(**labels)] = case
    for cell, title in shown.items():
        yield f"{title}{1e3 * cell.period_s:g} ms", Setup.of(still[cell].scenario, still[cell].source)


def table_of(costs: Sequence[Curve], loads: Loads) -> Table:
    """The table people read, in `WIDTH` columns."""
    table = Table(box=None, title=TITLE, title_justify="left", title_style="bold", padding=(0, 1, 0, 0))
    for heading in ("weather", "controller", "horizon\nkept"):
        table.add_column(heading, no_wrap=True)
    times = ("CPU step\n(ms)", "agent\n(s/s)", "team\n(s/s)")
    for heading in ("T_s\n(ms)", "N_p", "done", *(heading for heading, *_ in _SHOWN), *times):
        table.add_column(heading, justify="right", no_wrap=True)
    before: tuple[str, ...] = ("", "", "")
    for curve in costs:
        for node in curve.nodes:
            cell = node.cell
            load = loads[cell.controller, cell.period_s, cell.horizon]
            named = (curve.weather, curve.controller, curve.kept)
            table.add_row(
                *(("",) * 3 if named == before else named),
                f"{1e3 * cell.period_s:g}",
                str(cell.horizon),
                f"{node.completed}/{node.flights}",
                *(
                    _cell(node.ratio(name) if over else node.numbers.get(name), factor, digits, interval=over)
                    for _, name, factor, digits, over in _SHOWN
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


def _row(curve: Curve, node: Node, loads: Loads) -> dict[str, Any]:
    cell = node.cell
    row: dict[str, Any] = {"weather": curve.weather, "controller": curve.controller, "kept": curve.kept}
    row |= {"period_s": cell.period_s, "horizon": cell.horizon, "flights": node.flights, "completed": node.completed}
    row["first_lost_s"] = min(node.lost_s, default=None)
    for name in NUMBERS[1:]:
        for value, column in ((node.numbers.get(name), name), (node.ratio(name), f"{name}_ratio")):
            row |= {column: value and value.mean, f"{column}_ci95": value and value.half_width}
    load = loads[cell.controller, cell.period_s, cell.horizon]
    for column, values in (
        ("cpu_step_ms", load.step_ms),
        ("cpu_agent_s_per_s", load.seconds_per_second(AGENT)),
        ("cpu_team_s_per_s", load.seconds_per_second(TEAM)),
    ):
        row |= {column: statistics.median(values), f"{column}_min": min(values), f"{column}_max": max(values)}
    return row


def _verdict(verdict: Verdict) -> dict[str, Any]:
    """A row of verdict.csv; an end beyond the grid is empty, a diverged run an infinite ratio."""
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
        "verdict": verdict.words,
        "claim": claimed if verdict.controller == claim.PAPER else "",
        "supported": verdict.supports(claimed) if verdict.controller == claim.PAPER else "",
    }


def _repetitions(loads: Sequence[Load]) -> Iterator[dict[str, Any]]:
    for load in loads:
        named = {name: value for name, value in asdict(load).items() if not name.endswith("step_ms")}
        ratios = zip(load.ratios(TEAM), load.ratios(AGENT), strict=True)
        for repetition, (team, agent) in enumerate(ratios):
            times = {"step_ms": load.step_ms[repetition], "reference_step_ms": load.reference_step_ms[repetition]}
            yield {**named, "repetition": repetition, **times, "team_ratio": team, "agent_ratio": agent}


def _csv(rows: Sequence[dict[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
