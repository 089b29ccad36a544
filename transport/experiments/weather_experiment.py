"""What the network is worth: controllers in weather, on networks from perfect to none."""

import math
from collections.abc import Iterator, Mapping, Sequence

from transport.experiments.cases import Point, check_names, refused
from transport.experiments.declaration import Values, declared
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.teams.drawn_team import NOISE

# Sensors of the vehicles, those of a small autopilot, with the filter that needs no others.
SENSORS = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    *(f"plant.noise.{name}={value!r}" for name, value in NOISE.items()),
)
FORCES = "controller.disturbance.estimate=true"


def _gusts(speed_mps: float) -> str:
    return f"plant.wind.gust_mps=[{speed_mps}, {speed_mps}, {speed_mps}]"


WEATHER: Mapping[str, tuple[str, ...]] = {
    "still air": (),
    "gusts 1 m/s": (_gusts(1.0),),
    "gusts 2 m/s": (_gusts(2.0),),
    "gusts 3 m/s": (_gusts(3.0),),
    "payload 15 % heavier": ("plant.payload_mass_factor=1.15",),
}
PERFECT, NONE = "perfect", "none"
NETWORKS: Mapping[str, tuple[str, ...]] = {
    PERFECT: (),
    "200 ms, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
    "400 ms, 60 % loss": ("links.delay_s=0.4", "links.loss=0.6"),
    "5 s of 10 silent": (),
    NONE: ("links.loss=1.0",),
}
SILENT = "5 s of 10 silent"
# The silence begins after the first of the two, and ends with the other.
_HEARD_S, _EVERY_S = (
    5.0,
    10.0,
)


@declared(
    "network",
    drawn_as="weather",
    scenarios=("alone", "precise", "paper", "resilient", "centralized_lq"),
    seeds=5,
    network=Values(list(NETWORKS), "NAME", "Networks."),
    air=Values(list(WEATHER), "NAME", "Weather."),
)
def weather(scenario: Scenario, network: Sequence[str], air: Sequence[str]) -> Iterator[Point]:
    """Worth of the network in weather.

    Each controller in still air, gusts and with a heavier payload, on networks from perfect to none,
    by the sensors of the vehicles. UAVs alone need no network, and one agent for all has none to
    impair. `paper` has no estimator: its agents are told the states. Runs that end before the first
    silence, as with --quick, have no row of it. Options choose networks and weather, where a scenario
    has several networks.

    Example: transport experiment weather --scenario precise --network perfect --air "still air"
    """
    check_names("--network", network, NETWORKS)
    check_names("--air", air, WEATHER)
    is_short = _duration_s(scenario) <= _HEARD_S
    if is_short and list(network) == [SILENT]:
        raise refused("--network", f"a run longer than {_HEARD_S:g} s for it", SILENT)
    names = [name for name in NETWORKS if name in network and not (is_short and name == SILENT)]
    if set(scenario.controllers) == {"alone"}:
        names = [NONE]
    elif len(scenario.owned) == 1:
        names = [PERFECT]
    sensors = (*SENSORS, FORCES) if scenario.controller.prediction == "closed_loop" else ()
    for day, settings in WEATHER.items():
        if day not in air:
            continue
        for name in names:
            yield Point(
                {"weather": day, "network": name},
                f"{day}, network: {name}",
                (*sensors, *settings, *_network(name, scenario)),
                baseline=name == names[0],
                group=day,
            )


def _network(name: str, scenario: Scenario) -> tuple[str, ...]:
    """Return the settings of a network: all agents apart in the silent ones."""
    if name != SILENT:
        return NETWORKS[name]
    cuts = []
    for number in range(math.ceil(_duration_s(scenario) / _EVERY_S)):
        start_s = number * _EVERY_S + _HEARD_S
        end_s = (number + 1) * _EVERY_S
        for agent in range(1, len(scenario.owned)):
            cuts.append(f"{{between=['agent{agent}'], start_s={start_s}, end_s={end_s}}}")
    return (f"links.partition=[{', '.join(cuts)}]",)


def _duration_s(scenario: Scenario) -> float:
    """Return the duration of the maneuver, s."""
    return math.fsum(phase.duration_s for phase in scenario.maneuver.phase)
