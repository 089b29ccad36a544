"""Report of a run folder: summary.json, steps.csv and figures from its log."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import orjson

from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.steps import steps_columns, steps_rows
from transport.analysis.summary_assembly import summarise
from transport.log.run_folder import RecordedRun, open_run
from transport.protocol.scenario.files.atomic_writing import write_csv, write_whole
from transport.protocol.scenario.setup.run_setup import Setup

# Kinds of files of figures.
_ENDINGS = ("png", "svg", "pdf")


def write_report(
    folder: Path, *, figures: bool = True, setup: Setup | None = None
) -> dict[str, Any]:
    """Write or replace the report of a recorded run as `report_run` does, without forks.

    The scenario is read from the folder unless the setup is given. Return the summary.

    Raises: LogError: there is no readable log; ScenarioError: the folder's scenario cannot be read.
    """
    return report_run(open_run(folder, horizons=False, setup=setup), figures=figures)


def report_run(
    run: RecordedRun, *, figures: bool = True, forks: bool = False, also: Collection[str] = ()
) -> dict[str, Any]:
    """Write or replace summary.json, steps.csv and the figures of a recorded run.

    Figures take most of the time; with `forks` on two cores half of it, beside the table of steps. They
    are PNG, and also "svg" or "pdf". Return the summary.
    """
    folder = run.folder
    analysed = AnalysedRun.of(run.setup, counted(run.setup, run.log))
    summary = summarise(analysed)
    content = orjson.dumps(summary, option=orjson.OPT_INDENT_2)
    write_whole(folder / "summary.json", content + b"\n")

    def write_steps() -> None:
        write_csv(folder / "steps.csv", steps_rows(analysed), steps_columns(analysed.setup))

    if not figures:
        write_steps()
    else:
        # Loads matplotlib, 0.3 s that runs without figures save.
        from transport.report.figures.run_figures import draw

        _remove_figures(folder / "figures")
        draw(analysed, folder / "figures", forks=forks, also=also, meanwhile=write_steps)
    return summary


def write_for_paper(run: RecordedRun, summary: Mapping[str, Any]) -> list[Path]:
    """Write the figures of a run for a paper and their captions to its folder paper/; return the files.

    A figure is a column wide (8.5 cm), as PDF and SVG, and as PNG.
    """
    from transport.report.figures.captions import captions, text_of
    from transport.report.figures.run_figures import draw

    folder = run.folder / "paper"
    _remove_figures(folder)
    analysed = AnalysedRun.of(run.setup, counted(run.setup, run.log))
    figures = draw(analysed, folder, also=("svg", "pdf"))
    made = captions(run.setup, summary, [file.stem for file in figures])
    folder.mkdir(exist_ok=True)
    write_whole(folder / "captions.md", text_of(made).encode())
    return [*figures, folder / "captions.md"]


def _remove_figures(folder: Path) -> None:
    """Remove the figures of an older report."""
    for ending in _ENDINGS:
        for file in list(folder.glob(f"*.{ending}")):
            file.unlink()
