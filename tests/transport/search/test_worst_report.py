"""What a search writes of its minimal case: sentences, the scenario that reads back, the figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.support.runs import SCENARIOS
from transport.protocol.scenario.scenario_file import read_scenario
from transport.search.candidate import Base, Candidate
from transport.search.drawn_events import Death, DrawnSilence, Event, Gusts, TargetEvent
from transport.search.evaluation import CaseVerdict, Evaluation, SearchProblem
from transport.search.objective import SearchObjective
from transport.search.search import Minimal
from transport.search.search_report import draw, in_words, scenario_text, window_s

FILE = SCENARIOS / "resilient.toml"
HOVER = "maneuver.phase=[{name='hover',duration_s=4.0,displacement_m=[0.0,0.0,0.0]}]"
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
