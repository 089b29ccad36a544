"""Report of the comparison: measures processor time, simulates, and writes tables and ranges."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from transport.experiments.cases import Case, cases_of
from transport.experiments.declaration import Experiment
from transport.experiments.paper import controllers_and_periods
from transport.experiments.paper.comparison_curves import ComparisonCurve, curves_of
from transport.experiments.paper.comparison_figures import draw_costs, draw_maneuver
from transport.experiments.paper.controllers_and_periods import CENTRALIZED, Cell
from transport.experiments.paper.equal_rate_and_computation import ranges, sentence
from transport.experiments.result_tables import SPREAD, Column, console_table, write_markdown
from transport.experiments.run_numbers import resource_use
from transport.experiments.simulation import simulate as simulate_here
from transport.experiments.statistics import COST_RATIO
from transport.experiments.sweep import Results, Simulate, Swept, sweep
from transport.protocol.scenario.files.atomic_writing import write_csv
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario

TITLE = f"paper: means of completed runs; ratio to centralized, taken seed by seed, {SPREAD}"

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
        allow_large: Whether runs may exceed the limits.
    """

    settings: Sequence[str]
    seeds: int
    gust_mps: float
    quick: bool = False
    allow_large: bool = False

    def reference(self) -> Cell:
        """Return the centralized controller at the period of its scenario.

        Raises: ScenarioError: wrong settings.
        """
        path = find_scenario(controllers_and_periods.SCENARIOS[CENTRALIZED])
        scenario = read_scenario(path, self.settings, allow_large=self.allow_large)
        agents = len(scenario.owned)
        if agents > 1:
            expected = f"expected one agent that owns all, got {agents}"
            raise ScenarioError(str(path), "agents.owned", expected)

        controller = scenario.controller
        return Cell(CENTRALIZED, controller.sampling_period_s, controller.horizon)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonPlan:
    """Runs of the comparison.

    Attributes:
        reference: The centralized controller at the period of its scenario.
        cells: Cells by controller and kept horizon.
        measurement: Sweep whose runs are timed, one at a time.
        timed: Its runs.
        experiment: Sweep whose runs give the costs.
        cases: Its runs.
    """

    reference: Cell
    cells: Mapping[tuple[str, str], Sequence[Cell]]
    measurement: Experiment
    timed: Sequence[Case]
    experiment: Experiment
    cases: Sequence[Case]


def plan(options: ComparisonOptions, *, simulated_before: bool = False) -> ComparisonPlan:
    """Return the runs of the comparison, as `cases_of`.

    Raises: ScenarioError: wrong settings.
    """
    reference = options.reference()
    cells = controllers_and_periods.cells_of(reference, quick=options.quick)
    distinct = _distinct(cells.values())
    experiment = controllers_and_periods.experiment(distinct, options.gust_mps)

    # The points in still air, which `comparison.experiment` lists first.
    measurement = Experiment(name="processor time", points=experiment.points[: len(distinct)])
    maneuver = (
        controllers_and_periods.QUICK_MEASUREMENT
        if options.quick
        else controllers_and_periods.MANEUVER
    )
    repeats = (
        controllers_and_periods.QUICK_REPEATS if options.quick else controllers_and_periods.REPEATS
    )
    cases = partial(cases_of, simulated_before=simulated_before, allow_large=options.allow_large)
    return ComparisonPlan(
        reference=reference,
        cells=cells,
        measurement=measurement,
        timed=cases(measurement.points, [*options.settings, maneuver], repeats, more=resource_use),
        experiment=experiment,
        cases=cases(experiment.points, options.settings, options.seeds),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Results of the comparison: its curves, and the rows of its tables."""

    curves: Sequence[ComparisonCurve]
    curve_rows: Sequence[controllers_and_periods.Row]
    range_rows: Sequence[controllers_and_periods.Row]

    @property
    def sentences(self) -> list[str]:
        """Ranges of periods and costs at equal rate and computation, one sentence each."""
        return list(map(sentence, self.range_rows))

    @property
    def table(self) -> Table:
        """Table for the console."""
        return console_table(TITLE, _LABELS, _COLUMNS, self.curve_rows)


def compared(planned: ComparisonPlan, timed: Swept, swept: Swept) -> Compared:
    """Return curves and ranges of the measured runs and of those that give the costs.

    Raises: ExperimentError: a run raised an error, or the reference diverged.
    """
    curves = curves_of(planned.cells, timed, swept, planned.reference)
    return Compared(
        curves=curves,
        curve_rows=[row for curve in curves for row in curve.rows()],
        range_rows=list(ranges(curves, planned.reference)),
    )


def draw(result: Compared, planned: ComparisonPlan, swept: Swept, folder: Path) -> list[Path]:
    """Draw costs over processor time, and the maneuvers over one another; return the files."""
    return [
        *draw_costs(result.curves, planned.reference, folder),
        *draw_maneuver(result.curves, planned.reference, swept, folder),
    ]


def compare(
    options: ComparisonOptions, folder: Path, simulate: Simulate, console: Console
) -> tuple[list[str], Table]:
    """Measure processor time, simulate every controller at every period, and write all files.

    Returns: Lines for the console, and the table above them.
    Raises: ScenarioError: wrong settings. ExperimentError: unusable folder, or a run that raised an
        error.
    """
    planned = plan(options)
    # The timed runs one at a time, all controllers in turns: a slow period of the machine affects
    # all alike.
    alone = partial(map, simulate_here)
    with Results(controllers_and_periods.NAME, folder) as results:
        timed = sweep(planned.measurement, planned.timed, alone, results, console)
        timed.check()
        swept = sweep(planned.experiment, planned.cases, simulate, results, console)

    result = compared(planned, timed, swept)
    files = [
        timed.write_cases(folder / "computation.csv"),
        swept.write_cases(folder / "cases.csv"),
        _written(folder / "curves.csv", result.curve_rows),
        _written(folder / "ranges.csv", result.range_rows),
        *draw(result, planned, swept, folder),
    ]
    return write_markdown(folder, result.sentences, result.table, files), result.table


def _distinct(cells: Iterable[Sequence[Cell]]) -> list[Cell]:
    """Return the cells of all curves once, as curves meet at the reference."""
    return list(dict.fromkeys(cell for own in cells for cell in own))


def _written(path: Path, rows: Sequence[controllers_and_periods.Row]) -> Path:
    """Write a table with the columns of its first row; return its path."""
    write_csv(path, rows, list(rows[0]))
    return path
