"""Figures of a run: performance, inputs, trajectories, timing, estimate, delays and radio."""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from io import BytesIO
from multiprocessing import get_context
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.analysis.analysed_run import AnalysedRun
from transport.report.figures.column import column_panels
from transport.report.figures.delays_figure import draw_delays
from transport.report.figures.estimate_figure import draw_estimate
from transport.report.figures.event_marks import finish, marks_of
from transport.report.figures.figures_3d import draw_trajectories
from transport.report.figures.inputs_figure import draw_inputs
from transport.report.figures.performance_figure import draw_performance
from transport.report.figures.radio_figure import draw_radio
from transport.report.figures.style import RC, save
from transport.report.figures.timing_figure import draw_timing

# Names of the figures of a run.
FIGURES = ("performance", "inputs", "trajectories", "timing", "estimate", "delays", "radio")
# Those that a forked process draws: half of the work, beside the others and the table of steps.
_BESIDE = ("inputs", "timing", "delays")

_OVER_TIME: dict[str, Callable[..., list[Axes]]] = {
    "performance": draw_performance,
    "inputs": draw_inputs,
    "estimate": draw_estimate,
    "delays": draw_delays,
    "radio": draw_radio,
}


def draw(
    run: AnalysedRun,
    folder: Path,
    *,
    forks: bool = False,
    also: Collection[str] = (),
    meanwhile: Callable[[], None] = lambda: None,
) -> list[Path]:
    """Draw `FIGURES` of a run as PNG, and also as "svg" or "pdf", as far as its log goes.

    With `forks`, which only processes of one thread may do, a forked process draws half of them, and
    `meanwhile` is called beside it. The folder has no figures before.

    Returns: The PNG files, without those that have no data. Raises: ChildProcessError: the forked
        process failed.
    """
    if not len(run.series.ticks):
        meanwhile()
        return []

    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(RC):
        if not forks:
            meanwhile()
            return _write(run, FIGURES, folder, also)

        arguments = (run, _BESIDE, folder, also)
        process = get_context("fork").Process(target=_write, args=arguments, daemon=True)
        process.start()
        meanwhile()
        _write(run, [name for name in FIGURES if name not in _BESIDE], folder, also)
        process.join()
    if process.exitcode:
        raise ChildProcessError(
            f"a forked process of the report failed (exit status {process.exitcode})"
        )
    return [file for name in FIGURES if (file := folder / f"{name}.png").exists()]


def _write(
    run: AnalysedRun, names: Sequence[str], folder: Path, also: Collection[str]
) -> list[Path]:  # given to a process
    """Write some figures that have data; return their PNG files."""
    files = []
    for name in names:
        figure = Figure()
        if fill(figure, name, run):
            files.append(save(figure, folder / f"{name}.png", also)[0])
    return files


def warm_up() -> None:
    """Draw text once: fonts are found and read, a tenth of a second that the first figure saves."""
    with mpl.rc_context(RC):
        figure = Figure()
        figure.subplots().set_yscale("log")
        figure.savefig(BytesIO(), format="png")


def fill(figure: Figure, name: str, run: AnalysedRun) -> bool:
    """Draw one of `FIGURES` of a run with at least one tick into an empty figure.

    Figure and drawing take the style from `matplotlib.rcParams`: call it within `rc_context(RC)`.
    Return whether there is any data.
    """
    setup = run.setup
    series = run.series
    if name == "trajectories":
        draw_trajectories(figure, setup, series)
        return True
    if name == "timing":
        return draw_timing(figure, setup, run.log)

    marks = marks_of(setup, run.log)
    panels_of = partial(column_panels, figure, marks=marks)
    panels = _OVER_TIME[name](setup, run.log, series, panels_of)
    if panels:
        end_s = float(series.times_s[-1]) + setup.settings.sampling_period_s
        finish(figure, panels, setup, end_s, marks)
    return bool(panels)
