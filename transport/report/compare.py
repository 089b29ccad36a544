"""Comparison of recorded runs.

Table of quantities, differences from the first run, caveats, and figure.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.metrics import summarise
from transport.analysis.series import SWING_S, Series
from transport.log.run_log import RecordedRun
from transport.protocol.scenario.setup import Setup
from transport.report.column import column_panels, head
from transport.report.report import HELD
from transport.report.style import CURVES, RC, line_width, save, scale_cost, shade_phases

Summary = dict[str, Any]

_COST_DECADES = 5  # that are shown
_PANELS = (
    "UAV error, largest (m)",
    "payload error (m)",
    "payload attitude, largest angle (deg)",
    "stage cost",
)
_HEIGHT_IN, _ABOVE_IN = (
    0.9,
    0.3,
)  # of a panel, and room above the first for its title and the names of the phases


class Compared(NamedTuple):
    """One of the compared runs.

    Its label in tables and figures, its summary (docs/summary.md) and its series.
    """

    label: str
    run: RecordedRun
    summary: Summary
    series: Series

    @staticmethod
    def of(label: str, run: RecordedRun) -> "Compared":
        """Return a run with its summary and series."""
        analysed = AnalysedRun.of(run.setup, counted(run.setup, run.log))
        return Compared(label, run, summarise(analysed), analysed.series)


class Row(NamedTuple):
    """One quantity of all runs, with its unit, empty for none."""

    name: str
    unit: str
    values: tuple[float | str | None, ...]  # of each run; None if its log does not tell
    percent: tuple[float | None, ...]  # difference from the first run; None if not defined


def _lost(summary: Summary) -> float | None:
    messages = summary["messages"]
    return messages["lost"] / messages["sent"] if messages["sent"] else None


def _exceeded(summary: Summary) -> float | None:
    share = summary["constraint_violation_max"]
    return None if share is None else share * (share >= HELD)


# Compared quantities: name, unit, dotted key or function of a summary (docs/summary.md);
# percentages of shares.
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
    ("separation, min", "m", "separation_min_m"),
    ("limits exceeded, max", "%", _exceeded),
    ("agent step, median", "ms", "agent_step_ms.p50"),
    ("agent step, p99", "ms", "agent_step_ms.p99"),
    ("rest of tick, median", "ms", "rest_of_tick_ms.p50"),
    ("real-time factor", "", "real_time_factor"),
    ("deadlines missed", "%", "deadline.share"),
    ("plan age, mean", "ticks", "plan_age_ticks.mean"),
    ("plan age, max", "ticks", "plan_age_ticks.max"),
    ("plans lost", "%", _lost),
    ("radio: airtime", "%", lambda summary: (summary.get("radio") or {}).get("airtime_share")),
    ("radio: delivered", "%", lambda summary: (summary.get("radio") or {}).get("delivered_share")),
    ("messages rejected", "", "messages.rejected"),
    ("solver fallbacks", "", "solver.fallbacks"),
    ("solver failures", "", "solver.failures"),
    ("faults and changes", "", lambda summary: len(summary["faults"])),
)


# What compared runs should share, and why.
_SHARED: tuple[tuple[str, Callable[[Compared], Any], str], ...] = (
    (
        "maneuver",
        lambda one: one.run.setup.scenario.maneuver,
        "cost and errors do not show which controller is better",
    ),
    ("system", lambda one: one.run.setup.scenario.system, "costs are not comparable"),
    ("set of weights", lambda one: one.run.setup.settings.weights, "costs are not comparable"),
    ("cost function", lambda one: one.run.setup.settings.cost, "costs are not comparable"),
    ("machine", lambda one: one.summary["machine"], "times do not only depend on the controller"),
)


def rows(runs: Sequence[Compared]) -> list[Row]:
    """Return a row for each quantity that any of the runs has; at least one run."""
    table = []
    for name, unit, of in _QUANTITIES:
        value_of = of if callable(of) else partial(reduce, getitem, of.split("."))
        values = tuple(value_of(one.summary) for one in runs)
        if unit == "%":
            values = tuple(None if value is None else 100.0 * value for value in values)
        if any(value is not None for value in values):
            table.append(
                Row(
                    name,
                    unit,
                    values,
                    tuple(_difference_percent(value, values[0]) for value in values),
                )
            )
    return table


def doubts(runs: Sequence[Compared]) -> Iterator[str]:
    """Yield the caveats of a comparison, a sentence each."""
    first = runs[0]
    for other in runs[1:]:
        for what, of, why in _SHARED:
            if of(other) != of(first):
                yield f"{other.label} has another {what} than {first.label}: {why}"
    for compared in runs:
        summary, period_s = compared.summary, compared.run.setup.settings.sampling_period_s
        held_s, planned_s = summary["ticks"] * period_s, compared.run.setup.ticks * period_s
        if held_s < planned_s:
            why = summary["reason"] or summary["outcome"]
            yield f"{compared.label}: the log holds {held_s:.2f} of {planned_s:.2f} s ({why}); means are over this time"
        if compared.run.log.cut:
            yield f"{compared.label}: {compared.run.log.cut}"


def _difference_percent(value: Any, first: Any) -> float | None:
    """Return the difference from the first value, %.

    None for texts, missing values and a first value of 0.
    """
    if isinstance(value, str) or isinstance(first, str) or value is None or not first:
        return None
    return float(100.0 * (value - first) / abs(first))


def draw_compared(runs: Sequence[Compared], folder: Path) -> list[Path]:
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
    """Draw runs over one another into an empty figure.

    Label, setup and series; perhaps with phases of the first.
    """
    styles: list[dict[str, Any]] = []
    for i, (label, _, _) in enumerate(runs):
        colour, _, dashes = CURVES[i % len(CURVES)]
        width = line_width(i, len(runs), 1.8)
        styles.append({"color": colour, "linestyle": dashes, "linewidth": width, "label": label})
    legend = [Line2D([], [], **style) for style in styles]
    panels = column_panels(figure, [_HEIGHT_IN] * len(_PANELS), legend=legend, top_in=_ABOVE_IN)
    for (_, _, series), style in zip(runs, styles, strict=True):
        # UAVs that have been released and costs of zero are left out.
        curves = (
            np.where(series.on_rods, np.linalg.norm(series.uav_errors_I, axis=2), 0.0).max(axis=1),
            series.payload_error_norm_m,
            series.attitude_max_deg,
            np.where(series.cost > 0.0, series.cost, np.nan),
        )
        for panel, values in zip(panels, curves, strict=True):
            panel.plot(series.times_s, values, **style)
    until_s = max(
        float(series.times_s[-1]) + setup.settings.sampling_period_s for _, setup, series in runs
    )
    for panel, title in zip(panels, _PANELS, strict=True):
        head(panel, title, legend=False)
        panel.set_xlim(0.0, until_s)
        panel.set_ylim(bottom=0.0)
    scale_cost(
        panels[-1], max(float(np.nanmax(series.cost)) for _, _, series in runs), _COST_DECADES
    )
    if shaded:
        shade_phases(runs[0][1], panels, until_s)
