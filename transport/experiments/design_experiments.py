"""Experiments with the algorithm and the team.

Parts of the algorithm, horizon, a long hover, team size, faults, and fast flight.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from transport.experiments.cases import Point, refused
from transport.experiments.declaration import NONE, Values, declared
from transport.experiments.network_experiments import NETWORKS
from transport.experiments.run_numbers import resource_use
from transport.protocol.scenario.scenario_file import ScenarioError, with_settings
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.teams.team_of_any_size import given_values

# Values of labels.
AS_IT_IS = "as it is"
NEVER = "never"
CENTRALIZED = "centralized"

# Settings of each part by its name. Those that a scenario has anyway, or that its other settings
# exclude, are left out.
PARTS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "prediction": ("controller.prediction", ("open_loop", "closed_loop")),
    "terminal": ("controller.terminal", ("multiple", "riccati")),
    "preview": ("controller.preview", ("false", "true")),
    "relaxation": ("controller.relaxation", ("1.0", "0.5", "0.25", "0.1")),
    "negotiation iterations": ("controller.negotiation_iterations", ("1", "2", "4")),
    "received plans": ("controller.received_plans", ("by_age", "by_one", "held")),
    "received states": ("controller.received_states", ("predicted", "as_received")),
    "actuation": ("clock.actuation", ("next_tick",)),
    "discretisation": ("controller.discretisation", ("exact", "euler")),
}

# End of the horizon in place of a terminal weight.
_COST_TO_GO = "cost-to-go"

# UAVs per agent, by ownership; None: one agent for all.
OWNERSHIPS: Mapping[str, int | None] = {"distributed": 1, "pairs": 2, CENTRALIZED: None}

_CONTINUE = "clock.on_agent_loss=continue"


@declared("value", drawn_as="variants", seeds=3)
def ablation(scenario: Scenario) -> Iterator[Point]:
    """Contribution of each part of the algorithm.

    Changes one setting at a time, on a perfect network and on one with delay and packet loss.

    Example: transport experiment ablation --scenario resilient
    """
    for network, links in NETWORKS.items():
        labels: dict[str, str | float] = {"network": network, "part": AS_IT_IS, "value": ""}
        yield Point(labels, f"{AS_IT_IS}, {network}", links, baseline=network == "perfect")

        for part, (key, values) in PARTS.items():
            for value in values:
                setting = f"{key}={value}"
                if _takes(scenario, setting):
                    labels = {"network": network, "part": part, "value": value}
                    yield Point(labels, f"{part} {value}, {network}", (*links, setting))


def _takes(scenario: Scenario, setting: str) -> bool:
    """Return whether a setting changes a scenario, and its other settings do not exclude it."""
    try:
        changed = with_settings(given_values(scenario), [setting], scenario.name)
    except ScenarioError:
        return False
    return changed.tree() != scenario.tree()


@declared(
    "horizon",
    drawn_as="variants",
    horizon=Values([5, 10, 20, 30], "STEPS", "Steps N_p.", quick=[10]),
    terminal=Values([1.0, 5.0, 20.0], "WEIGHT", "Terminal weight, without a cost-to-go.", [5.0]),
    delay=Values(0.2, "SECONDS", "Delay of every plan on the second network, s."),
)
def horizon(
    scenario: Scenario, horizon: Sequence[int], terminal: Sequence[float], delay: float
) -> Iterator[Point]:
    """Effect of horizon and terminal weight.

    Each horizon with each weight, on a perfect network and with a delay.

    Example: transport experiment horizon --horizon 10 --horizon 20 --scenario paper
    """
    # The scenario's own horizon and weight are always included: on a perfect network they are the
    # baseline.
    controller = scenario.controller
    own_end = float(controller.weights.terminal)
    horizons = sorted({controller.horizon, *horizon})
    ends: Sequence[float | str] = sorted({own_end, *terminal})
    if controller.terminal == "riccati":
        ends = [_COST_TO_GO]

    for network, delay_s in (("perfect", 0.0), (f"{1e3 * delay:g} ms delay", delay)):
        for steps, end in product(horizons, ends):
            settings = [f"links.delay_s={delay_s!r}", f"controller.horizon={steps}"]
            text = str(end)
            if end != _COST_TO_GO:
                settings.append(f"controller.weights.terminal={end!r}")
                text = f"terminal weight {end:g}"

            is_own = steps == controller.horizon and end in (own_end, _COST_TO_GO)
            yield Point(
                {"network": network, "horizon": steps, "terminal": end},
                f"N_p {steps}, {text}, {network}",
                tuple(settings),
                baseline=is_own and delay_s == 0.0,
            )


@declared(
    "hover_s",
    scenarios=("paper", "centralized", "resilient", "centralized_lq", "precise"),
    quick_maneuver="maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
    "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]",
    duration=Values(
        [5.0, 20.0, 65.0], "SECONDS", "Duration of the last phase, s.", quick=[0.5, 1.0]
    ),
)
def hover(scenario: Scenario, duration: Sequence[float]) -> Iterator[Point]:
    """Stability in a long hover after the maneuver.

    Only the duration of the last phase changes.

    Example: transport experiment hover --duration 60 --scenario resilient
    """
    if scenario.maneuver.phase[-1].speed_mps is not None:
        expected = "a maneuver whose last phase has a duration, not a speed"
        raise refused("--scenario", expected, scenario.name)

    # No run is a baseline: mean costs of different lengths are not comparable.
    last = len(scenario.maneuver.phase)
    for duration_s in duration:
        setting = f"maneuver.phase.{last}.duration_s={duration_s!r}"
        yield Point({"hover_s": duration_s}, f"{duration_s:g} s of hover", (setting,))


@declared(
    "agent",
    curves="restart_s",
    legend={NEVER: "not restarted"},
    at=Values(8.0, "SECONDS", "Time of the kill, s.", 0.5),
    restart=Values(10.0, "SECONDS", "Time of the restart, s.", 1.0),
)
def kill(scenario: Scenario, at: float, restart: float) -> Iterator[Point]:
    """Effect of the death of each agent.

    Kills each agent in turn, with and without a restart, while the others continue.

    Example: transport experiment kill --at 5 --restart 6
    """
    if not at < restart < math.inf:
        raise refused("--restart", f"a time after --at {at:g} s", f"{restart:g}")

    yield Point({"agent": NONE, "restart_s": NONE}, "no agent killed", (_CONTINUE,), baseline=True)
    agents = range(1, len(scenario.owned) + 1)
    for restart_s in (restart, None):
        for agent in agents:
            events = [_event(at, "kill", agent)]
            end = "not restarted"
            if restart_s is not None:
                events.append(_event(restart_s, "restart", agent))
                end = f"restarted after {restart_s - at:g} s"
            yield Point(
                {"agent": str(agent), "restart_s": restart_s or NEVER},
                f"agent{agent} {end}",
                (_CONTINUE, f"faults.event=[{','.join(events)}]"),
            )


@declared(
    "killed_s",
    scenarios=("resilient",),
    count=Values(20, "COUNT", "Deaths per scenario.", 2, least=1),
    draw=Values(0, "SEED", "Random seed of the times and of the agents killed.", least=0),
)
def deaths(scenario: Scenario, count: int, draw: int) -> Iterator[Point]:
    """Effect of a permanent kill of a random agent.

    Each run kills one agent at a random time and never restarts it; the others continue.

    Example: transport experiment deaths --count 50
    """
    period_s = scenario.controller.sampling_period_s
    duration_s = sum(phase.duration_s for phase in scenario.maneuver.phase)
    periods = math.ceil(duration_s / period_s)

    rng = np.random.default_rng(draw)
    ticks = rng.choice(periods, size=min(count, periods), replace=False)
    killed = sorted((int(tick), 1 + int(rng.integers(len(scenario.owned)))) for tick in ticks)

    yield Point({"agent": NONE, "killed_s": 0.0}, "no agent killed", (_CONTINUE,), baseline=True)
    for tick, agent in killed:
        killed_s = round(tick * period_s, 6)
        yield Point(
            {"agent": str(agent), "killed_s": killed_s},
            f"agent{agent} killed at {killed_s:g} s",
            (_CONTINUE, f"faults.event=[{_event(killed_s, 'kill', agent)}]"),
        )


def _event(at_s: float, action: str, agent: int) -> str:
    """Return an event of a scenario at a time, s."""
    return f'{{at_s={at_s!r},do="{action}",target="agent{agent}"}}'


@declared(
    "uavs",
    drawn_as="scaling",
    more=resource_use,
    curves="ownership",
    scenarios=(),
    jobs=1,
    # The paper's speed, 0.5 m/s, in a maneuver of 10 s instead of 25.
    maneuver="maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
    "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]",
    max=Values(12, "COUNT", "UAVs of the largest team.", 6, least=2, most=16),
    sizes=Values([2, 3, 4, 6, 8, 10, 12, 16], quick=[2, 4, 6]),  # those below the largest
)
def scaling(
    max: int,  # noqa: A002  # the name of the option
    sizes: Sequence[int],
) -> Iterator[Point]:
    """Growth of cost, computation and messages.

    Teams of 2 to 12 UAVs made from `resilient`, each with an agent for every UAV, for every pair,
    and for all.

    Computation is processor time, measured in the same runs. More than one job in parallel
    disturbs the timing, not costs and messages.

    Example: transport experiment scaling --max 8 --seeds 3
    """
    teams = [*(size for size in sizes if size < max), max]
    for ownership, group in OWNERSHIPS.items():
        for uavs in teams:
            # A single pair is the centralized team; an odd number has no pairs.
            if group == 2 and (uavs == 2 or uavs % 2):
                continue

            uavs_per_agent = group or uavs
            yield Point(
                {"ownership": ownership, "uavs": uavs, "agents": uavs // uavs_per_agent},
                f"{uavs} UAVs {ownership}",
                baseline=ownership == CENTRALIZED,
                group=f"{uavs} UAVs",
                team=(uavs, uavs_per_agent),
                scenario="resilient",
            )


_PERFECT, _LATE = NETWORKS
_UNIMPAIRED = "perfect network"
_ESTIMATE = "controller.disturbance.estimate=true"
# Networks, and what the controllers do not know on the late network, by the name of the case.
AGILE: Mapping[str, tuple[str, ...]] = {
    _UNIMPAIRED: NETWORKS[_PERFECT],
    _LATE: NETWORKS[_LATE],
    "400 ms delay, 30 % loss": ("links.delay_s=0.4", "links.loss=0.3"),
    **{
        f"payload {100.0 * (factor - 1.0):+.0f} %": (
            *NETWORKS[_LATE],
            _ESTIMATE,
            f"plant.payload_mass_factor={factor}",
        )
        for factor in (0.57, 0.8, 1.2, 1.43)
    },
    "motor lag 60 ms": (*NETWORKS[_LATE], "plant.motors.lag_s=0.06"),
    "wind 5 m/s": (*NETWORKS[_LATE], _ESTIMATE, "plant.wind.speed_mps=[5.0,0.0,0.0]"),
    "unknown drag": (*NETWORKS[_LATE], _ESTIMATE, "controller.knows_drag=false"),
}


@declared(
    "speed_mps",
    curves="case",
    drawn_as="tracking",
    scenarios=("eight",),
    seeds=3,
    quick_maneuver="maneuver.phase=[{name='hover',duration_s=0.3,displacement_m=[0,0,0]},"
    "{name='eight',kind='eight',size_m=[1.0,0.5,0],laps=0.5,speed_mps=1.0,ramp_s=2.0},"
    "{name='hover',duration_s=0.3,displacement_m=[0,0,0]}]",
    speed=Values([3.0, 4.0, 5.0, 6.0], "SPEED", "Largest speed, m/s.", quick=[1.0], least=0.01),
)
def agile(scenario: Scenario, speed: Sequence[float]) -> Iterator[Point]:
    """Fast flight: the payload's error over speed.

    One agent for each UAV on a perfect network and late ones, one agent for all UAVs, and on the
    late network another payload mass, wind and unknown drag, all estimated, and motor lag.

    A speed that thrust, tension, tilt or distances do not allow is refused with the least slowing
    that they do.

    Example: transport experiment agile --speed 5 --seeds 10
    """
    phases = enumerate(scenario.maneuver.phase, start=1)
    paced = [number for number, phase in phases if phase.speed_mps is not None]
    if not paced:
        raise refused("--scenario", "a maneuver with speed_mps in a phase", scenario.name)

    one_agent = f"agents.owned=[{[uav.id for uav in scenario.system.uav]}]"
    centralized = (*NETWORKS[_PERFECT], one_agent, "controller.relaxation=1.0")
    for case, settings in {CENTRALIZED: centralized, **AGILE}.items():
        for speed_mps in speed:
            speeds = [f"maneuver.phase.{number}.speed_mps={speed_mps!r}" for number in paced]
            yield Point(
                {"case": case, "speed_mps": speed_mps},
                f"{case}, {speed_mps:g} m/s",
                (*settings, *speeds),
                baseline=case == _UNIMPAIRED,
                group=f"{speed_mps:g} m/s",
            )
