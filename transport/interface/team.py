"""A scenario in one call: a team of a vehicle, and a path of the payload."""

from collections.abc import Sequence
from os import PathLike
from typing import Any, Unpack

import numpy as np

from transport.interface.scenario import Scenario
from transport.interface.settings import ArgumentError, Settings, ShortSettings, public


@public
def team(
    uavs: int = 4,
    *,
    vehicle: "str | PathLike[str] | None" = None,
    load_kg: float | None = None,
    base: "str | PathLike[str] | Scenario" = "resilient",
    settings: Settings | None = None,
    **short: Unpack[ShortSettings],
) -> Scenario:
    """Return the scenario of a team of UAVs in a ring over a load.

    >>> import transport
    >>> transport.team(4, vehicle="x500", load_kg=3)
    Scenario('resilient-x500-4': 4 UAVs, 4 agents, 25 s)

    Args:
        uavs: Number of UAVs.
        vehicle: Vehicle file, or crazyflie, x500, racing; by default the paper's.
        load_kg: Mass of the payload, kg; by default half the mass of the UAVs.
        base: Scenario with all other keys: maneuver, controller, network.
        settings: Changes by dotted key.
        short: Changes by short name.

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is.
    """
    made = Scenario(base).resized(uavs, vehicle=vehicle, load_kg=load_kg)
    return made.copy(settings, **short)


def path_phase(path: Sequence[Sequence[float]], *, flat: bool) -> dict[str, Any]:
    """Return the phase of a maneuver along rows of time and position, (t_s, x_m, y_m, z_m), counted from the first.

    Raises: ArgumentError: rows of another kind.
    """
    try:
        rows = np.asarray(path, dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != 4 or len(rows) < 2:
        raise ArgumentError(f"path: expected two or more rows of t_s, x_m, y_m, z_m, got {path!r:.60}")
    rows = rows - rows[0]
    if flat:
        points, times = rows[1:, 1:].tolist(), rows[1:, 0].tolist()
        ramp_s = min(3.0, times[-1] / 2.0)
        return {"name": "path", "kind": "spline", "points_m": points, "times_s": times, "ramp_s": ramp_s}
    return {"name": "path", "way": rows.tolist()}
