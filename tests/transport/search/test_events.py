"""Events change a scenario as their words say, alone and together."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.runs import SCENARIOS
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.file import read_scenario
from transport.protocol.scenario.links import Link
from transport.protocol.scenario.schema import Scenario
from transport.search.candidate import Base, Candidate
from transport.search.events import Death, Gusts, Silence, TargetEvent
from transport.search.space import KINDS, Bounds, Space, read_bounds

PERIOD_S = 0.05
TICKS = 120  # instants at which losses are compared: those of 6 s
AGENTS = (1, 2, 3, 4)
FILE = SCENARIOS / "resilient.toml"


def scenario() -> Scenario:
    """Return the ready scenario with the shared control law."""
    return read_scenario(FILE)


BASE = Base(scenario=scenario(), source=str(FILE))

WHO = st.sampled_from(["all", "mute 3", "deaf 2", "cut 1 4"])
SILENCES = st.builds(
    lambda start, ticks, who: Silence(
        start_s=round(start * PERIOD_S, 6), duration_s=round(ticks * PERIOD_S, 6), who=who
    ),
    st.integers(0, 60),
    st.integers(1, 50),
    WHO,
)


@settings(max_examples=40)
@given(silences=st.lists(SILENCES, max_size=3))
def test_overlapping_silences_lose_exactly_the_messages_that_one_covers(
    silences: list[Silence],
) -> None:
    """A message is lost if and only if a window that covers its link is open when it is sent."""
    changed = Candidate(tuple(silences)).scenario(BASE)
    for sender in AGENTS:
        for receiver in AGENTS:
            if sender == receiver:
                continue
            names = f"agent{sender}", f"agent{receiver}"
            link = Link(changed.links, *names, seed=0, period_s=PERIOD_S)
            for tick in range(TICKS):
                time_s = round(tick * PERIOD_S, 6)
                silent = any(
                    one.start_s <= time_s < one.end_s and one.silences(sender, receiver)
                    for one in silences
                )
                assert (link.delays(tick) == []) == silent, (names, tick)


def test_links_that_change_alike_are_one_entry() -> None:
    """The whole network is one change and its end another; an agent that is not heard likewise."""
    for who in ("all", "mute 3", "deaf 2"):
        silence = Silence(start_s=1.0, duration_s=2.0, who=who)
        assert len(Candidate((silence,)).scenario(BASE).links.change) == 2, who


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_point_of_the_space_is_a_valid_scenario(seed: int) -> None:
    """Any point of the unit cube, its corners included, gives events that the scenario accepts."""
    space = Space(KINDS, read_bounds(None, 25.0), BASE.scenario)
    rng = np.random.default_rng(seed)
    inside = rng.random(space.dimension)
    corner = np.round(inside)
    for point in (inside, corner):
        candidate = space.candidate(point)
        assert candidate.scenario(BASE).name == "resilient"


@pytest.mark.parametrize(
    "bounds",
    [
        {"gusts": {"speed_mps": (0.0, 0.0)}},
        {"links": {"delay_s": (0.0, 0.0), "jitter_s": (0.0, 0.0), "loss": (0.0, 0.0)}},
        {"mass": {"mass_factor": (1.0, 1.0)}},
    ],
)
def test_bounds_that_allow_no_event_are_refused(bounds: dict[str, Any]) -> None:
    """A space in which no candidate has an event is an error of one line."""
    with pytest.raises(ScenarioError, match="expected bounds that allow an event"):
        Space(list(bounds), Bounds.model_validate(bounds), BASE.scenario)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_simplification_ends(seed: int) -> None:
    """Removing events reaches a candidate without any; simplifying an event again and again ends."""
    space = Space(KINDS, read_bounds(None, 25.0), BASE.scenario)
    candidate = space.candidate(np.random.default_rng(seed).random(space.dimension))
    for _ in range(len(candidate.events)):
        candidate = candidate.fewer()[0]
    assert candidate == Candidate(())

    event = Silence(start_s=7.317, duration_s=9.9, who="all", loss=0.95)
    visited = {event}
    while (
        simpler := next((one for one in event.simpler() if one not in visited), None)
    ) is not None:
        visited.add(simpler)
        event = simpler
    assert len(visited) < 1000


def test_words_name_every_event() -> None:
    """The sentence of a candidate has agents, times and weather."""
    events = (
        Silence(start_s=4.0, duration_s=2.0, who="cut 2 3"),
        Death(agent=4, at_s=1.0),
        Gusts(speed_mps=0.5, seed=7),
        TargetEvent(at_s=3.0, offset_m=(1.0, 0.0, -0.5)),
    )
    assert Candidate(events).in_words() == (
        "from 4 to 6 s agent 2 and agent 3 are cut off from the others; "
        "at 1 s agent 4 dies for good; gusts of 0.5 m/s, seed 7; "
        "at 3 s a target (1, 0, -0.5) m from the start"
    )


def test_bounds_of_a_file_are_read(tmp_path: Path) -> None:
    """A file changes what it names; the rest keeps its defaults."""
    file = tmp_path / "bounds.toml"
    file.write_text("[silence]\nduration_s = [1.0, 2.0]\n", encoding="utf-8")
    bounds = read_bounds(file, 25.0)
    assert bounds.silence.duration_s == (1.0, 2.0)
    assert bounds.silence.count == 2


REFUSED = {
    "[silence]\nduration_s = [2.0, 1.0]\n": "silence.duration_s: expected smallest <= largest",
    "[silence]\nwho = ['some']\n": "silence.who.1: expected 'all', 'mute', 'deaf' or 'cut'",
    "[silence]\nwho = []\n": "silence.who",
    "[silences]\n": "silences: unknown key; did you mean 'silence'?",
    "[deaths]\ncount = 0\n": "deaths.count: expected greater than or equal to 1",
    "[gusts]\nspeed_mps = [-1.0, 1.0]\n": "gusts.speed_mps.1: expected greater than or equal to 0",
}


@pytest.mark.parametrize("text", REFUSED)
def test_bad_bounds_are_refused(text: str, tmp_path: Path) -> None:
    """The refusal names file, key, expected and got."""
    file = tmp_path / "bounds.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError) as refusal:
        read_bounds(file, 25.0)
    assert str(refusal.value).startswith(f"{file}: {REFUSED[text]}")


@pytest.mark.parametrize("kinds", [(), ("silences",)])
def test_an_empty_or_unknown_space_is_refused(kinds: tuple[str, ...]) -> None:
    """The refusal lists the kinds of events."""
    with pytest.raises(ScenarioError, match="--over: expected some of silence, deaths, links"):
        Space(kinds, read_bounds(None, 25.0), BASE.scenario)
