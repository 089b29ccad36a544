"""An agent killed for good at random times of the maneuver: whether the others bring the load home."""

import math
from collections.abc import Mapping

import numpy as np

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.catalogue import Axis, Experiment
from transport.experiments.errors import refused


def deaths(scenarios: Mapping[str, Scenario], count: int, draw: int) -> Experiment:
    """Random agents killed at random times, one in each run and never restarted; and a run without a death.

    Args:
        scenarios: What is run, by name or file.
        count: Deaths of each scenario.
        draw: Seed of the times and of who is killed.
    """
    if count < 1:
        raise refused("--count", "a number of runs >= 1", count)
    points = []
    for name, scenario in scenarios.items():
        period_s = scenario.controller.sampling_period_s
        duration_s = sum(phase.duration_s for phase in scenario.maneuver.phase)
        rng = np.random.default_rng(draw)
        ticks = rng.choice(math.ceil(duration_s / period_s), size=count, replace=False)
        killed = sorted((int(tick), 1 + int(rng.integers(len(scenario.owned)))) for tick in ticks)
        points.append(_point(name, 0.0, "none", baseline=True))
        points += [_point(name, round(tick * period_s, 6), str(agent)) for tick, agent in killed]
    return Experiment(name="deaths", points=tuple(points), x=Axis("killed_s", "time of death (s)"))


def _point(scenario: str, killed_s: float, agent: str, *, baseline: bool = False) -> Point:
    settings = ["clock.on_agent_loss=continue"]
    if not baseline:
        settings.append(f'faults.event=[{{at_s={killed_s!r},do="kill",target="agent{agent}"}}]')
    return Point(
        scenario=scenario,
        labels={"agent": agent, "killed_s": killed_s},
        text="no agent killed" if baseline else f"agent{agent} killed at {killed_s:g} s",
        settings=tuple(settings),
        baseline=baseline,
    )
