"""What UAVs see of obstacles that their agents have not been told of: `Measurement.seen`."""

from collections.abc import Sequence

import numpy as np

from transport.model.arrays import Array
from transport.plant.plant_run import HiddenObstacle
from transport.protocol.wire.message_form import ENDLESS_M, MAX_SOLIDS
from transport.protocol.wire.messages import SOLID


def seen_from(places_I: Array, hidden: Sequence[HiddenObstacle]) -> Array:
    """Return the solids of the obstacles whose surface is near enough to one of some UAVs.

    Args:
        places_I: Positions of the UAVs, inertial frame, (k, 3), m.
        hidden: Obstacles that only sight tells.
    Returns: Rows of `Measurement.seen`, (solids, `SOLID`).
    """
    rows: list[list[float]] = []
    for one in hidden:
        distances_m, _ = one.obstacle.from_points(places_I)
        if distances_m.min() > one.seen_within_m:
            continue
        margins_m = one.obstacle.margin_m, one.obstacle.load_margin_m
        for solid in one.obstacle.solids:
            half = np.minimum(solid.half, ENDLESS_M)
            sizes = [*half.tolist(), solid.radius, *margins_m]
            rows.append([one.number, *solid.centre_I.tolist(), solid.heading_rad, *sizes])
    return np.array(rows[:MAX_SOLIDS]).reshape(-1, SOLID)
