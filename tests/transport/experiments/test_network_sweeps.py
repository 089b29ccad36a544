"""Sweeps over the network and agent failures: valid points, and impairments with the stated statistics."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.links import link
from transport.experiments import agent_failures, network_sweeps
from transport.experiments.cases import Point, cases_of, is_random
from transport.experiments.errors import ExperimentError
from transport.experiments.experiment import Experiment

TICKS = 6_000
BOTH = ["paper", "resilient"]
EVERY = (
    network_sweeps.latency(BOTH, [0.1, 0.4]),
    network_sweeps.loss(BOTH, [0.1, 0.6], 5.0),
    network_sweeps.jitter(BOTH, list(network_sweeps.JITTER), [0.02, 0.08], 0.16),
    agent_failures.kill({"paper": 4, "resilient": 4}, 8.0, 10.0),
    network_sweeps.matrix(BOTH, [0.1], [0.3, 1.0]),
)


def delays(point: Point) -> list[list[float]]:
    """Return the delays of many plans on a link of a point."""
    scenario = read_scenario(find_scenario(point.scenario), point.settings)
    path = link(scenario.links, "agent1", "agent2", kind="plan", seed=0, period_s=0.05, samples_s={})
    return [path.delays(tick) for tick in range(TICKS)]


@pytest.mark.parametrize("experiment", EVERY, ids=lambda experiment: experiment.name)
def test_every_point_is_valid(experiment: Experiment) -> None:
    """All points are valid scenarios with distinct fingerprints; each scenario has one baseline."""
    cases = cases_of(experiment.points, [], 3)
    assert len({case.key for case in cases}) == len(cases)
    assert [point.scenario for point in experiment.points if point.baseline] == BOTH
    assert len({tuple(point.labels) for point in experiment.points}) == 1
    assert {experiment.x.label} <= set(experiment.points[0].labels)
    repetitions = [sum(case.point == i for case in cases) for i in range(len(experiment.points))]
    assert set(repetitions) <= {1, 3}


def test_only_chance_is_repeated() -> None:
    """Deterministic points run once, random points once per seed."""
    points = network_sweeps.matrix(["paper"], [0.0, 0.1], [0.0, 0.3]).points
    seeds = [(case.point, case.scenario.seed) for case in cases_of(points, [], 2)]
    assert seeds == [(0, 0), (1, 0), (1, 1), (2, 0), (3, 0), (3, 1)]


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
        ("links.override=[{from='agent1',loss=0.5}]", True),
        ("links.change=[{at_s=1.0,loss=0.5}]", True),
        ("plant.noise.position_m=0.01", True),
        ("plant.wind.gust_mps=[0.0, 0.1, 0.0]", True),
        ("plant.wind.speed_mps=[1.0, 0.0, 0.0]", False),
    ],
)
def test_chance_is_seen(setting: str, expected: bool) -> None:
    """Every setting that draws random numbers is recognised."""
    assert is_random(read_scenario(find_scenario("paper"), [setting])) is expected


def test_fingerprints_tell_results_apart() -> None:
    """The key changes with a setting and with the seed, and not with the address the processes listen on."""
    points = network_sweeps.loss(["paper"], [0.5], 5.0).points[1:2]
    first, second = cases_of(points, [], 2)
    assert first.key != second.key
    assert cases_of(points, ["network.base_port=9000"], 1)[0].key == first.key
    assert cases_of(points, ["controller.horizon=19"], 1)[0].key != first.key


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_losses_are_comparable(share: float) -> None:
    """Independent and bursty losses have the same share in the long run; bursts last as long as asked for."""
    _, independent, bursts = network_sweeps.loss(["paper"], [share], 5.0).points
    for point, correlated in ((independent, 1.0), (bursts, 10.0)):
        lost = np.array([not found for found in delays(point)])
        deviation = math.sqrt(share * (1.0 - share) * correlated / TICKS)
        assert abs(lost.mean() - share) < 4.0 * deviation
    ends = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    lengths = ends[1::2] - ends[::2]
    # A geometric length of mean 5 has a standard deviation of 4.5.
    assert abs(lengths.mean() - 5.0) < 4.0 * 4.5 / math.sqrt(len(lengths))


@pytest.mark.parametrize("distribution", list(network_sweeps.JITTER))
def test_jitters_are_comparable(distribution: str) -> None:
    """Every distribution has the mean and the standard deviation asked for."""
    point = network_sweeps.jitter(["paper"], [distribution], [0.04], 0.16).points[-1]
    found_s = np.array([delay for found in delays(point) for delay in found])
    assert len(found_s) == TICKS
    assert abs(found_s.mean() - 0.16) < 4.0 * 0.04 / math.sqrt(TICKS)
    # Four standard deviations of it: by the kurtosis, at most 9 but for the lognormal distribution with its 114.
    kurtosis = 114.0 if distribution == "lognormal" else 9.0
    assert abs(found_s.std() - 0.04) < 4.0 * 0.04 * math.sqrt((kurtosis - 1.0) / (4.0 * TICKS))


def test_jitter_is_compared_to_a_constant_delay() -> None:
    """Without jitter there is the perfect network and the mean delay alone."""
    perfect, constant = network_sweeps.jitter(["paper"], [], [], 0.16).points
    assert delays(perfect)[0] == [0.0]
    assert delays(constant)[0] == [0.16]


def test_real_time_is_refused() -> None:
    """An experiment's numbers must not depend on the machine."""
    with pytest.raises(ScenarioError, match=r"clock\.mode: expected lockstep, got realtime"):
        cases_of(network_sweeps.latency(["paper"], []).points, ["clock.mode=realtime", "clock.speed=1.0"], 1)


REFUSED: list[tuple[Callable[[], Experiment], str]] = [
    (lambda: network_sweeps.latency(BOTH, [-0.1]), "--delay: expected a delay >= 0 s, got -0.1"),
    (lambda: network_sweeps.latency(BOTH, [math.nan]), "--delay: expected a delay >= 0 s, got nan"),
    (lambda: network_sweeps.latency(BOTH, [math.inf]), "--delay: expected a delay >= 0 s, got inf"),
    (lambda: network_sweeps.latency(BOTH, [0.1, 0.1]), "--delay: expected each value once, got 0.1 2 times"),
    (lambda: network_sweeps.latency(["paper"] * 2, [0.1]), "--scenario: expected each value once, got paper 2 times"),
    (lambda: network_sweeps.loss(BOTH, [1.0], 5.0), "--loss: expected a share from 0 to below 1, got 1"),
    (lambda: network_sweeps.loss(BOTH, [0.3], 0.5), "--burst: expected a mean length >= 1 tick, got 0.5"),
    (
        lambda: network_sweeps.loss(BOTH, [0.9], 2.0),
        "--loss: expected at most 0.667 with bursts of 2 ticks on average, got 0.9",
    ),
    (lambda: network_sweeps.jitter(BOTH, ["cauchy"], [0.1], 0.2), "--distribution: expected one of uniform, normal,"),
    (
        lambda: network_sweeps.jitter(BOTH, ["uniform"], [0.1], 0.16),
        "--std: expected a standard deviation from 0 to 0.0924 s (uniform, mean 0.16 s), got 0.1",
    ),
    (lambda: agent_failures.kill({"paper": 4}, 8.0, 8.0), "--restart: expected a time after --at 8 s, got 8"),
    (lambda: agent_failures.kill({"paper": 4}, -1.0, 8.0), "--at: expected a time >= 0 s, got -1"),
    (lambda: network_sweeps.matrix(BOTH, [0.1], [1.5]), "--loss: expected a share from 0 to 1, got 1.5"),
]


@pytest.mark.parametrize(("build", "expected"), REFUSED, ids=[expected for _, expected in REFUSED])
def test_bad_values_are_refused(build: Callable[[], Experiment], expected: str) -> None:
    """A value that cannot be is refused with option, expected and got."""
    with pytest.raises(ExperimentError) as refusal:
        build()
    assert str(refusal.value).startswith(expected)
