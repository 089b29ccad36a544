"""Simulations behind the measured tables of documents, in memory."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from measured import Measured
from tables import ROOT, table

from transport.analysis.series import series_of
from transport.experiments.cases import Case, Point, cases_of_point
from transport.experiments.simulation import Result
from transport.experiments.statistics import estimate
from transport.log.run_log import RunLog
from transport.protocol.scenario.scenario_file import find_scenario
from transport.protocol.scenario.setup.run_setup import Setup


class Run(NamedTuple):
    """A scenario with changes, perhaps with a team of another size, simulated with the seeds 0, 1, ..."""

    scenario: str
    settings: tuple[str, ...] = ()
    uavs: int | None = None
    seeds: int = 1

    def point(self) -> Point:
        """Return the run as a point of a sweep."""
        team = (self.uavs, 1) if self.uavs else None
        return Point({}, self.scenario, self.settings, team=team, scenario=self.scenario)


# Results of a run, by seed. Their numbers: `transport.experiments.run_numbers.NUMBERS` and `more`.
Flown = Sequence[Result]
Cell = Callable[[Flown], str]


class Table(NamedTuple):
    """A table of a document; the name is that of its markers."""

    name: str
    first: Sequence[str]  # headings of a row's first cells
    # Runs of each row by its first cells.
    rows: Mapping[str | tuple[str, ...], Sequence[Run | None]]
    # The other cells, given the results of all runs of a row.
    columns: Mapping[str, Callable[..., str]]


def listed(name: str, first: str, rows: Mapping[str, Run], columns: Mapping[str, Cell]) -> Table:
    """Return a table with a run in each row."""
    return Table(name, [first], {text: [run] for text, run in rows.items()}, columns)


def grid(
    name: str,
    first: Sequence[str],
    others: Sequence[str],
    rows: Mapping[Any, Sequence[Run | None]],
    cell: Cell,
) -> Table:
    """Return a table with a run in each cell."""
    return Table(name, first, rows, {text: partial(_nth, i, cell) for i, text in enumerate(others)})


def _nth(index: int, cell: Cell, *results: Flown | None) -> str:
    found = results[index]
    return "" if found is None else cell(found)


def values(name: str, *results: Flown) -> list[float]:
    """Return a number of all completed runs that have it: airtime is one of runs with a radio."""
    numbers = [
        result.numbers.get(name)
        for flown in results
        for result in flown
        if result.outcome == "completed"
    ]
    return [number for number in numbers if number is not None]


def cell(
    name: str, form: str = "", factor: float = 1.0, of: Callable[..., Any] = np.mean
) -> Callable[..., str]:
    """Return a cell with a number of completed runs, "" without any.

    By default with three significant digits.
    """

    def text(*results: Flown) -> str:
        found = values(name, *results)
        number = factor * float(of(found)) if found else 0.0
        digits = form or np.format_float_positional(
            number, precision=3, fractional=False, unique=False, trim="k"
        )
        return digits.rstrip(".").format(number) if found else ""

    return text


def interval(name: str, digits: int, factor: float = 1.0) -> Callable[..., str]:
    """Return a cell with the mean of completed runs and half its 95 % interval, "" without any."""

    def text(*results: Flown) -> str:
        found = estimate([factor * value for value in values(name, *results)])
        return "" if found is None else found.text(digits)

    return text


def completed(*results: Flown) -> str:
    """Return how many of several runs are completed."""
    return f"{len(values('cost_mean', *results))} of {sum(map(len, results))}"


def outcome(flown: Flown) -> str:
    """Return whether a run completes, or how and when it ends."""
    result = flown[0]
    if result.outcome == "completed":
        return "completes"
    word = "diverges" if result.outcome == "diverged" else f"is {result.outcome}"
    return f"**{word}** at {result.numbers['lost_s']:.1f} s"


def unless_diverged(*cells: Cell) -> Cell:
    """Return a cell with several numbers of a run, or when it diverges."""

    def text(flown: Flown) -> str:
        if flown[0].outcome != "completed":
            return outcome(flown)
        return ", ".join(one(flown) for one in cells)

    return text


COST = cell("cost_mean")
ATTITUDE = cell("attitude_max_deg", "{:.1f} deg", of=np.max)

# Settings of several tables: impaired networks, errors of the model, the other engine.
LATE = ("links.delay_s=0.2", "links.loss=0.3")
IMPAIRED = ("links.delay_s=0.1", "links.loss=0.3")
ESTIMATE = "controller.disturbance.estimate=true"
HEAVIER = "plant.payload_mass_factor"
UNKNOWN_DRAG = "controller.knows_drag=false"
MUJOCO, CABLES = "plant.engine=mujoco", "plant.mujoco.suspension=cables"


def events(*given: tuple[float, str, str]) -> tuple[str, ...]:
    """Return the settings of faults, each with its time, action and target, after which the run goes on."""
    text = ",".join(f'{{at_s={at_s},do="{do}",target="{target}"}}' for at_s, do, target in given)
    return ("clock.on_agent_loss=continue", f"faults.event=[{text}]")


def measured(page: str, shown: Table) -> Measured:
    """Return a table of a page with its runs."""
    runs = list(dict.fromkeys(run for row in shown.rows.values() for run in row if run))
    cases = [case for i, run in enumerate(runs) for case in cases_of_run(i, run)]
    texts = [" ".join(runs[case.point].settings) or "as it is" for case in cases]
    names = [runs[case.point].scenario for case in cases]

    def text(results: Sequence[Result]) -> str:
        flown: dict[Run, list[Result]] = {run: [] for run in runs}
        for case, result in zip(cases, results, strict=True):
            flown[runs[case.point]].append(result)
        return _text(shown, flown)

    return Measured(
        name=shown.name,
        document=ROOT / "docs" / page,
        cases=cases,
        texts=[f"{name}: {words}" for name, words in zip(names, texts, strict=True)],
        text=text,
    )


def cases_of_run(index: int, run: Run) -> list[Case]:
    """Return the cases of a run, one for each seed."""
    path = find_scenario(run.scenario)
    return cases_of_point(index, run.point().read(), path, run.seeds, more=more)


def _text(shown: Table, found: Mapping[Run, Flown]) -> str:
    """Return a table in Markdown from the results of its runs."""
    lines = []
    for key, runs in shown.rows.items():
        first = [key] if isinstance(key, str) else [*key]
        results = [None if run is None else found[run] for run in runs]
        others = [text_of(*results) for text_of in shown.columns.values()]
        lines.append([*first, *others])
    return table([*shown.first, *shown.columns], lines)


def more(setup: Setup, summary: Any, log: RunLog) -> dict[str, float | None]:
    """Return further numbers of a run.

    The largest distance of a UAV from its reference at the last tick, and those of cables and
    distances from walls.
    """
    series = series_of(setup, log)
    return {
        "uav_last_m": float(np.linalg.norm(series.uav_errors_I[-1], axis=1).max()),
        **(summary["cables"] or {}),
        **(summary["clearance_min_m"] or {}),
    }
