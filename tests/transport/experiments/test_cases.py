"""Cases of an experiment: which runs are repeated, and what makes a result that of another run."""

import dataclasses

import pytest

from transport.experiments.cases import Case, Point, cases_of, is_random
from transport.experiments.run_numbers import resource_use
from transport.experiments.simulation import ERROR, simulate
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

LOSSY = Point(labels={"loss": 0.5}, text="50 %", settings=("links.loss=0.5",), scenario="paper")


def cases(*settings: str, seeds: int = 1) -> list[Case]:
    """Return the runs of the paper's scenario with half of the plans lost."""
    return cases_of([LOSSY], settings, seeds)


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("links.delay_s=0.2", False),
        ("links.distribution=normal", False),
        ("links.jitter_s=0.01", True),
        ("links.loss=0.01", True),
        ("links.reorder=0.01", True),
        ("links.duplicate=0.01", True),
        ("links.gilbert_elliott={enter=0.1,leave=0.1}", True),
        ("links={distribution='empirical',samples_s=[0.05,0.1]}", True),
        ("links.override=[{from='agent1',loss=0.5}]", True),
        ("links.change=[{at_s=1.0,loss=0.5}]", True),
        ("plant.noise.position_m=0.01", True),
        ("radio={offsets='random'}", True),
        ("plant.wind.gust_mps=[0.0, 0.1, 0.0]", True),
        ("plant.wind.speed_mps=[1.0, 0.0, 0.0]", False),
    ],
)
def test_chance_is_seen(setting: str, expected: bool) -> None:
    """Every setting that draws random numbers is recognised."""
    assert is_random(read_scenario(find_scenario("paper"), [setting])) is expected


def test_random_and_timed_runs_are_repeated() -> None:
    """A deterministic run has the seed 0 alone, unless its processor time is measured.

    Settings by seed are one run each, whatever the number of seeds.
    """
    still = dataclasses.replace(LOSSY, settings=())
    drawn = dataclasses.replace(LOSSY, by_seed=(("links.delay_s=0.1",), ("links.delay_s=0.2",)))
    flown = {
        "random": cases_of([LOSSY], (), 3),
        "deterministic": cases_of([still], (), 3),
        "timed": cases_of([still], (), 3, more=resource_use),
        "drawn": cases_of([drawn], (), 3),
    }
    seeds = {name: [case.scenario.seed for case in own] for name, own in flown.items()}
    assert seeds == {"random": [0, 1, 2], "deterministic": [0], "timed": [0, 1, 2], "drawn": [0, 1]}
    assert [case.scenario.links.delay_s for case in flown["drawn"]] == [0.1, 0.2]


def test_a_case_of_another_version_is_an_error() -> None:
    """A case whose fingerprint is not that of the running package is refused, and not simulated."""
    (case,) = cases()
    result = simulate(dataclasses.replace(case, key="another"))
    assert (result.key, result.outcome, result.numbers) == ("another", ERROR, {})
    assert "got another version" in result.reason


def test_fingerprints_tell_results_apart() -> None:
    """The key changes with a setting and with the seed, and not with the address the processes listen on."""
    first, second = cases(seeds=2)
    assert first.key != second.key
    assert cases("network.base_port=9000")[0].key == first.key
    assert cases("controller.horizon=19")[0].key != first.key
