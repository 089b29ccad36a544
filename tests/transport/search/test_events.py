"""Events change a scenario as their words say, alone and together."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.runs import SCENARIOS
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.search.candidate import Base, Candidate
from transport.search.kinds_of_events import (
    Death,
    DrawnSilence,
    DrawnTeam,
    Event,
    Gusts,
    Links,
    ModelError,
    SensorsOff,
    TargetEvent,
)
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
    lambda start, ticks, who: DrawnSilence(
        start_s=round(start * PERIOD_S, 6), duration_s=round(ticks * PERIOD_S, 6), who=who
    ),
    st.integers(0, 60),
    st.integers(1, 50),
    WHO,
)


@settings(max_examples=40)
@given(silences=st.lists(SILENCES, max_size=3))
def test_overlapping_silences_lose_exactly_the_messages_that_one_covers(
    silences: list[DrawnSilence],
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


def losses(changed: Scenario, times_s: Sequence[float]) -> list[tuple[float, float]]:
    """Return the losses from agent 4 to agent 1, and from agent 1 to agent 4, at some times."""
    pairs = (("agent4", "agent1"), ("agent1", "agent4"))
    links = [Link(changed.links, *pair, seed=0, period_s=PERIOD_S) for pair in pairs]
    ticks = [round(time_s / PERIOD_S) for time_s in times_s]
    first, second = ([link.impairments(tick).loss for tick in ticks] for link in links)
    return list(zip(first, second, strict=True))


def test_after_a_silence_a_link_has_the_loss_of_the_scenario() -> None:
    """Also where an exception or a change of the scenario has set another one, even meanwhile."""
    own = [
        "links.override=[{from='agent4',loss=0.5}]",
        "links.change=[{at_s=2.0,from='agent1',loss=0.25},{at_s=4.0,delay_s=0.1,loss=0.125}]",
    ]
    base = Base(scenario=read_scenario(FILE, own), source=str(FILE))
    changed = Candidate((DrawnSilence(start_s=1.0, duration_s=2.0),)).scenario(base)
    assert losses(changed, [0.5, 1.5, 2.5, 3.5, 4.5]) == [
        (0.5, 0.0),
        (1.0, 1.0),
        (1.0, 1.0),
        (0.5, 0.25),
        (0.125, 0.125),
    ]


@pytest.mark.parametrize(
    "own",
    [
        "links.override=[{from='agent4',loss=0.5}]",
        "links.trace=[[0.0,0.05],[1.0,0.1]]",
        "links={distribution='empirical',samples_s=[0.05]}",
    ],
)
def test_links_of_a_candidate_are_those_of_every_pair(own: str) -> None:
    """They take the place of exceptions, of recorded and of measured delays."""
    base = Base(scenario=read_scenario(FILE, [own]), source=str(FILE))
    changed = Candidate((Links(delay_s=0.3, loss=0.0),)).scenario(base)
    for pair in (("agent4", "agent1"), ("agent1", "agent2")):
        link = Link(changed.links, *pair, seed=0, period_s=PERIOD_S)
        assert {delay for tick in range(TICKS) for delay in link.delays(tick)} == {0.3}


def test_a_run_has_one_seed() -> None:
    """Sensors beside gusts have the draws of their seed, and say no other."""
    space = Space(("gusts", "sensors"), Bounds(), BASE.scenario)
    candidate = space.candidate(np.full(space.dimension, 0.9))
    seed = candidate.scenario(BASE).seed
    assert f"seed {seed}" in candidate.in_words()
    assert candidate.in_words().count("seed") == 1


def test_teams_that_the_scenario_does_not_allow_are_left_out() -> None:
    """A scenario that names agent 4 has no smaller team."""
    named = read_scenario(FILE, ["links.override=[{from='agent4',loss=0.5}]"])
    base = Base(scenario=named, source=str(FILE))
    assert list(Candidate(()).smaller_teams(base)) == []
    assert len(list(Candidate(()).smaller_teams(BASE))) > 0


def test_smaller_teams_have_the_uavs_of_the_scenario() -> None:
    """A smaller team of `eight`, whose UAVs are not the paper's, can fly with its limits."""
    file = SCENARIOS / "eight.toml"
    base = Base(scenario=read_scenario(file), source=str(file))
    (smaller,) = Candidate(()).smaller_teams(base)
    assert [uav.mass_kg for uav in smaller.scenario.system.uav] == [0.6, 0.6]
    Setup.of(smaller.scenario, str(file))


def test_links_that_change_alike_are_one_entry() -> None:
    """The whole network is one change and its end another; an agent that is not heard likewise."""
    for who in ("all", "mute 3", "deaf 2"):
        silence = DrawnSilence(start_s=1.0, duration_s=2.0, who=who)
        assert len(Candidate((silence,)).scenario(BASE).links.change) == 2, who


# Bounds in which no two of the coordinates below give the same number.
BOUNDS = Bounds.model_validate({
    "silence": {"loss": (0.2, 1.0)},
    "mass": {"motor_lag_s": (0.0, 0.1)},
})  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "point", "event"),
    [
        (
            *("silence", [0.5, 0.5, 0.1, 0.5, 0.99, 0.5, 0.4]),
            DrawnSilence(start_s=10.5, duration_s=1.45, who="cut 3 1", loss=0.6),
        ),
        (
            *("silence", [0.5, 0.0, 1.0, 1.0, 0.3, 0.99, 0.0]),
            DrawnSilence(start_s=1.0, duration_s=10.0, who="mute 4", loss=1.0),
        ),
        (
            *("silence", [1.0, 1.0, 0.0, 1.0, 0.5, 0.25, 0.0]),
            DrawnSilence(start_s=20.0, duration_s=0.5, who="deaf 2", loss=1.0),
        ),
        # The last of the other three agents.
        (
            *("silence", [0.5, 0.5, 0.1, 0.5, 0.99, 0.5, 1.0]),
            DrawnSilence(start_s=10.5, duration_s=1.45, who="cut 3 2", loss=0.6),
        ),
        ("silence", [0.49, 0.5, 0.1, 0.5, 0.99, 0.5, 0.4], None),
        ("deaths", [0.5, 0.25, 0.99, 0.5, 0.2], Death(agent=4, at_s=5.75)),
        ("deaths", [0.5, 0.25, 0.0, 0.51, 0.2], Death(agent=1, at_s=5.75, back_after_s=2.0)),
        ("deaths", [0.49, 0.25, 0.0, 0.51, 0.2], None),
        ("links", [0.5, 0.1, 0.25], Links(delay_s=0.2, jitter_s=0.01, loss=0.15)),
        ("links", [0.0, 0.0, 0.0], None),
        ("gusts", [0.25, 0.5], Gusts(speed_mps=0.25, seed=500)),
        ("gusts", [0.0, 0.5], None),
        ("mass", [0.2, 0.5], ModelError(mass_factor=0.95, motor_lag_s=0.05)),
        ("mass", [0.4, 0.0], None),  # the known mass
        ("sensors", [0.5, 1.0], SensorsOff(factor=0.5, seed=999)),
        # 1.25 m away, a quarter of a turn from x to y; up by a half of it, towards -z.
        ("targets", [0.5, 0.5, 0.5, 0.25, 0.5], TargetEvent(at_s=5.5, offset_m=(0.0, 1.25, 0.0))),
        (
            *("targets", [0.5, 0.0, 0.5, 0.0, 1.0]),
            TargetEvent(at_s=1.0, offset_m=(1.083, 0.0, -0.625)),
        ),
        ("targets", [0.49, 0.0, 0.5, 0.0, 1.0], None),
        ("team", [0.25], DrawnTeam(seed=250)),
    ],
)
def test_coordinates_are_shares_of_the_bounds(
    kind: str, point: list[float], event: Event | None
) -> None:
    """The event of the first slot of a kind at a point of it; the other slots are empty."""
    space = Space((kind,), BOUNDS, BASE.scenario)
    whole = np.zeros(space.dimension)
    whole[: len(point)] = point
    assert space.candidate(whole).events == (() if event is None else (event,))


def test_severe_coordinates_make_an_event_worse() -> None:
    """They are whether there is one, and its length, loss, delay, strength, lag and noise; no times or names."""
    severe = {
        "silence": [True, False, True, True, False, False, False] * 2,
        "deaths": [True, False, False, False, False],
        "links": [True, True, True],
        "gusts": [True, False],
        "mass": [False, True],
        "sensors": [True, False],
        "targets": [True, False, False, False, False],
        "team": [False],
    }
    for kind, expected in severe.items():
        assert Space((kind,), Bounds(), BASE.scenario).layout.severe.tolist() == expected, kind
    assert tuple(severe) == KINDS


def test_events_change_the_keys_that_their_words_name() -> None:
    """Times are those of the run, a target is relative to the start, and noise is scaled."""
    own = ("plant.noise.position_m=0.02", "maneuver.start_m=[1.0,0.0,-10.0]")
    base = Base(scenario=read_scenario(FILE, own), source=str(FILE))
    events = (
        Death(agent=2, at_s=1.5, back_after_s=2.25),
        Links(delay_s=0.2, jitter_s=0.01, loss=0.15),
        Gusts(speed_mps=0.5, seed=7),
        ModelError(mass_factor=1.1, motor_lag_s=0.05),
        SensorsOff(factor=0.5, seed=None),
        TargetEvent(at_s=3.0, offset_m=(1.0, 0.5, -0.5)),
    )
    changed = Candidate(events).scenario(base)
    assert [(one.at_s, one.do, one.target) for one in changed.faults.event] == [
        (1.5, "kill", "agent2"),
        (3.75, "restart", "agent2"),
    ]
    assert changed.clock.on_agent_loss == "continue"
    links = changed.links
    assert (links.delay_s, links.jitter_s, links.loss) == (0.2, 0.01, 0.15)
    plant = changed.plant
    assert (plant.wind.gust_mps, changed.seed) == ((0.5, 0.5, 0.5), 7)
    assert (plant.payload_mass_factor, plant.motors.lag_s) == (1.1, 0.05)
    assert plant.noise.position_m == 0.01
    (target,) = changed.maneuver.target
    assert (target.at_s, np.ravel(target.points_m).tolist()) == (3.0, [2.0, 0.5, -10.5])


SILENCE = DrawnSilence(start_s=7.3, duration_s=2.0, loss=0.95)
BACK = Death(agent=1, at_s=0.3, back_after_s=0.7)
TARGET = TargetEvent(at_s=3.0, offset_m=(1.2, 0.0, -0.5))


@pytest.mark.parametrize(
    ("event", "simpler"),
    [
        (
            SILENCE,
            [
                replace(SILENCE, duration_s=1.0),
                replace(SILENCE, start_s=8.3, duration_s=1.0),
                replace(SILENCE, loss=1.0),
                replace(SILENCE, start_s=7.0),
                replace(SILENCE, start_s=7.5),
            ],
        ),
        # Of 0.15 s: a half is too short to be tried, and so is a rounded duration of 0.
        (
            DrawnSilence(start_s=1.0, duration_s=0.15),
            [
                DrawnSilence(start_s=1.0, duration_s=0.1),
            ],
        ),
        (
            BACK,
            [
                replace(BACK, back_after_s=None),
                replace(BACK, back_after_s=1.0),
                replace(BACK, back_after_s=0.5),
                replace(BACK, at_s=0.0),
                replace(BACK, at_s=0.5),
            ],
        ),
        (
            Links(delay_s=0.37, loss=0.2),
            [
                Links(delay_s=0.37),
                Links(loss=0.2),
                Links(delay_s=0.35, loss=0.2),
            ],
        ),
        (
            Gusts(speed_mps=0.73, seed=7),
            [
                Gusts(speed_mps=0.5, seed=7),
                Gusts(speed_mps=0.7, seed=7),
                Gusts(speed_mps=0.73, seed=0),
            ],
        ),
        (
            TARGET,
            [
                replace(TARGET, offset_m=(0.0, 0.0, -0.5)),
                replace(TARGET, offset_m=(1.2, 0.0, 0.0)),
                replace(TARGET, offset_m=(1.0, 0.0, 0.0)),
            ],
        ),
        (
            SensorsOff(factor=0.5, seed=3),
            [SensorsOff(factor=1.0, seed=3), SensorsOff(factor=0.5, seed=0)],
        ),
        (
            ModelError(mass_factor=1.12, motor_lag_s=0.05),
            [
                ModelError(mass_factor=1.0, motor_lag_s=0.05),
                ModelError(mass_factor=1.0, motor_lag_s=0.05),
                ModelError(mass_factor=1.1, motor_lag_s=0.05),
                ModelError(mass_factor=1.12),
            ],
        ),
        # A return at once would be no death.
        (
            Death(agent=1, at_s=1.0, back_after_s=0.2),
            [Death(agent=1, at_s=1.0)],
        ),
        (
            TargetEvent(at_s=0.2, offset_m=(0.4, 0.0, 0.0)),
            [TargetEvent(at_s=0.0, offset_m=(0.4, 0.0, 0.0))],
        ),
        (SensorsOff(factor=1.0, seed=None), []),
        (DrawnTeam(seed=1), []),
    ],
)
def test_simpler_versions_of_an_event(event: Event, simpler: list[Event]) -> None:
    """Each changes one thing: half of a window, no other impairment, a rounder number, the roundest first."""
    assert list(event.simpler()) == simpler


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

    event = DrawnSilence(start_s=7.317, duration_s=9.9, who="all", loss=0.95)
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
        DrawnSilence(start_s=4.0, duration_s=2.0, who="cut 2 3"),
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
    # Times that it does not give fit the run, as without a file.
    assert bounds.silence.start_s == (1.0, 20.0)
    assert read_bounds(file, 10.0).silence.start_s == (1.0, 8.0)
    assert read_bounds(file, 10.0).targets.at_s == (1.0, 4.0)
    short = read_bounds(file, 0.5)
    assert short.silence.start_s == short.deaths.at_s == short.targets.at_s == (0.4, 0.4)
    file.write_text("[silence]\nstart_s = [3.0, 30.0]\n", encoding="utf-8")
    assert read_bounds(file, 10.0).silence.start_s == (3.0, 30.0)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[mass]\n", "mass: expected bounds of --over silence,deaths only"),
        (
            "[silence]\nstart_s = [20.0, 30.0]\n",
            "silence.start_s: expected times in the run of 8 s, got [20.0, 30.0]",
        ),
        (
            "[deaths]\nat_s = [8.0, 9.0]\n",
            "deaths.at_s: expected times in the run of 8 s, got [8.0, 9.0]",
        ),
    ],
)
def test_bounds_without_effect_are_refused(text: str, problem: str, tmp_path: Path) -> None:
    """Such are those of events that are not drawn, and times after the run."""
    file = tmp_path / "bounds.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError) as refusal:
        read_bounds(file, 8.0, ("silence", "deaths"))
    assert str(refusal.value) == f"{file}: {problem}"


REFUSED = {
    "[silence]\nduration_s = [2.0, 1.0]\n": "silence.duration_s: expected smallest <= largest",
    "[silence]\nwho = ['some']\n": "silence.who.1: expected 'all', 'mute', 'deaf' or 'cut'",
    "[silence]\nwho = []\n": "silence.who",
    "[silences]\n": "silences: unknown key; did you mean 'silence'?",
    "[deaths]\ncount = 0\n": "deaths.count: expected greater than or equal to 1",
    "[links]\nloss = [0.0, 2.0]\n": "links.loss.2: expected a share, at most 1, got 2",
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


@pytest.mark.parametrize(
    ("event", "words", "of_network"),
    [
        (
            *(replace(SILENCE, who="mute 3"), "from 7.3 to 9.3 s agent 3 is not heard (95 % of the messages)"),
            True,
        ),
        (DrawnSilence(start_s=1.0, duration_s=2.0, who="deaf 2"), "from 1 to 3 s agent 2 hears nothing", True),
        (replace(BACK, at_s=2.0), "at 2 s agent 1 dies and is back after 0.7 s", True),
        (
            Links(delay_s=0.2, jitter_s=0.01, loss=0.15),
            "links with 200 ms of delay, 10 ms of jitter and 15 % of loss",
            True,
        ),
        (Gusts(speed_mps=0.5, seed=7), "gusts of 0.5 m/s, seed 7", False),
        (
            ModelError(mass_factor=1.1, motor_lag_s=0.05),
            "a payload of 110 % of the known mass, 50 ms of motor lag",
            False,
        ),
        (SensorsOff(factor=0.5, seed=3), "sensor noise of 0.5 times the scenario's, seed 3", False),
        (SensorsOff(factor=0.5, seed=None), "sensor noise of 0.5 times the scenario's", False),
        (TARGET, "at 3 s a target (1.2, 0, -0.5) m from the start", False),
        (DrawnTeam(seed=4), "the drawn team 4", False),
    ],
)  # fmt: skip
def test_an_event_is_told_with_its_numbers(event: Event, words: str, *, of_network: bool) -> None:
    """In milliseconds and percent; only events of the network spare one agent for all UAVs."""
    assert event.in_words() == words
    assert event.of_network is of_network
    assert len(Candidate((event,)).beyond_network().events) == (not of_network)
