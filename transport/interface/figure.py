"""Figures as objects: a notebook shows them, and their files equal those of the report."""

import io
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from protocol.scenario.setup import Setup
from transport.analysis.series import Series
from transport.interface.settings import ArgumentError
from transport.log.run_log import RunLog
from transport.report.figures import CROPPED, FIGURES, fill
from transport.report.style import RC, drawing_box


class RunFigure(Figure):
    """A matplotlib figure in the style of the project; it belongs to no window, so nothing has to be closed."""

    cropped: bool = False  # whether files are cut to the drawing

    def savefig(self, fname: Any, **options: Any) -> None:
        """Write the figure to a file, whose ending is the format, with the options of matplotlib."""
        with mpl.rc_context(RC):
            if self.cropped:
                options = {"bbox_inches": drawing_box(self), **options}
            super().savefig(fname, **options)

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()


def drawn(draw: Callable[[RunFigure], Any], *, cropped: bool = False) -> RunFigure:
    """Return a figure that a function has drawn in the style of the project."""
    with mpl.rc_context(RC):
        figure = RunFigure()
        draw(figure)
    figure.cropped = cropped
    return figure


def run_figure(name: str, setup: Setup, log: RunLog, series: Series) -> RunFigure:
    """Return a figure of the report of a run.

    Raises: ArgumentError: no such figure, or a run without data for it.
    """
    if name not in FIGURES:
        raise ArgumentError(f"figure: expected one of {', '.join(FIGURES)}, got {name!r}")

    def draw(figure: RunFigure) -> None:
        if not len(series.ticks) or not fill(figure, name, setup, log, series):
            raise ArgumentError(f"figure: expected a run with data for {name!r}, got one without")

    return drawn(draw, cropped=name in CROPPED)
