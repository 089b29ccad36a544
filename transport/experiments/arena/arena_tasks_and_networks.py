"""Tasks and networks of the arena, each with a version.

A task has system, maneuver, weights, limits and weather. Algorithms differ in their controller only.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# Of the arena as a whole: increased with every change of a task, a network or a measure.
VERSION = 2

# Scenario of all tasks, for its system, weights, horizon and limits.
SCENARIO = "paper"

# A maneuver of 10 s: up and sideways at 0.5 m/s, as fast as the paper's, and a hover of 5 s.
_HOP = (
    "maneuver.phase=["
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=2.0,displacement_m=[0,0,-1]},"
    "{name='translate',duration_s=2.0,displacement_m=[1,0,0]},"
    "{name='hover',duration_s=5.0,displacement_m=[0,0,0]}]"
)
_HOVER = "maneuver.phase=[{name='hover',duration_s=10.0,displacement_m=[0,0,0]}]"
_EIGHT = (
    "maneuver.phase=["
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='eight',kind='eight',size_m=[4.0,2.0,0.0],laps=1.0,speed_mps=1.2,ramp_s=2.0},"
    "{name='hover',duration_s=2.0,displacement_m=[0,0,0]}]"
)
_SILENT_S, _HEARD_S = 3.0, 8.0

# Only one agent knows what the others need.
_TOLD = (
    "maneuver.phase=[{name='hover',duration_s=14.0,displacement_m=[0,0,0]}]",
    "maneuver.target=[{at_s=1.0,points_m=[[1.5,0,-10]],to=[1]},{at_s=6.0,points_m=[[1.5,1.5,-11]],to=[1]}]",
)
# A platform that one agent sees: a target for it every half second, at 1 m/s with random turns.
_FOLLOW_S, _EVERY_S, _PLATFORM_MPS = 10.0, 0.5, 1.0
_TURN_RAD = 0.6  # standard deviation of each turn
_TURNS_SEED = 5


def _follow() -> tuple[str, ...]:
    """Return the settings of a platform to follow, and a hover after it."""
    turns = np.random.default_rng(_TURNS_SEED).normal(0.0, _TURN_RAD, round(_FOLLOW_S / _EVERY_S))
    headings = np.cumsum(turns)
    steps_m = _PLATFORM_MPS * _EVERY_S * np.column_stack([np.cos(headings), np.sin(headings)])
    targets = []
    for number, (x, y) in enumerate(np.cumsum(steps_m, axis=0).tolist()):
        at_s = 1.0 + _EVERY_S * number
        targets.append(f"{{at_s={at_s},points_m=[[{x:.3f},{y:.3f},-10]],to=[1]}}")
    duration_s = _FOLLOW_S + 8.0
    hover = f"maneuver.phase=[{{name='hover',duration_s={duration_s},displacement_m=[0,0,0]}}]"
    return hover, f"maneuver.target=[{','.join(targets)}]"


# Past a wall that reaches into the way of one side only, seen from 1.2 m on: UAV 1 is next to it.
_BLOCKED = (
    "maneuver.phase=["
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='go',kind='spline',points_m=[[6,0,0]],speed_mps=0.8,ramp_s=2.0},"
    "{name='hover',duration_s=12.0,displacement_m=[0,0,0]}]",
    "obstacle=[{kind='box',at_m=[3.0,1.25,-10],size_m=[0.2,1.5,8],margin_m=0.3,seen_within_m=1.2}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A task of the arena."""

    text: str
    settings: tuple[str, ...]  # of the scenario, with which the centralized optimum is computed too
    failures: tuple[str, ...] = ()  # what the centralized optimum is spared: deaths and silence
    uavs: int = 4
    version: int = 1


def _silence(uavs: int) -> str:
    """Return the setting that cuts all agents apart from one time to another."""
    cuts = [
        f"{{between=['agent{agent}'],start_s={_SILENT_S},end_s={_HEARD_S}}}"
        for agent in range(1, uavs)
    ]
    return f"links.partition=[{','.join(cuts)}]"


TASKS: Mapping[str, Task] = {
    "maneuver": Task(text="the paper's maneuver, 25 s", settings=()),
    "eight": Task(
        text="an eight of 4 m x 2 m at 1.2 m/s; the reference hangs below hovering UAVs",
        settings=(_EIGHT,),
    ),
    "gusts": Task(
        text="hover of 10 s in gusts of 1 m/s",
        settings=(_HOVER, "plant.wind.gust_mps=[1.0,1.0,1.0]"),
    ),
    "heavier": Task(
        text="up and sideways by 1 m in 4 s and a hover of 5 s, with a payload 15 % heavier than known",
        settings=(_HOP, "plant.payload_mass_factor=1.15"),
    ),
    "death": Task(
        text="the same path; agent 3 dies for good at 3 s and its UAV keeps to its part of the path",
        settings=(_HOP,),
        failures=(
            "clock.on_agent_loss=continue",
            "controller.fail_safe=follow",
            f"faults.event=[{{at_s={_SILENT_S},do='kill',target='agent3'}}]",
        ),
    ),
    "silence": Task(
        text="the same path; no message from 3 to 8 s",
        settings=(_HOP,),
        failures=(_silence(4),),
    ),
    "shared": Task(
        text="the same path; the thrusts of the team together are at most 92 N, at hover 88.3 N",
        settings=(
            _HOP,
            "controller.constraint=[{expression='thrust1+thrust2+thrust3+thrust4<=92.0'}]",
        ),
    ),
    "eight UAVs": Task(text="the same path with eight UAVs", settings=(_HOP,), uavs=8),
    "told": Task(
        text="a hover of 14 s; agent 1 alone is told a target 1.5 m away at 1 s, and another one at 6 s",
        settings=_TOLD,
    ),
    "follow": Task(
        text="a platform at 1 m/s with random turns: every half second its place is a target for agent 1 alone",
        settings=_follow(),
    ),
    "blocked": Task(
        text="6 m at 0.8 m/s past a wall that no agent knows before its own UAV is within 1.2 m",
        settings=_BLOCKED,
    ),
}

NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": (),
    "late": ("links.delay_s=0.2", "links.loss=0.3"),
    # In equilibrium 30 % of the time is spent in bursts of 10 ticks on average.
    "bursts": (f"links.gilbert_elliott={{enter={0.1 * 0.3 / 0.7!r},leave=0.1,loss=1.0}}",),
    # Computation short enough for ten exchanges within a period of 50 ms.
    "radio": ("radio={background=0.2,computation_mean_s=0.002,computation_deviation_s=0.0005}",),
    # Every algorithm is one without messages here.
    "none": ("links.loss=1.0",),
}
PERFECT = "perfect"
NETWORK_TEXTS: Mapping[str, str] = {
    "perfect": "every plan arrives at once",
    "late": "200 ms delay, 30 % packet loss",
    "bursts": "30 % of the plans lost, in bursts of 0.5 s on average",
    "radio": "one 802.11a channel at 6 Mb/s with a slot for each agent and 20 % traffic of others",
    "none": "no plan arrives",
}
