"""The figure of an experiment: figure.png to look at, figure.svg for a paper."""

from collections.abc import Sequence
from pathlib import Path

from transport.experiments.catalogue import Experiment
from transport.experiments.curves import draw_curves
from transport.experiments.growth_figure import draw_growth
from transport.experiments.maps import draw_maps
from transport.experiments.statistics import Measured
from transport.experiments.tradeoff_figure import draw_tradeoff
from transport.experiments.variants_figure import draw_variants
from transport.report.style import RC, save


def draw(experiment: Experiment, measured: Sequence[Measured], folder: Path) -> list[Path]:
    """Draw an experiment.

    Args:
        experiment: What was flown.
        measured: What came of each point.
        folder: Where to; older figures are replaced.
    Returns: The files.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**RC, "svg.hashsalt": experiment.name}):
        figure = Figure(layout="constrained")
        if experiment.drawn_as == "growth":
            draw_growth(figure, measured)
        elif experiment.drawn_as == "variants":
            draw_variants(figure, measured)
        elif experiment.drawn_as == "tradeoff":
            draw_tradeoff(figure, measured)
        elif experiment.y is not None:
            draw_maps(figure, experiment.x, experiment.y, measured)
        else:
            draw_curves(figure, experiment, measured)
        return [save(figure, folder / f"figure.{kind}") for kind in ("png", "svg")]
