"""`transport experiment paper` from its options to its folder: measure, fly, compare, and say what came of it."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from protocol.setup import Setup
from transport.experiments import claim, claim_figure
from transport.experiments.cases import Case, Point, cases_of, is_random
from transport.experiments.claim import Compared
from transport.experiments.computation import Load
from transport.experiments.effort import EFFORT
from transport.experiments.errors import ExperimentError
from transport.experiments.flight import NUMBERS, Result
from transport.experiments.results import Results
from transport.experiments.statistics import Estimate
from transport.experiments.sweep import Fly, sweep
from transport.experiments.table import cases_csv
from transport.report import write_whole
from transport.run import machine

WIDTH = 130
TITLE = "paper: means of completed flights, ± 95 % confidence; over the centralized flight in the same wind"

# Columns that people read: heading, number, factor, digits, whether it is over the centralized controller's. Only that
# has its confidence interval: seed by seed it is of the controllers, the others' are of the wind.
_SHOWN = (
    ("cost\n(1e-3)", "cost_mean", 1e3, 3, False),
    ("cost over\ncentralized", "cost_mean", 1.0, 3, True),
    ("peak\n(1e-3)", "cost_max", 1e3, 1, False),
    ("peak over\ncentralized", "cost_max", 1.0, 3, True),
    ("attitude\n(deg)", "attitude_max_deg", 1.0, 2, False),
    ("error\n(mm)", "payload_rms_m", 1e3, 1, False),
    ("CPU step\n(ms)", "cpu_step_p50_ms", 1.0, 2, False),
    ("team\n(s/s)", "cpu_team_s_per_s", 1.0, 2, False),
)


def conduct(
    settings: Sequence[str],
    seeds: int,
    gust_mps: float,
    folder: Path,
    fly: Fly,
    console: Console,
    *,
    quick: bool = False,
) -> tuple[list[str], Table, list[Result]]:
    """Measure computation, choose the rates, fly all, write everything there is to read.

    Args:
        settings: Changes of every scenario.
        seeds: Flights of each row in gusts.
        gust_mps: Their standard deviation; without, only still air is flown.
        folder: Of the experiment.
        fly: Gives the results of cases.
        console: For progress.
        quick: Measure computation once, on the shortest of flights: a trial.
    Returns: Lines for people, a table to go above them, and the results.
    Raises: ScenarioError: settings that cannot be. ExperimentError: a folder that cannot be.
    """
    reference = claim.reference_of(settings)
    first = reference.settings
    # Whatever cannot be flown is refused before anything is measured.
    same_rate = claim.rows(first.sampling_period_s, first.horizon, [])
    _cases(claim.experiment(same_rate, gust_mps).points, settings, seeds)
    with Results(folder, claim.NAME, machine()) as results:
        for notice in results.notices:
            console.print(notice, highlight=False, soft_wrap=True)

        def notify(line: str) -> None:
            console.print(line, highlight=False, soft_wrap=True)

        loads = claim.computation(folder, settings, reference, quick=quick, notify=notify)
        experiment = claim.experiment(claim.rows(first.sampling_period_s, first.horizon, loads), gust_mps)
        cases = _cases(experiment.points, settings, seeds)
        try:
            found = sweep(experiment, cases, fly, results, console)
        except (KeyboardInterrupt, ExperimentError):
            done = sum(results.done(case.key) for case in cases)
            notify(f"{done} of {len(cases)} flights are kept; go on with: --out {folder}")
            raise
    compared = claim.compare(experiment.points, cases, found)
    words = claim.verdict(compared)
    written = {
        "comparison.csv": _csv([_row(c) for c in compared]),
        "cases.csv": cases_csv(experiment.points, cases, found, (*NUMBERS, *EFFORT)),
        "computation.csv": _csv([_load(load) for load in loads]),
        "verdict.txt": "\n".join([*words, "", f"machine: {machine()}", ""]).encode(),
    }
    for name, content in written.items():
        write_whole(folder / name, content)
    shown = {point.text: case for point, case in _shown(experiment.points, cases)}
    flights = [(text, Setup.of(case.scenario, case.source)) for text, case in shown.items()]
    files = [*(folder / name for name in written), *claim_figure.draw(flights, folder)]
    lines = ["", *words, "", f"machine: {machine()}", *(f" {path}" for path in files)]
    return lines, table_of(compared), found


def _cases(points: Sequence[Point], settings: Sequence[str], seeds: int) -> list[Case]:
    """The flights; where chance plays no part one is enough, though its computation is measured."""
    cases = cases_of(points, settings, seeds, timed=True)
    return [case for case in cases if case.scenario.seed == 0 or is_random(case.scenario)]


def _shown(points: Sequence[Point], cases: Sequence[Case]) -> Iterator[tuple[Point, Case]]:
    """The flights of the paper's figures 3, 5 and 6: in still air, and of those with as many steps.

    Of the same computation that on one processor, or where there is no such rate, that of each.
    """
    budgets = {point.labels["budget"] for point in points if point.labels["controller"] == claim.AS_PRINTED}
    other = claim.ONE_EACH if claim.ONE_PROCESSOR in budgets else claim.ONE_PROCESSOR
    for case in cases:
        labels = points[case.point].labels
        as_printed = labels["controller"] in (claim.CENTRALIZED, claim.AS_PRINTED) and labels["kept"] == claim.STEPS
        if as_printed and labels["weather"] == claim.STILL and labels["budget"] != other:
            yield points[case.point], case


def table_of(compared: Sequence[Compared]) -> Table:
    """What a person reads, in `WIDTH` columns."""
    table = Table(box=None, title=TITLE, title_justify="left", title_style="bold", padding=(0, 1, 0, 0))
    for heading in ("weather", "controller", "computation"):
        table.add_column(heading, no_wrap=True)
    for heading in ("T_s\n(ms)", "N_p", "done", *(heading for heading, *_ in _SHOWN)):
        table.add_column(heading, justify="right", no_wrap=True)
    before = ""
    for c in compared:
        row = c.row
        cells = [
            _cell((c.ratios if over else c.numbers).get(name), factor, digits, interval=over)
            for _, name, factor, digits, over in _SHOWN
        ]
        weather, before = "" if c.weather == before else c.weather, c.weather
        rate = (f"{1e3 * row.period_s:g}", str(row.horizon))
        table.add_row(weather, row.controller, row.budget, *rate, f"{c.completed}/{c.flights}", *cells)
    return table


def _cell(value: Estimate | None, factor: float, digits: int, *, interval: bool) -> str:
    if value is None:
        return "-"
    text = f"{factor * value.mean:.{digits}f}"
    return f"{text} ±{factor * value.half_width:.{digits}f}" if interval and value.half_width else text


def _row(c: Compared) -> dict[str, Any]:
    row: dict[str, Any] = {"weather": c.weather, **asdict(c.row), "flights": c.flights, "completed": c.completed}
    row["first_lost_s"] = min(c.lost_s, default=None)
    row["judged"] = claim.judged(c)
    for name in (*NUMBERS[1:], *EFFORT, "cpu_team_s_per_s"):
        for values, what in ((c.numbers, name), (c.ratios, f"{name}_ratio")):
            value = values.get(name)
            row |= {what: value and value.mean, f"{what}_ci95": value and value.half_width}
    return row


def _load(load: Load) -> dict[str, Any]:
    return {**asdict(load), "one_processor": load.one_processor}


def _csv(rows: Sequence[dict[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
