"""Figures as objects, whose files equal those of the report, and margins of a scenario."""

import io
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any, Unpack

import matplotlib as mpl
from matplotlib.figure import Figure

from transport.analysis.analysed_run import AnalysedRun
from transport.interface.scenario_builder import Scenario
from transport.interface.setting_arguments import ArgumentError, Settings, ShortSettings
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.run_figures import FIGURES, fill
from transport.report.figures.style import RC
from transport.report.laws import ACTUATIONS
from transport.report.margins import HoverMargins, draw, hover_margins, rows


class RunFigure(Figure):
    """A matplotlib figure in the style of the project.

    It belongs to no window, so nothing has to be closed.
    """

    def savefig(self, fname: Any, **options: Any) -> None:
        """Write the figure to a file, whose ending is the format, with options of matplotlib."""
        with mpl.rc_context(RC):
            super().savefig(fname, **options)

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows."""
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()


def drawn(draw: Callable[[RunFigure], Any]) -> RunFigure:
    """Return a figure that a function has drawn in the style of the project."""
    with mpl.rc_context(RC):
        figure = RunFigure()
        draw(figure)
    return figure


def run_figure(name: str, run: AnalysedRun) -> RunFigure:
    """Return a figure of the report of a run.

    Raises: ArgumentError: no such figure, or no data for it.
    """
    if name not in FIGURES:
        raise ArgumentError(f"figure: expected one of {', '.join(FIGURES)}, got {name!r}")

    with mpl.rc_context(RC):
        figure = RunFigure()
        if not len(run.series.ticks) or not fill(figure, name, run):
            raise ArgumentError(f"figure: expected a run with data for {name!r}, got one without")
    return figure


@dataclass(frozen=True)
class Margins:
    """Margins of the hover of a scenario, as `transport.margins` returns them.

    They are printed as a table.
    """

    found: HoverMargins  # SI units, factors relative to the known value

    @property
    def data(self) -> dict[str, Any]:
        """Margins by actuation and property, as plain values; None is beyond the searched range."""
        return asdict(self.found)

    def plot(self) -> RunFigure:
        """Return the ranges as a figure."""
        return drawn(lambda figure: draw(self.found, figure))

    def __str__(self) -> str:
        """Return the table of the ranges as text."""
        table = [("property", *ACTUATIONS), *rows(self.found)]
        lines = ["".join(f"{text:20s}" for text in row).rstrip() for row in table]
        return "\n".join(lines)


def margins(
    scenario: "str | PathLike[str] | Scenario" = "resilient",
    settings: Settings | None = None,
    *,
    without: Collection[int] = (),
    **short: Unpack[ShortSettings],
) -> Margins:
    """Return how far the plant may differ from the controllers' model with a stable hover.

    It is a linear analysis of the sampled loop about hover, without limits and constraints, and
    takes seconds. The agents in `without`, 1-based, are gone for good, and their UAVs follow the
    fail-safe; the team that is left holds the payload if all deviations decay (`settling_s`).
    Other arguments are those of `fly`.

    >>> import transport
    >>> lag_s = transport.margins("resilient").data["margins"]["immediate"]["lag_s"]
    >>> round(1e3 * lag_s["upper"])
    71

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is.
    """
    chosen = Scenario(scenario, settings, **short)
    setup = Setup.of(chosen.validated, str(chosen.file))
    return Margins(hover_margins(setup, without))
