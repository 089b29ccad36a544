"""A team of any size: UAVs in a ring over a payload of the paper's shape.

All else is that of a scenario.
"""

import math
from collections.abc import Iterable
from typing import Annotated, Any

from transport.model.parameters import table_1
from transport.mpc.settings import Key, Positive, Section
from transport.protocol.scenario.errors import validated
from transport.protocol.scenario.file import find_scenario, read_tree, validate
from transport.protocol.scenario.schema import Inertia, Scenario
from transport.protocol.wire.names import MAX_UAVS

FEWEST, MOST = 2, MAX_UAVS  # one rod leaves the payload free to turn about it
_DECIMALS = (
    6  # of lengths and inertias, m and kg m^2: readable, and fine enough not to affect a run
)


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


def read_vehicle(name: str) -> Vehicle:
    """Return a vehicle: of a file, or a ready one by its name.

    Raises: ScenarioError: as `read_scenario`.
    """
    path = find_scenario(name, "vehicles")
    return validated(Vehicle, read_tree(path), str(path))


def ring(
    N: int,
    gravity_mps2: float,
    airframe: AirframeSection | None = None,
    load_kg: float | None = None,
) -> dict[str, Any]:
    """Return the section `system` of N UAVs, 2 or more, in a ring over a payload of the paper's shape.

    By default UAVs, their distance and the load of each, half its mass, are the paper's: four are
    Table I. Source: docs/scenario.md.
    """
    paper = table_1()
    uav, payload = paper.uavs[0], paper.payload
    x, y, z = uav.rho.tolist()
    paper_radius = math.hypot(x, y)
    own = airframe or AirframeSection(
        mass_kg=uav.mass,
        inertia_kgm2=uav.inertia.diagonal().tolist(),
        rod_length_m=uav.rod_length,
        spacing_m=2.0 * paper_radius * math.sin(math.pi / paper.N),
    )
    mass = payload.mass * N / paper.N * (own.mass_kg / uav.mass) if load_kg is None else load_kg
    radius = own.spacing_m / (2.0 * math.sin(math.pi / N))
    scale = radius / paper_radius
    inertia = payload.inertia.diagonal() * (mass / payload.mass * scale**2)
    angles = [math.pi / N * (1 - 2 * i) for i in range(N)]
    rho_m = [_rounded([radius * math.cos(a), radius * math.sin(a), scale * z]) for a in angles]
    same: dict[str, Any] = {
        "mass_kg": own.mass_kg,
        "inertia_kgm2": own.inertia_kgm2,
        "rod_length_m": own.rod_length_m,
    }
    return {
        "gravity_mps2": gravity_mps2,
        "payload": {"mass_kg": mass, "inertia_kgm2": _rounded(inertia)},
        "uav": [{"id": i, "rho_m": place, **same} for i, place in enumerate(rho_m, start=1)],
    }


def resized(
    template: Scenario,
    uavs: int,
    *,
    group: int | None,
    name: str | None,
    source: str,
    vehicle: str | None = None,
    load_kg: float | None = None,
) -> Scenario:
    """Return a scenario for a ring of `FEWEST` to `MOST` UAVs, with the keys of their vehicle and of the template.

    By default the group, UAVs per agent, is that of the template's first agent, or all; the name is
    the template's with the number of UAVs; the vehicle, a file or name, is the paper's; the load
    has half the mass of the UAVs. `source`
    names the template in errors. Raises: ScenarioError: the template names agents that are gone, or
        a value is invalid.
    """
    chosen = None if vehicle is None else read_vehicle(vehicle)
    group = group or (uavs if len(template.owned) == 1 else len(template.owned[0]))
    ids, basis, tree = list(range(1, uavs + 1)), template.name, given(template)
    if chosen is not None:
        tree = _merged(tree, {"controller": chosen.controller, "plant": chosen.plant})
        basis = f"{template.name}-{chosen.name}"
    tree["name"] = f"{basis}-{uavs}" if name is None else name
    tree["system"] = ring(
        uavs, template.system.gravity_mps2, chosen.uav if chosen else None, load_kg
    )
    tree["agents"] = {"owned": [ids[i : i + group] for i in range(0, uavs, group)]}
    return validate(tree, source)


def given(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as plain data, with the given values only."""
    return scenario.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude_none=True)


def _merged(tree: Any, changes: Any) -> Any:
    """Return a tree with the values of another one in place of its own."""
    if not (isinstance(tree, dict) and isinstance(changes, dict)):
        return changes
    return {**tree, **{key: _merged(tree.get(key), value) for key, value in changes.items()}}


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), _DECIMALS) + 0.0 for value in values]  # + 0.0: no -0.0 in the file
