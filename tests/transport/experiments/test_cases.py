"""Cases of an experiment: which runs are repeated, and what makes a result that of another run."""

import dataclasses
from pathlib import Path

import pytest

from transport.experiments.cases import Case, Point, cases_of, is_random, key_of
from transport.experiments.run_numbers import resource_use
from transport.experiments.simulation import ERROR, simulate
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario

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


@pytest.mark.parametrize("version", ["version", "engine_version", "controller_versions"])
def test_a_result_is_that_of_its_versions(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the package, the engine of the plant and the controllers: another one makes another result."""
    scenario = read_scenario(find_scenario("paper"))
    before = key_of(scenario)
    monkeypatch.setattr(f"transport.experiments.cases.{version}", lambda _: "another")
    assert key_of(scenario) != before


def test_the_settings_of_a_point_take_the_place_of_those_of_all() -> None:
    """A run has the loss of its row in the table, whatever is set for the whole sweep."""
    links = LOSSY.read(["links.loss=0.1", "links.delay_s=0.2"]).links
    assert (links.loss, links.delay_s) == (0.5, 0.2)


def test_large_runs_are_refused_unless_they_are_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points that have been simulated before are not set up again."""
    large = ["plant.step_s=1e-6"]
    with pytest.raises(ScenarioError, match="--allow-large admits more"):
        cases_of([LOSSY], large, 1)
    assert len(cases_of([LOSSY], large, 1, allow_large=True)) == 1

    checked: list[Path] = []
    monkeypatch.setattr("transport.experiments.cases.check", lambda _, path: checked.append(path))
    for simulated_before, count in ((True, 0), (False, 1)):
        cases_of([LOSSY], (), 1, simulated_before=simulated_before)
        assert len(checked) == count


def test_fingerprints_tell_results_apart() -> None:
    """The key changes with a setting and with the seed, and not with the address the processes listen on."""
    first, second = cases(seeds=2)
    assert first.key != second.key
    assert cases("network.base_port=9000")[0].key == first.key
    assert cases("controller.horizon=19")[0].key != first.key
