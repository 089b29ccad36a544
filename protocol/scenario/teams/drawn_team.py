"""Teams drawn at random: scenarios of teams without tuning, by a seed.

`DRAWN` has the ranges. A drawn team hovers with all rods taut, and its limits leave room for the maneuver;
all that is not drawn is the template's.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from transport.model.path.flatness import LEAST_TENSION
from transport.model.physics.hover import Hover, hover
from transport.model.physics.parameters import ParameterError, Payload, System, Uav
from transport.protocol.scenario.scenario_file import validate
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.model_objects import building
from transport.protocol.scenario.teams.team_of_any_size import given_values

Bounds = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnRanges:
    """Ranges of what is drawn, SI."""

    uavs: tuple[int, int] = (3, 8)
    uav_mass_kg: Bounds = (0.8, 2.0)
    uav_gyration_m: Bounds = (0.08, 0.18)  # radius of gyration about roll and pitch
    uav_pitch_inertia: Bounds = (0.95, 1.05)  # over that about roll
    uav_yaw_inertia: Bounds = (1.5, 2.0)  # likewise
    rod_length_m: Bounds = (2.0, 3.7)
    spacing_m: Bounds = (0.5, 1.0)  # of neighbours in the ring from which attachments are moved
    angle: Bounds = (-0.4, 0.4)  # of an attachment, as a share of the angle between neighbours
    radius: Bounds = (0.5, 1.5)  # of an attachment, over that of the ring
    height_m: Bounds = (0.0, 0.3)  # of attachments above the centre of mass
    load: Bounds = (0.3, 0.9)  # mass of the payload over that of all UAVs
    load_inertia: Bounds = (0.08, 0.5)  # over mass times square of the ring's radius
    load_inertia_of_axis: Bounds = (0.8, 1.2)  # about each axis, over that
    share_of_drag: float = 0.5  # teams that have drag, and know it
    uav_drag: Bounds = (0.2, 0.5)  # in the plane of the rotors, over the mass, 1/s
    load_drag_kgps: Bounds = (0.0, 0.5)
    periods_s: tuple[float, ...] = (0.02, 0.025, 0.04, 0.05, 0.08, 0.1)
    horizon_s: Bounds = (0.5, 1.2)
    horizon: tuple[int, int] = (5, 30)  # in steps, within these bounds
    share_of_rates: float = 0.3  # teams that command body rates
    rate_time_constant_s: Bounds = (0.03, 0.06)
    thrust: Bounds = (2.0, 2.8)  # largest thrust over the largest at hover
    angular_acceleration_rads2: Bounds = (25.0, 45.0)  # by the largest moment about roll
    share_of_next_tick: float = 0.3  # teams whose inputs act a period later
    share_of_sensors: float = 0.5  # teams with the sensors of the vehicles
    noise: Bounds = (0.5, 1.5)  # over that of satellite navigation and a small autopilot
    delay_s: Bounds = (0.0, 0.3)
    jitter_s: Bounds = (0.0, 0.05)
    loss: Bounds = (0.0, 0.4)
    gust_mps: Bounds = (0.0, 1.0)
    leg_m: Bounds = (1.0, 3.0)  # length of the maneuver's one leg
    elevation_rad: Bounds = (-0.5, 0.5)  # of its direction, which may be any around


DRAWN = DrawnRanges()

# Streams of random numbers of a seed: bodies, flight and all that follows; drag, which came later. Whatever
# comes later needs its own, as results name teams by their seeds.
_ALL_BUT_DRAG = 65
_DRAG = 66
# Durations of the maneuver, s: hover, the leg, and the rest in which it has to settle.
_HOVER_S, _LEG_S, _REST_S = 3.0, 5.0, 7.0
# Largest moment about yaw over that by the angular acceleration about roll: rotors' drag is weak.
_YAW_MOMENT = 0.25
# Limits of changes, in largest thrusts and moments per second.
_THRUSTS_PER_S, _MOMENTS_PER_S = 4.0, 10.0

# Attempts to draw attachments between which the payload hangs.
_ATTEMPTS = 1000
# Smallest distance of two attachments, m, and share of that of two UAVs at hover that a team has to keep.
_APART_M = 0.4
_SEPARATION = 0.75
# Tension of each rod at hover, over the mean: twice the least that a path may leave.
_TAUT = 2.0 * LEAST_TENSION
# Noise of the sensors of a small autopilot with satellite navigation: 1 cm, 2 cm/s, 0.5 deg, 1 deg/s.
NOISE = {
    "position_m": 0.01,
    "velocity_mps": 0.02,
    "attitude_rad": 0.0087,
    "rate_rads": 0.0175,
    "specific_force_mps2": 0.3,
}


def drawn(seed: int, template: Scenario, source: str, uavs: int | None = None) -> Scenario:
    """Return the drawn team of a seed, with the template's keys where none are drawn.

    Args:
        seed: Integer from 0 on.
        template: Scenario of the controllers' weights and of all else.
        source: The template's file, for errors.
        uavs: Number of UAVs; None: drawn.

    Raises: ScenarioError: the template does not take such a team.
    """
    ranges = DRAWN
    team = _drawn_vehicles(seed, uavs, template.system.gravity_mps2)
    rng = team.rng
    N = len(team.system["uav"])

    tree = given_values(template)
    tree["name"] = f"team-{seed}-of-{N}"
    tree["seed"] = seed
    tree["system"] = team.system
    tree["maneuver"] = {"start_m": [0.0, 0.0, -10.0], "profile": "ramp", "phase": team.phases}
    tree["agents"] = {"owned": [[uav] for uav in range(1, N + 1)]}
    tree["controller"] = {**tree["controller"], **team.controller}
    tree["clock"] = {
        **tree.get("clock", {}),
        "actuation": "next_tick" if rng.random() < ranges.share_of_next_tick else "immediate",
    }
    tree["links"] = {
        "delay_s": _uniform(rng, ranges.delay_s),
        "jitter_s": _uniform(rng, ranges.jitter_s),
        "loss": _uniform(rng, ranges.loss),
    }
    tree["plant"] = {**tree.get("plant", {}), **_plant(rng)}
    has_sensors = tree["plant"]["sensors"] == "vehicle"
    tree["controller"]["estimator"] = "kalman" if has_sensors else "measured"
    return validate(tree, source)


def put_drawn_vehicles(tree: dict[str, Any], seed: int) -> None:
    """Replace the vehicles in the tree of a scenario by the drawn ones of a seed, as many as there are.

    Payload, UAVs, rods, period, horizon, inputs and limits are drawn; maneuver, network, sensors and weather
    stay.
    Raises: ScenarioError: no draw has a hover.
    """
    system = tree["system"]
    team = _drawn_vehicles(seed, len(system["uav"]), system["gravity_mps2"])
    tree["system"] = team.system
    wind = tree["plant"]["wind"]
    if any(wind.get(key) is not None for key in ("drag_payload_kgps", "drag_uav_kgps")):
        # The scenario has drag that no controller knows, in place of that of the bodies.
        for body in (team.system["payload"], *team.system["uav"]):
            body.pop("drag_kgps", None)
    estimate = tree["controller"]["disturbance"]
    tree["controller"] |= team.controller | {"disturbance": estimate}


@dataclass(frozen=True, slots=True, kw_only=True)
class _DrawnVehicles:
    """Bodies and flight of a team, and the generator with which the rest is drawn."""

    rng: np.random.Generator
    system: dict[str, Any]
    phases: list[dict[str, Any]]
    controller: dict[str, Any]


def _drawn_vehicles(seed: int, uavs: int | None, gravity_mps2: float) -> _DrawnVehicles:
    """Return the vehicles of a seed; with None their number is drawn as well.

    Raises: ScenarioError: no draw has a hover.
    """
    rng = np.random.default_rng([seed, _ALL_BUT_DRAG])
    fewest, most = DRAWN.uavs
    drawn_number = int(rng.integers(fewest, most, endpoint=True))
    N = drawn_number if uavs is None else uavs
    system, at_rest = building(f"drawn team {seed}", "system", lambda: _team(rng, N, gravity_mps2))
    phases = _phases(rng)
    controller = _controller(rng, system, at_rest)
    _add_drag(np.random.default_rng([seed, _DRAG]), system)
    return _DrawnVehicles(rng=rng, system=system, phases=phases, controller=controller)


def _uniform(rng: np.random.Generator, bounds: Bounds, digits: int = 4) -> float:
    """Return a number in bounds, as a file has it."""
    return round(float(rng.uniform(*bounds)), digits)


def _team(rng: np.random.Generator, N: int, gravity_mps2: float) -> tuple[dict[str, Any], Hover]:
    """Return a section `system` whose payload hangs between its attachments, and its hover.

    Raises: ParameterError: no draw has one.
    """
    for _ in range(_ATTEMPTS):
        section = _section(rng, N, gravity_mps2)
        if _apart_m([uav["rho_m"] for uav in section["uav"]]) < _APART_M:
            continue
        with contextlib.suppress(ParameterError):
            at_rest = hover(_bodies(section))
            if at_rest.tensions.min() >= _TAUT * at_rest.tensions.mean():
                return section, at_rest
    raise ParameterError(
        f"expected attachments that carry the payload, got none in {_ATTEMPTS} draws"
    )


def _section(rng: np.random.Generator, N: int, gravity_mps2: float) -> dict[str, Any]:
    """Return a section `system`, with attachments around a ring at irregular angles and radii."""
    ranges = DRAWN
    radius_m = rng.uniform(*ranges.spacing_m) / (2.0 * math.sin(math.pi / N))
    uavs = [_uav(rng, i, N, radius_m) for i in range(N)]
    load_kg = round(sum(uav["mass_kg"] for uav in uavs) * rng.uniform(*ranges.load), 4)
    inertia_kgm2 = load_kg * radius_m**2 * rng.uniform(*ranges.load_inertia)
    of_axis = ranges.load_inertia_of_axis
    around = [round(inertia_kgm2 * rng.uniform(*of_axis), 5) for _ in range(3)]
    payload: dict[str, Any] = {"mass_kg": load_kg, "inertia_kgm2": around}
    return {"gravity_mps2": gravity_mps2, "payload": payload, "uav": uavs}


def _uav(rng: np.random.Generator, i: int, N: int, radius_m: float) -> dict[str, Any]:
    """Return UAV i, 0-based, of N, attached near its place on a ring of a radius."""
    ranges = DRAWN
    mass_kg = _uniform(rng, ranges.uav_mass_kg)
    roll_kgm2 = mass_kg * rng.uniform(*ranges.uav_gyration_m) ** 2
    pitch_kgm2 = roll_kgm2 * rng.uniform(*ranges.uav_pitch_inertia)
    yaw_kgm2 = roll_kgm2 * rng.uniform(*ranges.uav_yaw_inertia)

    angle_rad = 2.0 * math.pi / N * (i + rng.uniform(*ranges.angle))
    away_m = radius_m * rng.uniform(*ranges.radius)
    point_m = [
        away_m * math.cos(angle_rad),
        away_m * math.sin(angle_rad),
        -rng.uniform(*ranges.height_m),
    ]
    return {
        "id": i + 1,
        "mass_kg": mass_kg,
        "inertia_kgm2": [round(J, 6) for J in (roll_kgm2, pitch_kgm2, yaw_kgm2)],
        "rho_m": [round(metres, 4) for metres in point_m],
        "rod_length_m": _uniform(rng, ranges.rod_length_m),
    }


def _add_drag(rng: np.random.Generator, section: dict[str, Any]) -> None:
    """Add drag to the bodies of a section `system`, of one kind of vehicle, or none."""
    ranges = DRAWN
    if rng.random() >= ranges.share_of_drag:
        return
    section["payload"]["drag_kgps"] = _uniform(rng, ranges.load_drag_kgps)
    per_second = rng.uniform(*ranges.uav_drag)
    for uav in section["uav"]:
        uav["drag_kgps"] = [round(per_second * uav["mass_kg"], 4), 0.0]


def _bodies(section: dict[str, Any]) -> System:
    """Return the bodies of a section `system`."""
    payload = section["payload"]
    uavs = [
        Uav(
            mass=uav["mass_kg"],
            inertia=uav["inertia_kgm2"],
            rho=uav["rho_m"],
            rod_length=uav["rod_length_m"],
        )
        for uav in section["uav"]
    ]
    return System(
        payload=Payload(mass=payload["mass_kg"], inertia=payload["inertia_kgm2"]),
        uavs=uavs,
        gravity=section["gravity_mps2"],
    )


def _apart_m(points_m: Sequence[Sequence[float]]) -> float:
    """Return the smallest distance of two points."""
    return min(math.dist(one, another) for one, another in combinations(points_m, 2))


def _phases(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return a hover, a leg in a drawn direction, and a hover."""
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    elevation = rng.uniform(*DRAWN.elevation_rad)
    length_m = rng.uniform(*DRAWN.leg_m)
    level_m = length_m * math.cos(elevation)
    leg_m = [
        level_m * math.cos(azimuth),
        level_m * math.sin(azimuth),
        length_m * math.sin(elevation),
    ]
    rounded = [round(metres, 3) for metres in leg_m]
    return [
        {"name": "hover", "duration_s": _HOVER_S, "displacement_m": [0.0, 0.0, 0.0]},
        {"name": "leg", "duration_s": _LEG_S, "displacement_m": rounded},
        {"name": "rest", "duration_s": _REST_S, "displacement_m": [0.0, 0.0, 0.0]},
    ]


def _controller(
    rng: np.random.Generator, section: dict[str, Any], at_rest: Hover
) -> dict[str, Any]:
    """Return period, horizon, inputs and limits of a team."""
    ranges = DRAWN
    period_s = float(rng.choice(ranges.periods_s))
    horizon_s = rng.uniform(*ranges.horizon_s)
    largest_N = round(float(at_rest.u.max()) * rng.uniform(*ranges.thrust), 2)
    by_inertia = rng.uniform(*ranges.angular_acceleration_rads2)
    inertia = np.array([uav["inertia_kgm2"] for uav in section["uav"]])
    moments_Nm = by_inertia * inertia.max(axis=0) * [1.0, 1.0, _YAW_MOMENT]

    # Rods of different lengths have UAVs apart in height as well.
    rods_m = [[0.0, 0.0, uav["rod_length_m"]] for uav in section["uav"]]
    places_m = np.array([uav["rho_m"] for uav in section["uav"]]) - rods_m
    apart_m = _apart_m(places_m.tolist())

    time_constant_s = _uniform(rng, ranges.rate_time_constant_s)
    commands_rates = bool(rng.random() < ranges.share_of_rates)
    return {
        "sampling_period_s": period_s,
        "horizon": int(np.clip(round(horizon_s / period_s), *ranges.horizon)),
        "inputs": "rates" if commands_rates else "moments",
        "rate_time_constant_s": [time_constant_s] * 3,
        "limits": {
            "thrust_N": [0.0, largest_N],
            "thrust_rate_N_s": round(_THRUSTS_PER_S * largest_N, 1),
            "moments_Nm": [round(float(moment), 4) for moment in moments_Nm],
            "moment_rates_Nm_s": [
                round(_MOMENTS_PER_S * float(moment), 3) for moment in moments_Nm
            ],
        },
        "separation": {"minimum_m": round(_SEPARATION * apart_m, 3)},
        "disturbance": {"estimate": True},
    }


def _plant(rng: np.random.Generator) -> dict[str, Any]:
    """Return sensors and weather."""
    ranges = DRAWN
    has_sensors = bool(rng.random() < ranges.share_of_sensors)
    factor = rng.uniform(*ranges.noise)
    gust_mps = _uniform(rng, ranges.gust_mps)
    noise = {quantity: round(factor * sigma, 5) for quantity, sigma in NOISE.items()}
    return {
        "sensors": "vehicle" if has_sensors else "state",
        "noise": noise if has_sensors else {},
        "wind": {"gust_mps": [gust_mps] * 3},
    }
