"""Figures of an experiment as PNG, and as SVG for papers: curves, maps and variants."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from transport.experiments.declaration import Experiment
from transport.experiments.figures.axes_and_units import axis
from transport.experiments.figures.figure_arena import draw_arena
from transport.experiments.figures.figure_curves import draw_curves
from transport.experiments.figures.figure_maps import draw_maps
from transport.experiments.figures.figure_variants import draw_tracking, draw_variants
from transport.experiments.figures.figure_weather import draw_weather
from transport.experiments.statistics import PointStatistics
from transport.report.figures.style import RC, save


def draw(experiment: Experiment, measured: Sequence[PointStatistics], folder: Path) -> list[Path]:
    """Draw an experiment to figure.png and figure.svg, which replace older ones.

    Returns: These files.
    """
    with mpl.rc_context({**RC, "svg.hashsalt": experiment.name}):
        figure = Figure()
        fill(figure, experiment, measured)
        return save(figure, folder / "figure.png")


def fill(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw an experiment into an empty figure, in the style of `matplotlib.rcParams`."""
    scenarios: dict[str, list[PointStatistics]] = {}
    for statistics in measured:
        scenarios.setdefault(statistics.point.scenario, []).append(statistics)

    if experiment.drawn_as == "variants":
        draw_variants(figure, scenarios)
    elif experiment.drawn_as == "tracking":
        draw_tracking(figure, measured, axis(experiment.x), experiment.curves or "case")
    elif experiment.drawn_as == "weather":
        draw_weather(figure, scenarios)
    elif experiment.drawn_as == "arena":
        draw_arena(figure, measured)
    elif experiment.y:
        draw_maps(figure, axis(experiment.x), axis(experiment.y), axis(experiment.shown), scenarios)
    else:
        draw_curves(figure, experiment, scenarios)
