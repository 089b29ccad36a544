"""What a search leaves: the minimal case as a scenario file that says what happens, its figure, a summary."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import orjson
import tomli_w
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.analysis.series import Series, series_of
from transport.flight.memory import simulate
from transport.flight.run_files import machine
from transport.log.run_log import Recorded, RunLog
from transport.model.arrays import Array
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.sections.schema import LONGEST_NAME
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message
from transport.report.figures.column import column_panels
from transport.report.figures.style import RC, save
from transport.search.evaluation import CaseVerdict
from transport.search.kinds_of_events import Death, DrawnSilence, Event, TargetEvent
from transport.search.search import Minimal, SearchCase, SearchResult

SCENARIO, FIGURE, SUMMARY = "minimal.toml", "minimal.png", "summary.json"
_NAME_ENDING = "-worst"  # of the scenario
_SHOWN = 10  # cases of the table
_BEFORE_S = 1.0  # shown before the first event
_AFTER_S = 2.0  # shown after the failure
_LONGEST_S = 20.0  # shown at most
_WIDTH = 100  # columns of a comment
_HEIGHT_IN = 0.9
# Labels of the panels, by the measure that each shows.
_LABELS = {
    "attitude": "attitude (deg)",
    "payload": "payload error (m)",
    "separation": "distance (m)",
}
_SILENT = "#f3d9d9"
_DEATH: Any = {"color": "#004488", "linewidth": 0.9, "linestyle": "--"}
_TARGET: Any = {"color": "#D55E00", "linewidth": 0.9, "linestyle": "-."}
_LIMIT: Any = {"color": "#B2182B", "linewidth": 0.9, "linestyle": ":"}


def write(folder: Path, result: SearchResult) -> None:
    """Write the results of a search into its folder."""
    if result.minimal is not None:
        write_whole(folder / SCENARIO, scenario_text(result.minimal))
        with mpl.rc_context(RC):
            save(draw(Figure(), result.minimal), folder / FIGURE)
    text = orjson.dumps(summary(result), option=orjson.OPT_INDENT_2)
    write_whole(folder / SUMMARY, text + b"\n")


def summary(result: SearchResult) -> dict[str, Any]:
    """Return the result of a search as JSON data."""
    objective = result.problem.objective
    return {
        "scenario": result.problem.base.scenario.name,
        "objective": objective.measure,
        "limit": objective.limit,
        "without_events": result.without_events.value,
        "cases": len(result.cases),
        "failures": result.failures,
        "refused": len(result.refused),
        "first_failure": result.first_failure,
        "worst": [_row(case) for case in ranked(result)],
        "minimal": None if result.minimal is None else _minimal(result.minimal),
        "machine": machine(),
    }


def ranked(result: SearchResult) -> list[SearchCase]:
    """Return the worst cases, at most ten, the worst first."""
    order = sorted(result.cases, key=lambda case: case.order)
    return order[:_SHOWN]


def _row(case: SearchCase) -> dict[str, Any]:
    return {
        "case": case.number,
        "robustness": round(case.evaluation.robustness, 3),
        "value": case.evaluation.value,
        "outcome": case.evaluation.outcome,
        "end_s": case.evaluation.end_s,
        "events": case.candidate.in_words(),
    }


def _minimal(minimal: Minimal) -> dict[str, Any]:
    return {
        "uavs": len(minimal.problem.base.scenario.system.uav),
        "events": [event.in_words() for event in minimal.candidate.events],
        "outcome": minimal.evaluation.outcome,
        "value": minimal.evaluation.value,
        "end_s": minimal.evaluation.end_s,
        "failed_s": minimal.evaluation.failed_s,
        "beyond_physics": minimal.verdict.beyond_physics,
        "verdict": _verdict_in_words(minimal.verdict),
    }


def in_words(minimal: Minimal) -> list[str]:
    """Return what happens in the minimal case, a sentence each."""
    events = [f"{_capital(event.in_words())}." for event in minimal.candidate.events]
    uavs = len(minimal.problem.base.scenario.system.uav)
    team = [f"The team is made smaller, to {uavs} UAVs."] if uavs < minimal.whole_team else []
    return [*team, *events, _failure_in_words(minimal), _verdict_in_words(minimal.verdict)]


def _verdict_in_words(verdict: CaseVerdict) -> str:
    """Return whether the case is one of the network or beyond physics, as a sentence."""
    controller = "The project's controller for all UAVs with perfect information"
    if verdict.beyond_physics is None:
        return f"{controller} cannot tell whether the case is beyond physics: {verdict.reason}."
    if verdict.beyond_physics:
        return f"{controller} fails as well: the case is beyond physics."
    return f"{controller} survives the same weather and targets."


def _failure_in_words(minimal: Minimal) -> str:
    """Return when and by which number the minimal case fails, as a sentence."""
    objective = minimal.problem.objective
    evaluation = minimal.evaluation
    number = objective.in_words(evaluation.value)
    limit = f"(limit {objective.limit_in_words()})"
    if evaluation.outcome != "completed":  # diverged, or ended at the limit
        return f"At {evaluation.failed_s:g} s the run fails: {number} {limit}."
    if evaluation.passed_s is None:
        return f"Over the whole run it fails: {number} {limit}."
    return f"At {evaluation.passed_s:g} s the run fails: {number} at the worst {limit}."


def _capital(text: str) -> str:
    """Return a text with a capital at its beginning."""
    return text[:1].upper() + text[1:]


def scenario_text(minimal: Minimal) -> str:
    """Return the scenario of the minimal case as TOML, with a comment that says what happens."""
    scenario = minimal.candidate.scenario(minimal.problem.base)
    begin = minimal.problem.base.scenario.name[: LONGEST_NAME - len(_NAME_ENDING)]
    name = f"{begin}{_NAME_ENDING}"
    sentences = [f"Minimal case of a search on {minimal.problem.base.scenario.name}."]
    comment = [
        f"# {line}"
        for sentence in [*sentences, *in_words(minimal)]
        for line in textwrap.wrap(sentence, _WIDTH - 2)
    ]
    tree = scenario.model_copy(update={"name": name}).model_dump(
        mode="json", by_alias=True, exclude_none=True, exclude_defaults=True
    )
    tree = {"schema": scenario.tree()["schema"], **tree}  # a default that each file must have

    return "\n".join(comment) + "\n" + tomli_w.dumps(tree)


def flown_again(minimal: Minimal) -> tuple[Setup, RunLog]:
    """Return setup and log of the minimal case, simulated to its end."""
    scenario = minimal.candidate.scenario(minimal.problem.base)
    setup = Setup.of(scenario, minimal.problem.base.source)
    messages: list[Message] = []
    simulate(setup, messages.append)
    recorded = tuple(Recorded(message=message, received_ns=0) for message in messages)
    return setup, RunLog(header={}, messages=recorded, cut="")


def draw(figure: Figure, minimal: Minimal) -> Figure:
    """Draw attitude, payload error and smallest distance around the failure, with the events."""
    setup, log = flown_again(minimal)
    series = series_of(setup, log)
    begin_s, end_s = window_s(minimal, float(series.times_s[-1]))

    objective = minimal.problem.objective
    legend = _legend(minimal.candidate.events, objective.measure)
    panels = column_panels(figure, [_HEIGHT_IN] * len(_LABELS), legend=legend)
    curves = _curves(series)
    shown = (series.times_s >= begin_s) & (series.times_s <= end_s)

    for panel, (label, values) in zip(panels, curves.items(), strict=True):
        panel.plot(series.times_s[shown], values[shown], color="#000000")
        panel.set_ylabel(label)
        _mark(panel, minimal.candidate.events)
        panel.set_xlim(begin_s, end_s)
        if label == _LABELS.get(objective.measure):
            panel.axhline(objective.limit, **_LIMIT)
    return figure


def window_s(minimal: Minimal, last_s: float) -> tuple[float, float]:
    """Return begin and end of the figure, s, for a run whose last instant is given.

    It shows the failure, and the first event as far as the longest window allows.
    """
    failed_s = minimal.evaluation.failed_s
    end_s = min(last_s, failed_s + _AFTER_S)
    first_s = min(failed_s, _first_s(minimal.candidate.events))
    return max(0.0, end_s - _LONGEST_S, first_s - _BEFORE_S), end_s


def _legend(events: Sequence[Event], measure: str) -> list[Line2D]:
    """Return the entries of the kinds of marks that the figure has."""
    kinds = {
        "silence": (DrawnSilence, {"color": _SILENT, "linewidth": 5.0}),
        "death": (Death, _DEATH),
        "target": (TargetEvent, _TARGET),
    }
    lines = [
        Line2D([], [], label=name, **style)
        for name, (kind, style) in kinds.items()
        if any(isinstance(event, kind) for event in events)
    ]
    if measure in _LABELS:
        lines.append(Line2D([], [], label="limit", **_LIMIT))
    return lines


def _first_s(events: Sequence[Event]) -> float:
    """Return when the first event begins; 0 where all last for the whole run."""
    times = [event.start_s for event in events if isinstance(event, DrawnSilence)]
    times += [event.at_s for event in events if isinstance(event, Death | TargetEvent)]
    return min(times, default=0.0)


def _curves(series: Series) -> dict[str, Array]:
    """Return the curves of the panels by their labels, each (T,)."""
    return {
        _LABELS["attitude"]: series.attitude_max_deg,
        _LABELS["payload"]: series.payload_error_norm_m,
        _LABELS["separation"]: series.separation_m,
    }


def _mark(panel: Axes, events: Sequence[Event]) -> None:
    """Shade silences and mark deaths and targets."""
    for event in events:
        if isinstance(event, DrawnSilence):
            panel.axvspan(event.start_s, event.end_s, color=_SILENT, linewidth=0)
        elif isinstance(event, Death):
            panel.axvline(event.at_s, **_DEATH)
        elif isinstance(event, TargetEvent):
            panel.axvline(event.at_s, **_TARGET)
