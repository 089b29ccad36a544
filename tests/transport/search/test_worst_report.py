"""What a search writes of its minimal case: sentences, the scenario that reads back, the figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from tests.support.runs import SCENARIOS
from transport.analysis.series import series_of
from transport.flight.run_files import machine
from transport.protocol.scenario.scenario_file import read_scenario
from transport.search.candidate import Base, Candidate
from transport.search.evaluation import CaseVerdict, Evaluation, SearchProblem
from transport.search.kinds_of_events import Death, DrawnSilence, Event, Gusts, TargetEvent
from transport.search.objective import SearchObjective
from transport.search.search import Minimal, SearchCase, SearchResult
from transport.search.search_report import (
    draw,
    flown_again,
    in_words,
    scenario_text,
    summary,
    window_s,
    write,
)

FILE = SCENARIOS / "resilient.toml"
HOVER = "maneuver.phase=[{name='hover',duration_s=6.0,displacement_m=[0.0,0.0,0.0]}]"
LONGEST_NAME = 40  # characters of the name of a scenario
LONGEST_LINE = 100  # characters of a line of the comment
SILENCE = DrawnSilence(start_s=1.5, duration_s=1.0)
GUSTS = Gusts(speed_mps=0.5, seed=7)

# What the figure shows before the first event, after the failure, and at most, s.
BEFORE_S, AFTER_S, LONGEST_S = 1.0, 2.0, 20.0


def minimal(
    *events: Event, measure: str = "attitude", failed_s: float = 1.75, name: str = "resilient"
) -> Minimal:
    """Return a minimal case on a hovering team of four that has failed at its limit."""
    scenario = read_scenario(FILE, [HOVER, f"name={name}"])
    base = Base(scenario=scenario, source=str(FILE))
    evaluation = Evaluation(
        key="",
        robustness=-0.5,
        value=12.5,
        outcome="failed",
        end_s=failed_s,
        passed_s=failed_s,
    )
    return Minimal(
        problem=SearchProblem(base=base, objective=SearchObjective.of(measure, None, scenario)),
        whole_team=4,
        candidate=Candidate(events),
        evaluation=evaluation,
        verdict=CaseVerdict(beyond_physics=False),
    )


def test_sentences_tell_events_failure_and_verdict() -> None:
    """They are in that order, one for each event."""
    assert in_words(minimal(SILENCE, GUSTS)) == [
        "From 1.5 to 2.5 s the whole network is silent.",
        "Gusts of 0.5 m/s, seed 7.",
        "At 1.75 s the run fails: attitude 12.50 deg (limit 10 deg).",
        "The project's controller for all UAVs with perfect information survives the same weather and targets.",
    ]


def test_a_case_beyond_physics_is_told_as_one() -> None:
    """The verdict is the last sentence."""
    beyond = replace(minimal(SILENCE), verdict=CaseVerdict(beyond_physics=True))
    assert in_words(beyond)[-1] == (
        "The project's controller for all UAVs with perfect information fails as well: the case is "
        "beyond physics."
    )
    unknown = CaseVerdict(beyond_physics=None, reason="it fails without any event as well")
    assert in_words(replace(minimal(SILENCE), verdict=unknown))[-1] == (
        "The project's controller for all UAVs with perfect information cannot tell whether the case "
        "is beyond physics: it fails without any event as well."
    )


def test_a_smaller_team_is_told_first() -> None:
    """Its size is that of the minimal case; a team of the whole size has no sentence."""
    assert in_words(replace(minimal(SILENCE), whole_team=6))[0] == (
        "The team is made smaller, to 4 UAVs."
    )


@pytest.mark.parametrize(
    ("measure", "outcome", "passed_s", "sentence"),
    [
        (
            *("payload", "diverged", 1.5),
            "At 1.5 s the run fails: payload error 12.500 m (limit 1 m).",
        ),
        ("cost", "diverged", None, "At 3 s the run fails: cost 12.5 (limit 10)."),
        (
            *("attitude", "completed", 1.5),
            "At 1.5 s the run fails: attitude 12.50 deg at the worst (limit 10 deg).",
        ),
        ("cost", "completed", None, "Over the whole run it fails: cost 12.5 (limit 10)."),
        (
            *("constraint", "completed", None),
            "Over the whole run it fails: violation 12.5 (limit 0.1).",
        ),
    ],
)
def test_the_failure_is_told_by_time_and_number(
    measure: str, outcome: str, passed_s: float | None, sentence: str
) -> None:
    """A run that ended there has failed by its number; one that went on, by the worst; or as a whole."""
    case = minimal(SILENCE, measure=measure)
    evaluation = replace(case.evaluation, outcome=outcome, end_s=3.0, passed_s=passed_s)
    assert in_words(replace(case, evaluation=evaluation))[-2] == sentence


@pytest.mark.parametrize("name", ["resilient", "x" * LONGEST_NAME])
def test_the_scenario_reads_back(name: str, tmp_path: Path) -> None:
    """The file is the scenario with the events, under a name of its own that begins as the other."""
    case = minimal(SILENCE, Death(agent=3, at_s=0.5), GUSTS, name=name)
    text = scenario_text(case)
    file = tmp_path / "minimal.toml"
    file.write_text(text, encoding="utf-8")

    expected = case.candidate.scenario(case.problem.base).tree()
    found = read_scenario(file).tree()
    assert found == expected | {"name": found["name"]}
    assert found["name"] == f"{name[: LONGEST_NAME - len('-worst')]}-worst"

    comment = [line for line in text.splitlines() if line.startswith("#")]
    assert text.startswith("\n".join(comment))
    assert max(map(len, comment)) <= LONGEST_LINE
    words = " ".join(line.removeprefix("# ") for line in comment)
    assert words == " ".join([f"Minimal case of a search on {name}.", *in_words(case)])


@pytest.mark.parametrize(
    ("events", "failed_s", "last_s", "expected"),
    [
        ((SILENCE,), 5.0, 30.0, (SILENCE.start_s - BEFORE_S, 5.0 + AFTER_S)),
        ((SILENCE,), 5.0, 6.0, (SILENCE.start_s - BEFORE_S, 6.0)),  # the run ends before
        ((Death(agent=1, at_s=4.0), GUSTS, SILENCE), 5.0, 30.0, (0.5, 7.0)),
        ((TargetEvent(at_s=3.0, offset_m=(1.0, 0.0, 0.0)),), 5.0, 30.0, (2.0, 7.0)),
        ((Death(agent=1, at_s=0.5),), 5.0, 30.0, (0.0, 7.0)),
        ((SILENCE,), 25.0, 60.0, (27.0 - LONGEST_S, 27.0)),
        ((GUSTS,), 5.0, 30.0, (0.0, 7.0)),  # all events last for the whole run
        ((GUSTS,), 25.0, 60.0, (27.0 - LONGEST_S, 27.0)),
        ((Death(agent=1, at_s=9.0),), 5.0, 30.0, (5.0 - BEFORE_S, 7.0)),
    ],
)
def test_the_window_has_first_event_and_failure(
    events: tuple[Event, ...], failed_s: float, last_s: float, expected: tuple[float, float]
) -> None:
    """It begins before the first event, at most 20 s before its end, which is after the failure."""
    assert window_s(minimal(*events, failed_s=failed_s), last_s) == pytest.approx(expected)


@pytest.mark.parametrize(("events", "begin_s"), [((SILENCE,), 0.5), ((GUSTS,), 0.0)])
def test_the_panels_show_the_window(events: tuple[Event, ...], begin_s: float) -> None:
    """Limits and curves of all three panels are those of the window."""
    figure = draw(Figure(), minimal(*events))
    assert len(figure.axes) == 3
    for panel in figure.axes:
        assert panel.get_xlim() == pytest.approx((begin_s, 1.75 + AFTER_S))
        times_s = np.asarray(panel.lines[0].get_xdata())
        assert (times_s[0], times_s[-1]) == pytest.approx((begin_s, 1.75 + AFTER_S))


def upright(panel: Axes) -> list[tuple[float, str]]:
    """Return time and style of each line over the whole height of a panel."""
    lines = [line for line in panel.lines if list(np.ravel(line.get_ydata())) == [0.0, 1.0]]
    return [(float(np.ravel(line.get_xdata())[0]), str(line.get_linestyle())) for line in lines]


def level(panel: Axes) -> list[float]:
    """Return the height of each line over the whole width of a panel."""
    lines: list[Line2D] = [
        line for line in panel.lines if list(np.ravel(line.get_xdata())) == [0.0, 1.0]
    ]
    return [float(np.ravel(line.get_ydata())[0]) for line in lines]


def test_each_panel_has_its_curve_the_events_and_the_limit_if_it_is_its_own() -> None:
    """A silence is a span, a death and a target are lines of their own kind, as the legend names them."""
    events = (
        SILENCE,
        Death(agent=3, at_s=1.0),
        TargetEvent(at_s=1.25, offset_m=(0.1, 0.0, 0.0)),
    )
    case = minimal(*events, measure="payload")
    figure = draw(Figure(), case)
    series = series_of(*flown_again(case))
    shown = (series.times_s >= 0.0) & (series.times_s <= 1.75 + AFTER_S)

    curves = {
        "attitude (deg)": series.attitude_max_deg,
        "payload error (m)": series.payload_error_norm_m,
        "distance (m)": series.separation_m,
    }
    assert [panel.get_ylabel() for panel in figure.axes] == list(curves)
    for panel, values in zip(figure.axes, curves.values(), strict=True):
        assert np.ravel(panel.lines[0].get_ydata()).tolist() == values[shown].tolist()
        (span,) = (patch for patch in panel.patches if isinstance(patch, Rectangle))
        assert (span.get_x(), span.get_width()) == pytest.approx((1.5, 1.0))
        assert upright(panel) == [(1.0, "--"), (1.25, "-.")]
    assert [level(panel) for panel in figure.axes] == [[], [1.0], []]  # m, of the payload alone

    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "silence",
        "death",
        "target",
        "limit",
    ]


def test_the_legend_names_only_the_marks_there_are() -> None:
    """Gusts have no mark, and the cost no panel and so no limit."""
    figure = draw(Figure(), minimal(SILENCE, GUSTS, measure="cost"))
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["silence"]
    assert [level(panel) for panel in figure.axes] == [[], [], []]


def test_a_search_leaves_the_minimal_case_if_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its scenario and its figure, beside the summary."""
    monkeypatch.setattr("transport.search.search_report.draw", lambda figure, _: figure)
    case = minimal(SILENCE)
    found = SearchCase(number=1, candidate=case.candidate, evaluation=case.evaluation)
    result = SearchResult(
        problem=case.problem, without_events=case.evaluation, cases=[found], minimal=case
    )
    figures = {"minimal.png", "minimal.svg"}
    for one, names in ((None, set()), (case, {"minimal.toml", *figures})):
        write(tmp_path, replace(result, minimal=one))
        assert {path.name for path in tmp_path.iterdir()} == {"summary.json", *names}
    assert (tmp_path / "minimal.toml").read_text(encoding="utf-8") == scenario_text(case)
    assert (tmp_path / "summary.json").read_text(encoding="utf-8").endswith("}\n")


def test_the_summary_has_counts_the_worst_cases_and_the_minimal_one() -> None:
    """The worst is first, a refused case is counted apart, and robustness is rounded."""
    case = minimal(SILENCE, GUSTS)
    completed = Evaluation(
        key="", robustness=0.62345, value=3.75, outcome="completed", end_s=4.0, passed_s=None
    )
    refused = replace(completed, robustness=1.0, value=0.0, outcome="refused", end_s=0.0)
    result = SearchResult(
        problem=case.problem,
        without_events=replace(completed, value=2.5),
        cases=[
            SearchCase(number=1, candidate=Candidate((GUSTS,)), evaluation=completed),
            SearchCase(number=2, candidate=Candidate(()), evaluation=refused),
            SearchCase(number=3, candidate=case.candidate, evaluation=case.evaluation),
        ],
        minimal=case,
    )
    silence = "from 1.5 to 2.5 s the whole network is silent"
    gusts = "gusts of 0.5 m/s, seed 7"
    assert summary(result) == {
        "scenario": "resilient",
        "objective": "attitude",
        "limit": 10.0,
        "without_events": 2.5,
        "cases": 3,
        "failures": 1,
        "refused": 1,
        "first_failure": 3,
        "worst": [
            {
                "case": 3,
                "robustness": -0.5,
                "value": 12.5,
                "outcome": "failed",
                "end_s": 1.75,
                "events": f"{silence}; {gusts}",
            },
            {
                "case": 1,
                "robustness": 0.623,
                "value": 3.75,
                "outcome": "completed",
                "end_s": 4.0,
                "events": gusts,
            },
            {
                "case": 2,
                "robustness": 1.0,
                "value": 0.0,
                "outcome": "refused",
                "end_s": 0.0,
                "events": "no event",
            },
        ],
        "minimal": {
            "uavs": 4,
            "events": [silence, gusts],
            "outcome": "failed",
            "value": 12.5,
            "end_s": 1.75,
            "failed_s": 1.75,
            "beyond_physics": False,
            "verdict": "The project's controller for all UAVs with perfect information survives the "
            "same weather and targets.",
        },
        "machine": machine(),
    }
    assert summary(replace(result, minimal=None))["minimal"] is None
