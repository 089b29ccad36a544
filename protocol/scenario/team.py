"""A team of any size: the paper's UAVs in a ring over a payload of the paper's shape.

Only the system is new; the rest is taken from an existing scenario (docs/scenario.md, "A team of any size").
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from model.parameters import table_1
from protocol.scenario.file import validate
from protocol.scenario.files import anchored
from protocol.scenario.schema import PayloadSection, Scenario, SystemSection, UavSection
from protocol.wire.names import MAX_UAVS

# One rod leaves the payload free to turn about it: no force along the rods changes its heading.
FEWEST, MOST = 2, MAX_UAVS

# Decimals of lengths and inertias, m and kg m^2: readable, and fine enough not to affect a run.
_DECIMALS = 6


def ring(N: int, gravity_mps2: float) -> SystemSection:
    """Return N of the paper's UAVs over a payload of the paper's shape, as large as the ring has to be.

    Neighbours are as far apart as the paper's, 0.5 m, and each carries as much, 0.75 kg. The payload's lengths,
    the height of the attachment points among them, grow with the radius, its inertia with mass times radius^2.
    UAV 1 is the first to the right of the x axis (forward), an axis of symmetry; they count counter-clockwise seen
    from above. Four of them are Table I.

    Args:
        N: Number of UAVs, 2 or more.
        gravity_mps2: g, m/s^2.
    """
    paper = table_1()
    uav, payload = paper.uavs[0], paper.payload
    x, y, z = uav.rho.tolist()
    paper_radius = math.hypot(x, y)
    neighbours = 2.0 * paper_radius * math.sin(math.pi / paper.N)
    radius = neighbours / (2.0 * math.sin(math.pi / N))
    scale = radius / paper_radius
    mass = payload.mass * N / paper.N
    inertia = payload.inertia.diagonal() * (mass / payload.mass * scale**2)
    angles = [math.pi / N * (1 - 2 * i) for i in range(N)]
    return SystemSection(
        gravity_mps2=gravity_mps2,
        payload=PayloadSection(mass_kg=mass, inertia_kgm2=_rounded(inertia)),
        uav=[
            UavSection(
                id=i,
                mass_kg=uav.mass,
                inertia_kgm2=uav.inertia.diagonal().tolist(),
                rho_m=tuple(_rounded([radius * math.cos(angle), radius * math.sin(angle), scale * z])),
                rod_length_m=uav.rod_length,
            )
            for i, angle in enumerate(angles, start=1)
        ],
    )


def resized(
    template: Scenario, folder: Path, uavs: int, *, group: int | None, name: str | None, source: str
) -> Scenario:
    """Return a scenario for N UAVs: a ring of them, and every other section of the template.

    Args:
        template: Source of controller, clock, links, maneuver, ... and gravity.
        folder: Of the template's file; paths in it are relative to that and become absolute.
        uavs: N, from `FEWEST` to `MOST`.
        group: UAVs per agent, the last agent may have fewer; None: as many as the template's first agent has, and
            all of them where that one has all.
        name: Of the scenario; the template's with the number of UAVs when None.
        source: Name of the template in error texts.
    Returns: The scenario, with no more keys given than the template gives.
    Raises: ScenarioError: the template names agents that this team does not have, or the name is invalid.
    """
    if group is None:
        group = uavs if len(template.owned) == 1 else len(template.owned[0])
    ids = list(range(1, uavs + 1))
    tree: dict[str, Any] = anchored(given(template), folder)
    tree["name"] = f"{template.name}-{uavs}" if name is None else name
    tree["system"] = ring(uavs, template.system.gravity_mps2).model_dump(mode="json")
    tree["agents"] = {"owned": [ids[i : i + group] for i in range(0, uavs, group)]}
    return validate(tree, source)


def given(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as plain data, with the given values only."""
    return scenario.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude_none=True)


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), _DECIMALS) + 0.0 for value in values]  # + 0.0: no -0.0 in the file
