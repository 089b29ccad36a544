"""Figure of several runs over one another: errors, attitude and cost."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.series import Series
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import (
    LINES,
    RC,
    line_width,
    looks_of,
    save,
    scale_cost,
    shade_phases,
)
from transport.report.run_comparison import ComparedRun

_COST_DECADES = 5  # that are shown
_PANELS = (
    "UAV error, largest (m)",
    "payload error (m)",
    "payload attitude, largest angle (deg)",
    "stage cost",
)
_HEIGHT_IN = 0.9
# Room above the first panel for its title and the names of the phases.
_ROOM = Room(top_in=0.3)
_WIDEST = 1.8  # curve, points
_LIGHT = 0.5  # share of white in the colour of a later curve of the same name


def draw_compared(runs: Sequence[ComparedRun], folder: Path) -> list[Path]:
    """Draw compare.png and compare.svg of runs, at least one of them with a tick, in a folder.

    Return the files.
    """
    shown = [(one.label, one.run.setup, one.series) for one in runs if len(one.series.ticks)]
    maneuvers = [setup.scenario.maneuver for _, setup, _ in shown]
    with mpl.rc_context(RC):
        figure = Figure()
        fill_overlaid(figure, shown, shaded=all(maneuver == maneuvers[0] for maneuver in maneuvers))
        return save(figure, folder / "compare.png")


def fill_overlaid(
    figure: Figure, runs: Sequence[tuple[str, Setup, Series]], *, shaded: bool
) -> None:
    """Draw runs over one another into an empty figure, perhaps with the phases of the first.

    Each run has its label, setup and series.
    """
    styles = _styles([label for label, _, _ in runs])
    legend = [Line2D([], [], **style) for style in styles]
    panels = column_panels(figure, [_HEIGHT_IN] * len(_PANELS), legend=legend, room=_ROOM)
    for (_, _, series), style in zip(runs, styles, strict=True):
        for panel, values in zip(panels, _curves(series), strict=True):
            panel.plot(series.times_s, values, **style)

    ends_s = [
        float(series.times_s[-1]) + setup.settings.sampling_period_s for _, setup, series in runs
    ]
    until_s = max(ends_s)
    for panel, title in zip(panels, _PANELS, strict=True):
        head(panel, title, legend=False)
        panel.set_xlim(0.0, until_s)
        panel.set_ylim(bottom=0.0)

    largest_cost = max(float(np.nanmax(series.cost)) for _, _, series in runs)
    scale_cost(panels[-1], largest_cost, _COST_DECADES)
    if shaded:
        shade_phases(runs[0][1], panels, until_s)


def _styles(labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the styles of curves with labels, which stay visible where they coincide.

    Labels that begin with the same name, up to a comma, have one colour, lighter for the later ones.
    """
    names = [label.partition(",")[0] for label in labels]
    looks = looks_of(list(dict.fromkeys(names)))
    styles: list[dict[str, Any]] = []
    for i, (label, name) in enumerate(zip(labels, names, strict=True)):
        colour = looks[name].colour
        dashes = looks[name].line
        if name in names[:i]:
            red, green, blue = (_LIGHT + (1.0 - _LIGHT) * part for part in to_rgb(colour))
            colour = to_hex((red, green, blue))
            dashes = LINES[i % len(LINES)]
        width = line_width(i, len(labels), _WIDEST)
        styles.append({"color": colour, "linestyle": dashes, "linewidth": width, "label": label})
    return styles


def _curves(series: Series) -> tuple[Array, Array, Array, Array]:
    """Return the curves of `_PANELS`, without released UAVs and costs of zero, (T,) each."""
    errors_m = np.linalg.norm(series.uav_errors_I, axis=2)
    return (
        np.where(series.on_rods, errors_m, 0.0).max(axis=1),
        series.payload_error_norm_m,
        series.attitude_max_deg,
        np.where(series.cost > 0.0, series.cost, np.nan),
    )
