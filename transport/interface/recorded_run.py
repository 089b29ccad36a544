"""A simulated or recorded run: summary, series, tables, figures, viewer, run folder."""

import shutil
from contextlib import closing
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.steps import steps_rows
from transport.analysis.summary_assembly import summarise
from transport.flight.run_files import create
from transport.interface.run_series import RunSeries
from transport.interface.scenario_builder import Scenario
from transport.interface.setting_arguments import ArgumentError, import_pandas, printed
from transport.log.run_log import RunLog
from transport.log.writer import LogWriter
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.report import write_report
from transport.report.summary_table import summary_table

if TYPE_CHECKING:
    import pandas as pd

    from transport.interface.figure import RunFigure
    from transport.interface.viewing import RunViewer

FigureName = Literal[
    "performance", "inputs", "trajectories", "timing", "estimate", "delays", "radio"
]
TableName = Literal["series", "steps"]

_WIDTH = 100  # of the printed summary, characters


class Run:
    """A run: its scenario, its messages, and what follows from them.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0, 0, 0]}]
    >>> run = transport.fly("paper", phases=hover)
    >>> run.completed, run.summary["ticks"], run.series["payload_position_m"].shape
    (True, 10, (10, 3))

    `scenario` is the one that was simulated, `log` has all messages, `folder` is None for a run
    without run folder.
    """

    def __init__(
        self, scenario: Scenario, setup: Setup, log: RunLog, folder: Path | None = None
    ) -> None:
        self.scenario = scenario
        self.log = log
        self.folder = folder
        self._setup = setup

    @cached_property
    def _analysed(self) -> AnalysedRun:
        """The run as a report reads it; summary, series, tables and figures share it."""
        return AnalysedRun.of(self._setup, counted(self._setup, self.log))

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json: outcome, cost, tracking, faults, ... (docs/reference/summary.md)."""
        return summarise(self._analysed)

    @cached_property
    def series(self) -> RunSeries:
        """Time series: read-only arrays by name, with units."""
        return RunSeries(self._analysed)

    @property
    def outcome(self) -> str:
        """The end of the run: completed, failed, diverged, aborted.

        It is unknown for a log without its end.
        """
        return str(self.summary["outcome"])

    @property
    def completed(self) -> bool:
        """Whether the run reached the end of the maneuver."""
        return self.outcome == "completed"

    def __repr__(self) -> str:
        parts = [self.outcome, f"{self.summary['sim_time_s']:.2f} s"]
        cost = self.summary["cost"]["mean"]
        if cost is not None:
            parts.append(f"mean cost {cost:.3g}")

        attitude_deg = self.summary["attitude_max_deg"]
        if attitude_deg is not None:
            parts.append(f"payload attitude max {attitude_deg:.2f} deg")
        return f"Run({self.summary['scenario']!r}: {', '.join(parts)})"

    def __str__(self) -> str:
        """Return the table that `transport run` prints."""
        return printed(summary_table(self.summary), _WIDTH)

    def to_pandas(self, table: TableName = "series") -> "pd.DataFrame":
        """Return a table of the run.

        "series" has a row per tick, "steps" one per agent and tick, as steps.csv (docs/reference/summary.md).
        Columns of "series" are those of `RunSeries.columns`, with time as index. Needs the extra
        `pandas`.

        Raises: ArgumentError: no such table, or pandas is missing.
        """
        pd = import_pandas()
        if table not in ("series", "steps"):
            raise ArgumentError(f"table: expected 'series' or 'steps', got {table!r}")

        if table == "steps":
            return pd.DataFrame(list(steps_rows(self._analysed)))
        return pd.DataFrame(self.series.columns()).set_index("time_s")

    def plot(self, figure: FigureName = "performance") -> "RunFigure":
        """Return a figure of the report, of matplotlib.

        A notebook shows it, `savefig("name.png")` writes it.

        Raises: ArgumentError: no such figure, or a run without data for it.
        """
        # Loads matplotlib, 0.5 s that runs without figures save.
        from transport.interface.figure import run_figure

        return run_figure(figure, self._analysed)

    def view(self, host: str = "127.0.0.1", port: int = 8080) -> "RunViewer":
        """Show the run in the browser until the viewer is closed.

        Raises: ViewerError: viser is not installed (extra `view`).
        """
        # Loads the viewer, which other uses do not need.
        from transport.interface.viewing import RunViewer

        return RunViewer(self._setup, self.log, host, port)

    def save(self, folder: "str | PathLike[str]", *, figures: bool = True) -> Path:
        """Write the run folder that `transport run` writes; return its path.

        Raises: RunError, or OSError for a recorded run: the folder exists or cannot be created.
            LogError: no log is written.
        """
        target = Path(folder)
        if self.folder is not None:
            return Path(shutil.copytree(self.folder, target))

        create(target, self._setup)
        period_ns = self._setup.period_ns
        log_writer = LogWriter(target / "run.mcap", self.log.header, period_ns=period_ns)
        with closing(log_writer) as writer:
            for entry in self.log.messages:
                writer.write(entry.message, entry.received_ns)

        write_report(target, figures=figures)
        self.folder = target
        return target
