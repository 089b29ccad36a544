"""The laws that a run can get into, as `transport validate` prints them (`transport.report.laws`)."""

import pytest

from tests.support.runs import ready
from transport.report.laws import in_words, laws
from transport.report.margins import hover_margins


def test_the_numbers_are_those_of_the_margins() -> None:
    """Decay and margins of UAVs alone are those that `transport margins` has."""
    setup = ready("alone")
    (law,) = laws(setup)
    whole = hover_margins(setup)
    assert law.name == "UAVs alone"
    assert law.settling_s == whole.settling_s["immediate"]
    assert law.margins_s is not None
    for key, margin_s in law.margins_s.items():
        assert margin_s == whole.margins["immediate"][key].upper


def test_three_lines_name_the_laws_and_the_weakest() -> None:
    """Which laws, the slowest decay and the smallest margins, each with the law that it belongs to."""
    names, decay, least = in_words(ready("eight"))
    assert names.startswith("laws: the team's, 3 after a death, UAVs alone (position 6, velocity 5")
    assert decay == "slowest decay: 3.9 s (UAVs alone)"
    assert "of actuator delay (UAVs alone)" in least


@pytest.mark.parametrize("name", ["paper", "centralized"])
def test_a_run_without_known_feedback_says_so(name: str) -> None:
    """Plans of open-loop prediction are no known feedback, and no UAV of such a run acts alone."""
    assert list(in_words(ready(name))) == ["laws: none of known feedback"]


def test_a_law_that_does_not_hold_is_named() -> None:
    """UAVs alone whose deviations grow never decay, and have no margin."""
    _, decay, least = in_words(ready("resilient", "controller.alone.swing=8.0"))
    # A UAV without an agent flies by the same law.
    assert decay.startswith("slowest decay: never (after the death of agent 1, ")
    assert decay.endswith("UAVs alone)")
    assert least.startswith("smallest margins: 0 ms of actuator delay (UAVs alone)")
