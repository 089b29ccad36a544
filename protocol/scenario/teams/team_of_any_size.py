"""A team of any size: UAVs in a ring over a payload of the paper's shape.

All other values are those of a scenario.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

from transport.model.physics.parameters import table_1
from transport.model.section import Inertia, Key, Pair, Positive, Section
from transport.protocol.scenario.scenario_file import find_ready, read_tree, validate
from transport.protocol.scenario.sections.scenario_errors import (
    HoverError,
    ScenarioError,
    validated,
)
from transport.protocol.scenario.sections.schema import NO_DRAG, Scenario
from transport.protocol.scenario.sections.sources_of_values import Origin, origins_in
from transport.protocol.wire.names import MAX_UAVS

FEWEST = 2  # a single rod leaves the payload free to turn about it
MOST = MAX_UAVS

# Decimals of lengths and inertias, m and kg m^2: readable, and fine enough not to affect a run with a
# load of a gram or more.
_DECIMALS = 6
# Decimals of the distance of neighbours that a scenario has, m: coarser than points of
# `_DECIMALS`, so that a ring made of another ring has its distance exactly.
_SPACING_DECIMALS = 5
# Sections and keys that a new team never has from its template.
_MADE_ANEW = ("name", "system.payload")
# Keys of a UAV that are the same all around a ring.
_AIRFRAME_KEYS = ("mass_kg", "inertia_kgm2", "rod_length_m", "drag_kgps", "radius_m")


class AirframeSection(Section):
    """One UAV of a vehicle, and its place in the ring."""

    mass_kg: Positive
    """mass of the UAV"""
    inertia_kgm2: Inertia
    """inertia of the UAV"""
    rod_length_m: Annotated[Positive, Key(within=(1e-3, 1e4))]
    """length of its rod"""
    drag_kgps: Annotated[Pair, Key(type="2 numbers >= 0")] = NO_DRAG
    """its drag in the plane of the rotors, and along their axis"""
    spacing_m: Positive
    """distance between neighbours in the ring"""
    radius_m: Positive | None = None
    """radius of the sphere that it fills, over the propellers; None: not known"""


class Vehicle(Section):
    """A vehicle file: one UAV, and the keys of a scenario that belong to it."""

    name: str
    uav: AirframeSection
    controller: dict[str, Any] = {}
    plant: dict[str, Any] = {}
    vehicles: dict[str, Any] = {}

    @property
    def scenario_tree(self) -> dict[str, Any]:
        """The sections of a scenario that the vehicle sets, as a tree of plain data."""
        sections = {"controller": self.controller, "plant": self.plant}
        return {**sections, "vehicles": self.vehicles} if self.vehicles else sections


@dataclass(frozen=True, slots=True, kw_only=True)
class Team:
    """The team that a scenario is made for.

    Raises: ValueError: a number of UAVs is out of range.
    """

    uavs: int  # `FEWEST` to `MOST`
    group: int | None = None  # UAVs per agent, from 1; None: as the template's first, or all
    name: str | None = None  # of the scenario; None: that of the template with the number of UAVs
    vehicle: str | None = None  # file or name; None: the template's UAV
    load_kg: float | None = None  # mass of the payload; None: half that of the UAVs

    def __post_init__(self) -> None:
        if not FEWEST <= self.uavs <= MOST:
            raise ValueError(f"uavs: expected {FEWEST} to {MOST}, got {self.uavs}")
        if self.group is not None and self.group < 1:
            raise ValueError(f"group: expected at least 1 UAV per agent, got {self.group}")

    @property
    def load_in_words(self) -> str:
        """The load as errors name it."""
        return f"load_kg={self.load_kg:g}"

    @property
    def name_in_words(self) -> str:
        """The name as errors name it."""
        return f"name={self.name!r}"

    def origins(self, of_template: Sequence[Origin] = ()) -> tuple[Origin, ...]:
        """Return the sources of the values that are not those of the template's file.

        Args:
            of_template: Such sources of the template itself; those of replaced values are left out.
        """
        origins: list[Origin] = []
        if self.vehicle is not None:
            file = str(find_vehicle(self.vehicle))
            origins += origins_in(read_vehicle(self.vehicle).scenario_tree, file)
            origins.append(Origin(key="system.uav", source=file))
        if self.load_kg is not None:
            origins.append(Origin(key="system.payload", source=self.load_in_words))
        if self.name is not None:
            origins.append(Origin(key="name", source=self.name_in_words))

        replaced = {*_MADE_ANEW, *(origin.key for origin in origins)}
        kept = [origin for origin in of_template if origin.key not in replaced]
        return (*kept, *origins)

    def with_source(
        self, error: ScenarioError, of_template: Sequence[Origin] = ()
    ) -> ScenarioError:
        """Return an error of this team's scenario with the source of the refused value."""
        if isinstance(error, HoverError) and self.load_kg is not None:
            return ScenarioError(self.load_in_words, error.field, error.problem)
        return error.traced(self.origins(of_template))


def find_vehicle(name: str) -> Path:
    """Return the file of a vehicle, by its path or the name of a ready one.

    Raises: ScenarioError: neither.
    """
    return find_ready(name, "vehicles", "vehicle")


def read_vehicle(name: str) -> Vehicle:
    """Return a vehicle, of a file or a ready one by its name.

    Raises: ScenarioError: as `read_scenario`.
    """
    path = find_vehicle(name)
    return validated(Vehicle, read_tree(path), str(path))


def airframe_of(scenario: Scenario, source: str) -> AirframeSection:
    """Return the UAV of a scenario, and the smallest distance of its attachment points.

    Raises: ScenarioError: the UAVs differ, or have no distance.
    """
    first, *others = scenario.system.uav
    for uav in others:
        for key in _AIRFRAME_KEYS:
            usual, own = getattr(first, key), getattr(uav, key)
            if own != usual:
                expected = f"expected {usual}, as of UAV{first.id}, or a vehicle for the new team"
                raise ScenarioError(source, f"system.uav.{uav.id}.{key}", f"{expected}, got {own}")

    points_m = [uav.rho_m for uav in scenario.system.uav]
    distances_m = [math.dist(one, another) for one, another in combinations(points_m, 2)]
    spacing_m = round(min(distances_m, default=0.0), _SPACING_DECIMALS)
    if spacing_m == 0.0:
        problem = (
            "expected UAVs apart from each other, or a vehicle for the new team, got no distance"
        )
        raise ScenarioError(source, "system.uav", problem)

    return AirframeSection(
        mass_kg=first.mass_kg,
        inertia_kgm2=first.inertia_kgm2,
        rod_length_m=first.rod_length_m,
        drag_kgps=first.drag_kgps,
        spacing_m=spacing_m,
        radius_m=first.radius_m,
    )


def ring(
    N: int, gravity_mps2: float, airframe: AirframeSection, load_kg: float | None = None
) -> dict[str, Any]:
    """Return the section `system` of N UAVs, 2 or more, in a ring.

    The payload has the paper's shape, no drag, and by default half the mass of the UAVs, as there. Four of
    the paper's UAVs are Table I. Source: docs/scenario.md.

    Raises: ValueError: fewer UAVs.
    """
    if N < FEWEST:
        raise ValueError(f"N: expected at least {FEWEST} UAVs, got {N}")

    paper = table_1()
    papers_uav = paper.uavs[0]

    # Neighbours on a circle of radius r are 2 r sin(pi / N) apart.
    x_m, y_m, z_m = papers_uav.rho.tolist()
    radius_m = airframe.spacing_m / (2.0 * math.sin(math.pi / N))
    scale = radius_m / math.hypot(x_m, y_m)

    payload_kg = load_kg
    if payload_kg is None:
        # The paper's share: 3 kg for four UAVs of 1.5 kg.
        payload_kg = paper.payload.mass * N / paper.N * (airframe.mass_kg / papers_uav.mass)

    # The payload keeps its shape: J ~ m r^2.
    inertia_kgm2 = paper.payload.inertia.diagonal() * (payload_kg / paper.payload.mass * scale**2)

    # As in a file: only what is not the default.
    drag = {} if airframe.drag_kgps == NO_DRAG else {"drag_kgps": list(airframe.drag_kgps)}
    return {
        "gravity_mps2": gravity_mps2,
        "payload": {"mass_kg": payload_kg, "inertia_kgm2": _rounded(inertia_kgm2)},
        "uav": [
            {
                "id": number,
                "rho_m": _rounded(_on_circle(number, N, radius_m, scale * z_m)),
                "mass_kg": airframe.mass_kg,
                "inertia_kgm2": airframe.inertia_kgm2,
                "rod_length_m": airframe.rod_length_m,
                **({} if airframe.radius_m is None else {"radius_m": airframe.radius_m}),
                **drag,
            }
            for number in range(1, N + 1)
        ],
    }


def resized(
    template: Scenario, team: Team, source: str, origins: Sequence[Origin] = ()
) -> Scenario:
    """Return the scenario of a team in place of the template's.

    Name, payload, attachment points and ownership are made anew. UAVs, limits, motors and inner
    loop are those of the team's vehicle, if it has one; gravity and all other keys are the
    template's. Errors name the source of the refused value: vehicle, load, name, one of `origins`
    of the template's values, or `source` of all others.

    Raises: ScenarioError: the template names agents that are gone, its UAVs differ and no vehicle
        is given, or a value is invalid.
    """
    basis = template.name
    tree = given_values(template)
    if team.vehicle is None:
        airframe = airframe_of(template, source)
    else:
        vehicle = read_vehicle(team.vehicle)
        basis = f"{template.name}-{vehicle.name}"
        tree = _merged(tree, vehicle.scenario_tree)
        airframe = vehicle.uav

    tree["name"] = f"{basis}-{team.uavs}" if team.name is None else team.name
    tree["system"] = ring(team.uavs, template.system.gravity_mps2, airframe, team.load_kg)
    tree["agents"] = {**tree.get("agents", {}), "owned": _owned(template, team)}

    try:
        return validate(tree, source)
    except ScenarioError as error:
        raise team.with_source(error, origins) from error.__cause__


def given_values(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as plain data, with the given values only."""
    return scenario.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude_none=True)


def _owned(template: Scenario, team: Team) -> list[list[int]]:
    """Return the UAVs of each agent, by default as many as of the template's first agent."""
    is_centralized = len(template.owned) == 1
    usual = team.uavs if is_centralized else len(template.owned[0])
    group = usual if team.group is None else team.group

    ids = list(range(1, team.uavs + 1))
    return [ids[first : first + group] for first in range(0, team.uavs, group)]


def _on_circle(number: int, N: int, radius_m: float, z_m: float) -> list[float]:
    """Return the attachment point of a UAV, from 1.

    Seen from above, the first is to the right of the x axis, and the others follow
    counter-clockwise. With z down, y is to the right of x seen from above, so counter-clockwise the
    angle falls.
    """
    angle_rad = math.pi / N * (3 - 2 * number)
    return [radius_m * math.cos(angle_rad), radius_m * math.sin(angle_rad), z_m]


def _merged(tree: Any, changes: Any) -> Any:
    """Return a tree with the values of another one in place of its own."""
    if not (isinstance(tree, dict) and isinstance(changes, dict)):
        return changes
    return {**tree, **{key: _merged(tree.get(key), value) for key, value in changes.items()}}


def _rounded(values: Iterable[float]) -> list[float]:
    """Return numbers as a file has them."""
    return [round(float(value), _DECIMALS) + 0.0 for value in values]  # + 0.0: no -0.0
