"""Experiment with fast flight along a flat reference: the payload's error over speed."""

from collections.abc import Mapping, Sequence

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point, refused
from transport.experiments.declaration import Experiment, Range, Values, axis, declared
from transport.experiments.network_experiments import NETWORKS

_PERFECT, _LATE = NETWORKS
_CENTRALIZED, _UNIMPAIRED = "centralized", "perfect network"
_ESTIMATE = "controller.disturbance.estimate=true"
# Networks and owners, and what the controllers do not know on the late network, by the name of the case.
CASES: Mapping[str, tuple[str, ...]] = {
    _UNIMPAIRED: NETWORKS[_PERFECT],
    _LATE: NETWORKS[_LATE],
    "400 ms delay, 30 % loss": ("links.delay_s=0.4", "links.loss=0.3"),
    **{
        f"payload {100.0 * (factor - 1.0):+.0f} %": (*NETWORKS[_LATE], _ESTIMATE, f"plant.payload_mass_factor={factor}")
        for factor in (0.57, 0.8, 1.2, 1.43)
    },
    "motor lag 60 ms": (*NETWORKS[_LATE], "plant.motors.lag_s=0.06"),
    "wind 5 m/s": (*NETWORKS[_LATE], _ESTIMATE, "plant.wind.speed_mps=[5.0,0.0,0.0]"),
}


@declared(
    scenarios=("eight",),
    defaults={
        "seeds": 3,
        "quick_maneuver": "maneuver.phase=[{name='hover',duration_s=0.3,displacement_m=[0,0,0]},"
        "{name='eight',kind='eight',size_m=[1.0,0.5,0],laps=0.5,speed_mps=1.0,ramp_s=2.0},"
        "{name='hover',duration_s=0.3,displacement_m=[0,0,0]}]",
    },
    speed=Values(
        [3.0, 4.0, 5.0, 6.0],
        "SPEED",
        "Largest speed, m/s; by default 3 to 6.",
        quick=[1.0],
        within=Range("a speed > 0 m/s"),
    ),
)
def agile(scenarios: Mapping[str, Scenario], speed: Sequence[float]) -> Experiment:
    """Fast flight: the payload's error over speed.

    One agent for each UAV on a perfect network and late ones, one agent for all UAVs, and on the late network another
    payload mass, wind, both estimated, and motor lag.

    A speed that thrust, tension, tilt or distances do not allow is refused with the least slowing that they do.

    Example: transport experiment agile --speed 5 --seeds 10
    """
    points = []
    for name, scenario in scenarios.items():
        paced = [i for i, phase in enumerate(scenario.maneuver.phase, start=1) if phase.speed_mps is not None]
        if not paced:
            raise refused("--scenario", "a maneuver with speed_mps in a phase", name)
        whole = f"agents.owned=[{[uav.id for uav in scenario.system.uav]}]"
        cases = {_CENTRALIZED: (*NETWORKS[_PERFECT], whole, "controller.relaxation=1.0"), **CASES}
        points += [
            Point(
                scenario=name,
                labels={"case": case, "speed_mps": speed_mps},
                text=f"{case}, {speed_mps:g} m/s",
                settings=(*settings, *(f"maneuver.phase.{i}.speed_mps={speed_mps!r}" for i in paced)),
                baseline=case == _UNIMPAIRED,
                group=f"{speed_mps:g} m/s",
            )
            for case, settings in cases.items()
            for speed_mps in sorted(speed)
        ]
    along = axis("speed_mps")
    return Experiment(name="agile", points=tuple(points), x=along, curves="case", drawn_as="tracking")
