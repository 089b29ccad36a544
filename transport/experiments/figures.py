"""Figures of an experiment as PNG, and as SVG for papers."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from transport.experiments.curve_figure import draw_curves, draw_sharing
from transport.experiments.declaration import Experiment
from transport.experiments.map_figure import draw_maps
from transport.experiments.scaling_figure import draw_scaling
from transport.experiments.statistics import PointStatistics
from transport.experiments.variants_figure import draw_variants
from transport.report.style import RC, save

_DRAWN_FROM_STATISTICS = {"scaling": draw_scaling, "variants": draw_variants}


def draw(experiment: Experiment, measured: Sequence[PointStatistics], folder: Path) -> list[Path]:
    """Draw an experiment to figure.png and figure.svg, which replace older ones; return these files."""
    with mpl.rc_context({**RC, "svg.hashsalt": experiment.name}):
        figure = Figure()
        fill(figure, experiment, measured)
        return save(figure, folder / "figure.png")


def fill(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw an experiment into an empty figure, in the style of `matplotlib.rcParams`."""
    if experiment.drawn_as in _DRAWN_FROM_STATISTICS:
        _DRAWN_FROM_STATISTICS[experiment.drawn_as](figure, measured)
    elif experiment.y is not None:
        draw_maps(figure, experiment.x, experiment.y, measured)
    elif experiment.drawn_as == "sharing":
        draw_sharing(figure, experiment, measured)
    else:
        draw_curves(figure, experiment, measured)
