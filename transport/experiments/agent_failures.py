"""Agents killed during the maneuver: each in turn, or random agents at random times."""

import math
from collections.abc import Mapping

import numpy as np

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.errors import refused
from transport.experiments.experiment import NONE, Experiment, check_numbers
from transport.experiments.quantities import Axis, axis

NEVER = "never"

_CONTINUE = "clock.on_agent_loss=continue"


def kill(agents: Mapping[str, int], kill_s: float, restart_s: float) -> Experiment:
    """Return the sweep in which each agent in turn is killed, with and without a restart; times are scenario times, s.

    The number of agents is given for each scenario.
    """
    check_numbers("--at", [kill_s], "a time >= 0 s", 0.0)
    if not kill_s < restart_s < math.inf:
        raise refused("--restart", f"a time after --at {kill_s:g} s", f"{restart_s:g}")
    points: list[Point] = []
    for scenario, count in agents.items():
        labels: dict[str, str | float] = {"agent": NONE, "restart_s": NONE}
        points.append(
            Point(scenario=scenario, labels=labels, text="no agent killed", settings=(_CONTINUE,), baseline=True)
        )
        for back_s in (restart_s, None):
            for agent in range(1, count + 1):
                events = [_event(kill_s, "kill", agent)] + ([_event(back_s, "restart", agent)] if back_s else [])
                how = "not restarted" if back_s is None else f"restarted after {back_s - kill_s:g} s"
                points.append(
                    Point(
                        scenario=scenario,
                        labels={"agent": str(agent), "restart_s": back_s or NEVER},
                        text=f"agent{agent} {how}",
                        settings=(_CONTINUE, f"faults.event=[{','.join(events)}]"),
                    )
                )
    legend: dict[str | float, str] = {restart_s: f"restarted at {restart_s:g} s", NEVER: "not restarted"}
    along = Axis("agent", f"agent killed at {kill_s:g} s")
    return Experiment(name="kill", points=tuple(points), x=along, curves="restart_s", legend=legend)


def deaths(scenarios: Mapping[str, Scenario], count: int, draw: int) -> Experiment:
    """Return runs in each of which a random agent is killed for good at a random time, and a run without a kill.

    Count is the number of runs with a kill for each scenario; draw is the random seed of times and agents.
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
        labels: dict[str, str | float] = {"agent": NONE, "killed_s": 0.0}
        points.append(Point(scenario=name, labels=labels, text="no agent killed", settings=(_CONTINUE,), baseline=True))
        points += [
            Point(
                scenario=name,
                labels={"agent": str(agent), "killed_s": killed_s},
                text=f"agent{agent} killed at {killed_s:g} s",
                settings=(_CONTINUE, f"faults.event=[{_event(killed_s, 'kill', agent)}]"),
            )
            for tick, agent in killed
            for killed_s in (round(tick * period_s, 6),)
        ]
    return Experiment(name="deaths", points=tuple(points), x=axis("killed_s"))


def _event(at_s: float, action: str, agent: int) -> str:
    return f'{{at_s={at_s!r},do="{action}",target="agent{agent}"}}'
