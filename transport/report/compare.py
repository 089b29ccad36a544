"""Comparison of recorded runs: table of quantities, differences from the first run, caveats, and figure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from model.arrays import Array
from protocol.scenario.setup import Setup
from transport.analysis.metrics import summarise
from transport.analysis.series import SWING_S, Series, counted, series_of
from transport.log.run_folder import RecordedRun
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.report import HELD
from transport.report.style import CURVES, RC, line_width, save, scale_cost, shade_phases

Summary = dict[str, Any]

# Shown decades of the cost.
_COST_DECADES = 5
_PANELS = (
    "largest UAV position error (m)",
    "payload position error (m)",
    "payload attitude, largest angle (deg)",
    "stage cost",
)
_HEIGHT_IN = 0.9
# Room above the first panel for its title and the names of the phases.
_ABOVE_IN = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One of the compared runs: its label in tables and figures, its summary (docs/summary.md) and its series."""

    label: str
    run: RecordedRun
    summary: Summary
    series: Series

    @staticmethod
    def of(label: str, run: RecordedRun) -> "Compared":
        """Return a run with its summary and series."""
        log = counted(run.setup, run.log)
        return Compared(label=label, run=run, summary=summarise(run.setup, log), series=series_of(run.setup, log))


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One quantity of all runs.

    Attributes:
        name: Quantity.
        unit: Its unit, empty for none.
        values: Value of each run; None if its log does not tell.
        percent: Difference from the first run, %; None if not defined.
    """

    name: str
    unit: str
    values: tuple[float | str | None, ...]
    percent: tuple[float | None, ...]


def _lost_percent(summary: Summary) -> float | None:
    messages = summary["messages"]
    return 100.0 * messages["lost"] / messages["sent"] if messages["sent"] else None


def _exceeded_percent(summary: Summary) -> float | None:
    share = summary["constraint_violation_max"]
    return None if share is None else 0.0 if share < HELD else 100.0 * share


def _decays(summary: Summary) -> str | None:
    decays = summary["payload_tracking"]["decays"]
    return None if decays is None else "yes" if decays else "no"


def _missed_percent(summary: Summary) -> float | None:
    share = summary["deadline"]["share"]
    return None if share is None else 100.0 * share


# Compared quantities: name, unit, dotted key or function of a summary (docs/summary.md).
_QUANTITIES: tuple[tuple[str, str, str | Callable[[Summary], Any]], ...] = (
    ("scenario", "", "scenario"),
    ("outcome", "", "outcome"),
    ("simulated time", "s", "sim_time_s"),
    ("cost, mean", "", "cost.mean"),
    ("cost, max", "", "cost.max"),
    ("cost, max after hover", "", "cost.max_after_hover"),
    ("payload attitude, max", "deg", "attitude_max_deg"),
    ("UAV error, rms", "m", "uav_tracking.rms_m"),
    ("UAV error, max", "m", "uav_tracking.max_m"),
    ("payload error, rms", "m", "payload_tracking.rms_m"),
    ("payload error, max", "m", "payload_tracking.max_m"),
    (f"payload error, max of last {SWING_S:g} s", "m", "payload_tracking.swing_m"),
    ("payload swing decays", "", _decays),
    ("separation, min", "m", "separation_min_m"),
    ("limits exceeded, max", "%", _exceeded_percent),
    ("agent step, median", "ms", "agent_step_ms.p50"),
    ("agent step, p99", "ms", "agent_step_ms.p99"),
    ("rest of tick, median", "ms", "rest_of_tick_ms.p50"),
    ("real-time factor", "", "real_time_factor"),
    ("deadlines missed", "%", _missed_percent),
    ("plan age, mean", "ticks", "plan_age_ticks.mean"),
    ("plan age, max", "ticks", "plan_age_ticks.max"),
    ("plans lost", "%", _lost_percent),
    ("messages rejected", "", "messages.rejected"),
    ("solver fallbacks", "", "solver.fallbacks"),
    ("solver failures", "", "solver.failures"),
    ("faults and changes", "", lambda summary: len(summary["faults"])),
)


def _value(summary: Summary, value_of: str | Callable[[Summary], Any]) -> Any:
    return reduce(getitem, value_of.split("."), summary) if isinstance(value_of, str) else value_of(summary)


def rows(runs: Sequence[Compared]) -> list[Row]:
    """Return a row for each quantity that any of the runs has; at least one run."""
    table = []
    for name, unit, value_of in _QUANTITIES:
        values = tuple(_value(one.summary, value_of) for one in runs)
        if any(value is not None for value in values):
            percent = tuple(_difference_percent(value, values[0]) for value in values)
            table.append(Row(name=name, unit=unit, values=values, percent=percent))
    return table


def doubts(runs: Sequence[Compared]) -> Iterator[str]:
    """Yield the caveats of a comparison, a sentence each."""
    first = runs[0]
    scenario = first.run.setup.scenario
    for other in runs[1:]:
        differs, settings = other.run.setup.scenario, other.run.setup.settings
        if differs.maneuver != scenario.maneuver:
            yield (
                f"{other.label} follows another maneuver than {first.label}: "
                "each error is relative to the run's own reference; "
                "cost, attitude and position errors do not show which controller is better"
            )
        if differs.system != scenario.system:
            yield f"{other.label} has another system than {first.label} (UAVs or payload): costs are not comparable"
        if settings.weights != first.run.setup.settings.weights or settings.cost != first.run.setup.settings.cost:
            yield f"{other.label} has other weights than {first.label}: costs are not comparable"
        if other.summary["machine"] != first.summary["machine"]:
            yield f"{other.label} ran on another machine than {first.label}: times do not only depend on the controller"
    for compared in runs:
        ticks, planned = compared.summary["ticks"], compared.run.setup.ticks
        if ticks < planned:
            period_s = compared.run.setup.settings.sampling_period_s
            yield (
                f"{compared.label}: the log holds {ticks * period_s:.2f} of {planned * period_s:.2f} s "
                f"({compared.summary['reason'] or compared.summary['outcome']}); means are over this time"
            )
        if compared.run.log.cut:
            yield f"{compared.label}: {compared.run.log.cut}"


def _difference_percent(value: Any, first: Any) -> float | None:
    """Return the difference from the first value, %; None for texts, missing values and a first value of 0."""
    if isinstance(value, str) or isinstance(first, str) or value is None or not first:
        return None
    return float(100.0 * (value - first) / abs(first))


class Overlaid(NamedTuple):
    """A run in the figure."""

    label: str
    setup: Setup
    series: Series  # at least one tick


def draw_compared(runs: Sequence[Compared], folder: Path) -> list[Path]:
    """Draw compare.png and compare.svg of runs, at least one of them with a tick, in a folder; return the files."""
    shown = [compared for compared in runs if len(compared.series.ticks)]
    with mpl.rc_context(RC):
        figure = Figure()
        overlaid = [Overlaid(compared.label, compared.run.setup, compared.series) for compared in shown]
        maneuver = shown[0].run.setup.scenario.maneuver
        same = all(compared.run.setup.scenario.maneuver == maneuver for compared in shown)
        fill_overlaid(figure, overlaid, shaded=same)
        return save(figure, folder / "compare.png")


def fill_overlaid(figure: Figure, runs: Sequence[Overlaid], *, shaded: bool) -> None:
    """Draw runs over one another into an empty figure, perhaps with the phases of the first."""
    styles: list[dict[str, Any]] = [
        {"color": colour, "linestyle": line, "linewidth": line_width(i, len(runs), 1.8)}
        for i in range(len(runs))
        for colour, _, line in [CURVES[i % len(CURVES)]]
    ]
    rows = {"": [Line2D([], [], label=run.label, **style) for run, style in zip(runs, styles, strict=True)]}
    has_cost = any((run.series.cost > 0.0).any() for run in runs)
    titles = _PANELS if has_cost else _PANELS[:-1]
    panels = column_panels(figure, [_HEIGHT_IN] * len(titles), top_in=legend_height_in(rows) + _ABOVE_IN)
    draw_legend(figure, rows)
    for run, style in zip(runs, styles, strict=True):
        for panel, values in zip(panels, _curves(run.series), strict=False):
            panel.plot(run.series.times_s, values, **style)
    until_s = max(float(run.series.times_s[-1]) + run.setup.settings.sampling_period_s for run in runs)
    for panel, title in zip(panels, titles, strict=True):
        head(panel, title, legend=False)
        panel.set_xlim(0.0, until_s)
        panel.set_ylim(bottom=0.0)
    if has_cost:
        scale_cost(panels[-1], max(float(np.nanmax(run.series.cost)) for run in runs), _COST_DECADES)
    if shaded:
        shade_phases(runs[0].setup, panels, until_s)


def _curves(series: Series) -> tuple[Array, Array, Array, Array]:
    """Return the quantities of the panels, (T,) each; UAVs that have been released and costs of zero are left out."""
    uavs_m = np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), 0.0).max(axis=1)
    payload_m = np.linalg.norm(series.payload_error_I, axis=1)
    return uavs_m, payload_m, series.attitude_max_deg, np.where(series.cost > 0.0, series.cost, np.nan)
