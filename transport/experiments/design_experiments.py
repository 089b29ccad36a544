"""Experiments with the algorithm and the team: its parts, horizon, a long hover, team size, and agents that fail."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point, Team, refused
from transport.experiments.declaration import NONE, Axis, Experiment, Range, Values, axis, declared
from transport.experiments.network_experiments import NETWORKS

AS_IT_IS, NEVER, CENTRALIZED = "as it is", "never", "centralized"

# Settings of each part by its name. Those that a scenario has anyway, or that conflict with its other settings, are
# left out.
PARTS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "prediction": ("controller.prediction", ("open_loop", "closed_loop")),
    "terminal": ("controller.terminal", ("multiple", "riccati")),
    "preview": ("controller.preview", ("false", "true")),
    "relaxation": ("controller.relaxation", ("1.0", "0.5", "0.25", "0.1")),
    "negotiation iterations": ("controller.negotiation_iterations", ("1", "2", "4")),
    "received plans": ("controller.received_plans", ("by_age", "by_one", "held")),
    "received states": ("controller.received_states", ("predicted", "as_received")),
    "actuation": ("clock.actuation", ("immediate", "next_tick")),
    "discretisation": ("controller.discretisation", ("exact", "euler")),
}

# End of the horizon in place of a terminal weight.
_COST_TO_GO = "cost-to-go"

# UAVs per agent, by ownership; None: one agent for all.
OWNERSHIPS: Mapping[str, int | None] = {"distributed": 1, "pairs": 2, CENTRALIZED: None}

# Beyond 16 UAVs a tick of the centralized team takes most of a second.
_LARGEST = 16

_CONTINUE = "clock.on_agent_loss=continue"


@declared(defaults={"seeds": 3})
def ablation(scenarios: Mapping[str, Scenario]) -> Experiment:
    """Contribution of each part of the algorithm.

    Changes one setting at a time, on a perfect network and on one with delay and packet loss.

    Example: transport experiment ablation --scenario resilient
    """
    points = []
    for name, scenario in scenarios.items():
        variants = [(AS_IT_IS, "", "")] + [
            (part, value, f"{key}={value}")
            for part, (key, values) in PARTS.items()
            for value in values
            if not _has(scenario, key, value) and _is_possible(scenario, key, value)
        ]
        points += [
            Point(
                scenario=name,
                labels={"network": network, "part": part, "value": value},
                text=f"{part}{' ' if value else ''}{value}, {network}",
                settings=(*links, setting) if setting else links,
                baseline=part == AS_IT_IS and network == "perfect",
            )
            for network, links in NETWORKS.items()
            for part, value, setting in variants
        ]
    return Experiment(name="ablation", points=tuple(points), x=Axis("value", "variant"), drawn_as="variants")


def _has(scenario: Scenario, key: str, value: str) -> bool:
    """Return whether a scenario has a value already."""
    if key == "clock.actuation":
        return value == ("next_tick" if scenario.clock.next_tick else "immediate")
    own: Any = scenario.tree()
    for name in key.split("."):
        own = own[name]
    text = str(own).lower() if isinstance(own, bool) else str(own)
    return text == value or (own == "auto" and value == str(1.0 / len(scenario.owned)))


def _is_possible(scenario: Scenario, key: str, value: str) -> bool:
    """Return whether a value can be combined with the scenario's other settings (docs/keys.md, `[controller]`)."""
    controller = scenario.controller
    chosen = {
        "controller.prediction": controller.prediction,
        "controller.terminal": controller.terminal,
        "controller.preview": str(controller.preview).lower(),
        key: value,
    }
    if chosen["controller.terminal"] == "riccati":
        return bool(controller.weights.penalised_input == "deviation")
    return chosen["controller.preview"] == "false" or chosen["controller.prediction"] == "closed_loop"


@declared(
    horizon=Values(
        [5, 10, 20, 30],
        "STEPS",
        "Steps N_p; by default 5, 10, 20, 30.",
        quick=[10],
        within=Range("a number of steps >= 1", 1.0),
    ),
    terminal=Values(
        [1.0, 5.0, 20.0],
        "WEIGHT",
        "Terminal weight, for open-loop prediction; by default 1, 5, 20.",
        quick=[5.0],
        within=Range("a weight > 0"),
    ),
    delay=Values(0.2, "SECONDS", "Delay of every plan on the second network, s.", within=Range("a delay > 0 s")),
)
def horizon(
    scenarios: Mapping[str, Scenario], horizon: Sequence[int], terminal: Sequence[float], delay: float
) -> Experiment:
    """Effect of horizon and terminal weight.

    Each horizon with each weight, on a perfect network and with a delay.

    Example: transport experiment horizon --horizon 10 --horizon 20 --scenario paper
    """
    points = []
    for name, scenario in scenarios.items():
        # The scenario's own horizon and weight are always included: on a perfect network they are the baseline.
        own_horizon, own_end = scenario.controller.horizon, float(scenario.controller.weights.terminal)
        ends: dict[float | str, tuple[str, list[str]]] = {
            weight: (f"terminal weight {weight:g}", [f"controller.weights.terminal={weight!r}"])
            for weight in sorted({own_end, *terminal})
        }
        baseline: tuple[int, float | str] = own_horizon, own_end
        if scenario.controller.terminal == "riccati":
            baseline, ends = (own_horizon, _COST_TO_GO), {_COST_TO_GO: (_COST_TO_GO, [])}
        points += [
            Point(
                scenario=name,
                labels={"network": network, "horizon": steps, "terminal": end},
                text=f"N_p {steps}, {text}, {network}",
                settings=(f"links.delay_s={delay_s!r}", f"controller.horizon={steps}", *settings),
                baseline=(steps, end) == baseline and delay_s == 0.0,
            )
            for network, delay_s in (("perfect", 0.0), (f"{1e3 * delay:g} ms delay", delay))
            for steps in sorted({own_horizon, *horizon})
            for end, (text, settings) in ends.items()
        ]
    along = axis("horizon", "controller.horizon")
    return Experiment(name="horizon", points=tuple(points), x=along, drawn_as="variants")


@declared(
    scenarios=("paper", "centralized", "resilient", "centralized_lq", "precise"),
    defaults={
        "quick_maneuver": "maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
        "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
    },
    duration=Values(
        [5.0, 20.0, 65.0],
        "SECONDS",
        "Duration of the last phase, s; by default 5, 20, 65.",
        quick=[0.5, 1.0],
        within=Range("a duration > 0 s"),
    ),
)
def hover(scenarios: Mapping[str, Scenario], duration: Sequence[float]) -> Experiment:
    """Stability in a long hover after the maneuver.

    Only the duration of the last phase changes.

    Example: transport experiment hover --duration 60 --scenario resilient
    """
    points = []
    for name, scenario in scenarios.items():
        phases = scenario.maneuver.phase
        if any(phases[-1].displacement_m):
            raise refused("--scenario", "a maneuver that ends with a hover", f"{name}, whose last is {phases[-1].name}")
        points += [  # no run is a baseline: mean costs of runs of different length are not comparable
            Point(
                scenario=name,
                labels={"hover_s": duration_s},
                text=f"{duration_s:g} s of hover",
                settings=(f"maneuver.phase.{len(phases)}.duration_s={duration_s!r}",),
            )
            for duration_s in sorted(duration)
        ]
    return Experiment(name="hover", points=tuple(points), x=axis("hover_s"))


@declared(
    at=Values(8.0, "SECONDS", "Time of the kill, s; by default 8.", quick=0.5, within=Range("a time >= 0 s", 0.0)),
    restart=Values(10.0, "SECONDS", "Time of the restart, s; by default 10.", quick=1.0),
)
def kill(scenarios: Mapping[str, Scenario], at: float, restart: float) -> Experiment:
    """Effect of the death of each agent.

    Kills each agent in turn, with and without a restart, while the others continue.

    Example: transport experiment kill --at 5 --restart 6
    """
    if not at < restart < math.inf:
        raise refused("--restart", f"a time after --at {at:g} s", f"{restart:g}")
    points = []
    for name, scenario in scenarios.items():
        points.append(_without_kill(name, "restart_s", NONE))
        for back_s in (restart, None):
            how = "not restarted" if back_s is None else f"restarted after {back_s - at:g} s"
            for agent in range(1, len(scenario.owned) + 1):
                events = [_event(at, "kill", agent)] + ([_event(back_s, "restart", agent)] if back_s else [])
                points.append(
                    Point(
                        scenario=name,
                        labels={"agent": str(agent), "restart_s": back_s or NEVER},
                        text=f"agent{agent} {how}",
                        settings=(_CONTINUE, f"faults.event=[{','.join(events)}]"),
                    )
                )
    legend: dict[str | float, str] = {restart: f"restarted at {restart:g} s", NEVER: "not restarted"}
    along = Axis("agent", f"agent killed at {at:g} s")
    return Experiment(name="kill", points=tuple(points), x=along, curves="restart_s", legend=legend)


@declared(
    scenarios=("resilient",),
    count=Values(20, "COUNT", "Deaths per scenario; by default 20.", quick=2, least=1),
    draw=Values(0, "SEED", "Random seed of the times and of the agents killed.", least=0),
)
def deaths(scenarios: Mapping[str, Scenario], count: int, draw: int) -> Experiment:
    """Effect of a permanent kill of a random agent.

    Each run kills one agent at a random time and never restarts it; the others continue.

    Example: transport experiment deaths --processes
    """
    points = []
    for name, scenario in scenarios.items():
        period_s = scenario.controller.sampling_period_s
        duration_s = sum(phase.duration_s for phase in scenario.maneuver.phase)
        rng = np.random.default_rng(draw)
        ticks = rng.choice(math.ceil(duration_s / period_s), size=count, replace=False)
        killed = sorted((int(tick), 1 + int(rng.integers(len(scenario.owned)))) for tick in ticks)
        points.append(_without_kill(name, "killed_s", 0.0))
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


def _without_kill(scenario: str, column: str, value: str | float) -> Point:
    labels: dict[str, str | float] = {"agent": NONE, column: value}
    return Point(scenario=scenario, labels=labels, text="no agent killed", settings=(_CONTINUE,), baseline=True)


def _event(at_s: float, action: str, agent: int) -> str:
    return f'{{at_s={at_s!r},do="{action}",target="agent{agent}"}}'


@declared(
    scenarios=(),
    defaults={
        "jobs": 1,
        # The paper's speed, 0.5 m/s, in a maneuver of 10 s instead of 25.
        "maneuver": "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
        "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
        "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]",
    },
    max=Values(
        12,
        "COUNT",
        "UAVs of the largest team, 2 to 16; by default 12.",
        quick=6,
        within=Range(f"a number of UAVs from 2 to {_LARGEST}", 2, _LARGEST + 1),
    ),
    sizes=Values(default=[2, 3, 4, 6, 8, 10, 12, 16], quick=[2, 4, 6]),  # those below the largest
)
def scaling(max: int, sizes: Sequence[int]) -> Experiment:  # noqa: A002  # the name of the option
    """Growth of cost, computation and messages.

    Teams of 2 to 12 UAVs made from `resilient`, each with an agent for every UAV, for every pair, and for all.

    Computation is processor time, measured in the same runs. More than one job in parallel
    disturbs the timing, not costs and messages.

    Example: transport experiment scaling --max 8 --seeds 3
    """
    points = []
    for ownership, group in OWNERSHIPS.items():
        for uavs in [*(size for size in sizes if size < max), max]:
            if group == 2 and (uavs == 2 or uavs % 2):
                continue  # a single pair is the centralized team; an odd number has no pairs
            own = group or uavs
            points.append(
                Point(
                    scenario="resilient",
                    labels={"ownership": ownership, "uavs": uavs, "agents": uavs // own},
                    text=f"{uavs} UAVs {ownership}",
                    baseline=ownership == CENTRALIZED,
                    team=Team(uavs, own),
                )
            )
    return Experiment(
        name="scaling", points=tuple(points), x=axis("uavs"), drawn_as="scaling", curves="ownership", timed=True
    )
