"""Comparison of recorded runs: quantities with differences from the first run, settings that differ, caveats."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.cost_and_tracking_metrics import SWING_S
from transport.analysis.series import Series
from transport.analysis.summary_assembly import summarise
from transport.log.run_folder import RecordedRun
from transport.report.summary_texts import HELD

Summary = dict[str, Any]

_PERCENT = 100.0


class ComparedRun(NamedTuple):
    """One of the compared runs with its summary and series."""

    label: str  # in tables and figures
    run: RecordedRun
    summary: Summary  # docs/reference/summary.md
    series: Series

    @staticmethod
    def of(label: str, run: RecordedRun) -> "ComparedRun":
        """Return a run with its summary and series."""
        analysed = AnalysedRun.of(run.setup, counted(run.setup, run.log))
        return ComparedRun(label, run, summarise(analysed), analysed.series)


class Row(NamedTuple):
    """One quantity of all runs, with its unit, empty for none."""

    name: str
    unit: str
    values: tuple[float | str | None, ...]  # of each run; None if its log does not tell
    percent: tuple[float | None, ...]  # difference from the first run; None if not defined


def _lost(summary: Summary) -> float | None:
    """Return the share of plans that were lost."""
    messages = summary["messages"]
    return messages["lost"] / messages["sent"] if messages["sent"] else None


def _exceeded(summary: Summary) -> float | None:
    """Return the largest violation of a limit as a share of its range; 0 if all held."""
    share = summary["constraint_violation_max"]
    if share is None:
        return None
    # Below HELD a limit was exceeded within the tolerance of the solver.
    return share if share >= HELD else 0.0


def _at(summary: Summary, key: str) -> Any:
    """Return the value at a dotted key; None below a section that the run does not have."""
    value: Any = summary
    for name in key.split("."):
        if value is None:
            return None
        value = value.get(name)
    return value


# Compared quantities: name, unit, dotted key or function of a summary (docs/reference/summary.md);
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
    ("radio: airtime", "%", "radio.airtime_share"),
    ("radio: delivered", "%", "radio.delivered_share"),
    ("messages rejected", "", "messages.rejected"),
    ("solver fallbacks", "", "solver.fallbacks"),
    ("solver failures", "", "solver.failures"),
    ("faults and changes", "", lambda summary: len(summary["faults"])),
)


# What compared runs should share, and why.
_SHARED: tuple[tuple[str, Callable[[ComparedRun], Any], str], ...] = (
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


class Setting(NamedTuple):
    """A key of the scenario that the compared runs do not all have alike."""

    key: str
    values: tuple[Any, ...]  # of each run; None where it has none


# Keys that change no flight.
_WITHOUT_EFFECT = ("name", "network.")


def settings_apart(runs: Sequence[ComparedRun]) -> list[Setting]:
    """Return the keys of the scenarios that differ between runs."""
    trees = [one.run.setup.scenario.tree() for one in runs]
    apart = _apart("", trees)
    return [one for one in apart if not one.key.startswith(_WITHOUT_EFFECT)]


def _apart(key: str, values: Sequence[Any]) -> Iterator[Setting]:
    """Yield the keys at and below a dotted key whose values differ; entries count from 1."""
    first = values[0]
    if all(value == first for value in values):
        return
    below: Iterable[Any] = ()
    if all(isinstance(value, Mapping) for value in values):
        below = dict.fromkeys(name for value in values for name in value)
    elif all(_is_tables(value) and len(value) == len(first) for value in values):
        values = [dict(enumerate(value, start=1)) for value in values]
        below = values[0]
    else:
        yield Setting(key, tuple(values))
    for name in below:
        yield from _apart(f"{key}.{name}".removeprefix("."), [value.get(name) for value in values])


def _is_tables(value: Any) -> bool:
    """Return whether a value of a scenario is a list of tables."""
    return isinstance(value, list) and any(isinstance(entry, Mapping) for entry in value)


def rows(runs: Sequence[ComparedRun]) -> list[Row]:
    """Return a row for each quantity that any of the runs has; at least one run."""
    table = []
    for name, unit, source in _QUANTITIES:
        values = tuple(
            source(one.summary) if callable(source) else _at(one.summary, source) for one in runs
        )
        if unit == "%":
            values = tuple(None if value is None else _PERCENT * value for value in values)
        if all(value is None for value in values):
            continue
        percent = tuple(_difference_percent(value, values[0]) for value in values)
        table.append(Row(name, unit, values, percent))
    return table


def doubts(runs: Sequence[ComparedRun]) -> Iterator[str]:
    """Yield the caveats of a comparison, a sentence each."""
    first = runs[0]
    for other in runs[1:]:
        for name, value_of, reason in _SHARED:
            if value_of(other) != value_of(first):
                yield f"{other.label} has another {name} than {first.label}: {reason}"

    for compared in runs:
        summary = compared.summary
        setup = compared.run.setup
        held_s = summary["ticks"] * setup.settings.sampling_period_s
        planned_s = setup.ticks * setup.settings.sampling_period_s
        if held_s < planned_s:
            reason = summary["reason"] or summary["outcome"]
            part = f"the log holds {held_s:.2f} of {planned_s:.2f} s ({reason})"
            yield f"{compared.label}: {part}; means are over this time"
        if compared.run.log.cut:
            yield f"{compared.label}: {compared.run.log.cut}"


def _difference_percent(value: Any, first: Any) -> float | None:
    """Return the difference from the first value, %.

    None for texts, missing values and a first value of 0.
    """
    if isinstance(value, str) or isinstance(first, str) or value is None or not first:
        return None
    return float(_PERCENT * (value - first) / abs(first))
