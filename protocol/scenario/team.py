"""A team of any size: UAVs in a ring over a payload of the paper's shape.

All other values are those of a scenario.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from transport.model.parameters import table_1
from transport.mpc.settings import Key, Positive, Section
from transport.protocol.scenario.errors import HoverError, ScenarioError, validated
from transport.protocol.scenario.file import find_ready, read_tree, validate
from transport.protocol.scenario.origins import Origin, origins_in
from transport.protocol.scenario.schema import Inertia, Scenario
from transport.protocol.wire.names import MAX_UAVS

FEWEST = 2  # one rod leaves the payload free to turn about it
MOST = MAX_UAVS

# Decimals of lengths and inertias, m and kg m^2: readable, and fine enough not to affect a run with a
# load of a gram or more.
_DECIMALS = 6


class AirframeSection(Section):
    """One UAV of a vehicle, and its place in the ring."""

    mass_kg: Positive
    """mass of the UAV"""
    inertia_kgm2: Inertia
    """inertia of the UAV"""
    rod_length_m: Annotated[Positive, Key(within=(1e-3, 1e4))]
    """length of its rod"""
    spacing_m: Positive
    """distance between neighbours in the ring"""


class Vehicle(Section):
    """A vehicle file: one UAV, and the keys of a scenario that belong to it."""

    name: str
    uav: AirframeSection
    controller: dict[str, Any] = {}
    plant: dict[str, Any] = {}

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of a scenario."""
        return {"controller": self.controller, "plant": self.plant}


@dataclass(frozen=True, slots=True, kw_only=True)
class Team:
    """The team that a scenario is made for."""

    uavs: int  # `FEWEST` to `MOST`
    group: int | None = None  # UAVs per agent; None: as the template's first agent, or all
    name: str | None = None  # of the scenario; None: that of the template with the number of UAVs
    vehicle: str | None = None  # file or name; None: the paper's UAV
    load_kg: float | None = None  # mass of the payload; None: half that of the UAVs

    @property
    def load_in_words(self) -> str:
        """The load as errors name it."""
        return f"load_kg={self.load_kg:g}"

    @property
    def name_in_words(self) -> str:
        """The name as errors name it."""
        return f"name={self.name!r}"

    def origins(self) -> tuple[Origin, ...]:
        """Return the sources of the values that are not those of the template."""
        origins: list[Origin] = []
        if self.vehicle is not None:
            file = str(find_vehicle(self.vehicle))
            origins += origins_in(read_vehicle(self.vehicle).keys, file)
            origins.append(Origin(key="system.uav", source=file))
        if self.load_kg is not None:
            origins.append(Origin(key="system.payload", source=self.load_in_words))
        if self.name is not None:
            origins.append(Origin(key="name", source=self.name_in_words))
        return tuple(origins)

    def with_source(self, error: ScenarioError) -> ScenarioError:
        """Return an error of this team's scenario with the source of the refused value."""
        if isinstance(error, HoverError) and self.load_kg is not None:
            return ScenarioError(self.load_in_words, error.field, error.problem)
        return error.traced(self.origins())


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


def papers_airframe() -> AirframeSection:
    """Return the UAV of the paper and its distance from its neighbours, Table I."""
    paper = table_1()
    uav = paper.uavs[0]
    radius_m = math.hypot(*uav.rho[:2].tolist())
    return AirframeSection(
        mass_kg=uav.mass,
        inertia_kgm2=uav.inertia.diagonal().tolist(),
        rod_length_m=uav.rod_length,
        spacing_m=2.0 * radius_m * math.sin(math.pi / paper.N),
    )


def ring(
    N: int,
    gravity_mps2: float,
    airframe: AirframeSection | None = None,
    load_kg: float | None = None,
) -> dict[str, Any]:
    """Return the section `system` of N UAVs, 2 or more, in a ring.

    By default UAVs and their distance are the paper's, and the payload is the paper's per UAV, in
    proportion to the UAV's mass: half of it. Four UAVs are Table I. Source: docs/scenario.md.
    """
    paper = table_1()
    papers_uav = paper.uavs[0]
    own = airframe or papers_airframe()

    # Neighbours on a circle of radius r are 2 r sin(pi / N) apart.
    x_m, y_m, z_m = papers_uav.rho.tolist()
    radius_m = own.spacing_m / (2.0 * math.sin(math.pi / N))
    scale = radius_m / math.hypot(x_m, y_m)

    payload_kg = load_kg
    if payload_kg is None:
        # The paper's payload per UAV, in proportion to the UAV's mass.
        payload_kg = paper.payload.mass * N / paper.N * (own.mass_kg / papers_uav.mass)

    # The payload keeps its shape: J ~ m r^2.
    inertia_kgm2 = paper.payload.inertia.diagonal() * (payload_kg / paper.payload.mass * scale**2)

    return {
        "gravity_mps2": gravity_mps2,
        "payload": {"mass_kg": payload_kg, "inertia_kgm2": _rounded(inertia_kgm2)},
        "uav": [
            {
                "id": number,
                "rho_m": _rounded(_on_circle(number, N, radius_m, scale * z_m)),
                "mass_kg": own.mass_kg,
                "inertia_kgm2": own.inertia_kgm2,
                "rod_length_m": own.rod_length_m,
            }
            for number in range(1, N + 1)
        ],
    }


def resized(template: Scenario, team: Team, source: str) -> Scenario:
    """Return a scenario for a team, with the keys of its vehicle and otherwise of the template.

    Errors name the source of the refused value: vehicle, load, name, or `source` of the template.

    Raises: ScenarioError: the template names agents that are gone, or a value is invalid.
    """
    vehicle = None if team.vehicle is None else read_vehicle(team.vehicle)

    basis = template.name
    tree = given_values(template)
    if vehicle is not None:
        basis = f"{template.name}-{vehicle.name}"
        tree = _merged(tree, vehicle.keys)

    airframe = None if vehicle is None else vehicle.uav
    tree["name"] = f"{basis}-{team.uavs}" if team.name is None else team.name
    tree["system"] = ring(team.uavs, template.system.gravity_mps2, airframe, team.load_kg)
    tree["agents"] = {"owned": _owned(template, team)}

    try:
        return validate(tree, source)
    except ScenarioError as error:
        raise team.with_source(error) from error.__cause__


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
    counter-clockwise. There y is to the right, as z points down, so the angle falls.
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
