"""The limits of a scenario in words: the closest pair, the limit of a UAV with the least room, and a remedy."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.model.path.curves import ORDERS
from transport.protocol.scenario.checks.feasibility import Extreme, extremes, remaining_teams
from transport.protocol.scenario.checks.reference_limits import (
    checked_instants,
    instant_in_words,
    phase_number,
)
from transport.protocol.scenario.setup.run_setup import Setup

_PERCENT = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestLimit:
    """The limit of a UAV that has the least room of all, and when, s; None at hover."""

    extreme: Extreme
    at_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosestPair:
    """The two UAVs, 0-based, that come closest along the reference, and when, s."""

    uavs: tuple[int, int]
    distance_m: float
    at_s: float


def nearest_limit(setup: Setup) -> NearestLimit:
    """Return the limit with the least room, as a share of it, on the reference of the whole team.

    Distances are apart from it (`closest_pair`). A flat reference has inputs and tilts of its own;
    for one of hover they are those of hover.
    Source: docs/equations.md (69).
    """
    reference = setup.reference
    team = next(remaining_teams(setup.system, setup.hover, setup.faults))
    if not reference.is_flat:
        at_rest = np.zeros((ORDERS, 1, 3))
        return NearestLimit(extreme=_least_room(extremes(at_rest, team, setup.settings)), at_s=None)

    instants_s = checked_instants(reference)
    path = reference.maneuver.jets(instants_s)
    found = _least_room(extremes(path, team, setup.settings))
    return NearestLimit(extreme=found, at_s=float(instants_s[found.instant]))


def _least_room(found: Sequence[Extreme]) -> Extreme:
    """Return the extreme of a UAV, not of a pair, with the least room."""
    return min((one for one in found if len(one.uavs) == 1), key=lambda one: one.room)


def closest_pair(setup: Setup) -> ClosestPair | None:
    """Return the closest pair of UAVs along the reference; None for one UAV.

    Of pairs that are equally close to a millimetre, the first, at the first time.
    """
    N = setup.system.N
    if N == 1:
        return None
    times_s = setup.reference.times_s
    uavs_I: Array = setup.reference.outputs(times_s)[:, : 3 * N].reshape(-1, N, 3)
    distances_m = {
        pair: np.linalg.norm(uavs_I[:, pair[0]] - uavs_I[:, pair[1]], axis=1).round(3)
        for pair in combinations(range(N), 2)
    }
    pair = min(distances_m, key=lambda pair: distances_m[pair].min())
    row = int(distances_m[pair].argmin())
    return ClosestPair(
        uavs=pair, distance_m=float(distances_m[pair][row]), at_s=float(times_s[row])
    )


def explained(setup: Setup) -> Mapping[str, Any]:
    """Return closest pair and nearest limit as JSON data; UAVs count from 1."""
    nearest = nearest_limit(setup)
    closest = closest_pair(setup)
    extreme = nearest.extreme
    return {
        "closest_pair": closest
        and {
            "uavs": [uav + 1 for uav in closest.uavs],
            "distance_m": closest.distance_m,
            "at_s": closest.at_s,
        },
        "nearest_limit": {
            "limit": extreme.quantity,
            "bound": extreme.bound,
            "value": extreme.value,
            "unit": extreme.unit.strip(),
            "room": extreme.room,
            "uavs": [uav + 1 for uav in extreme.uavs],
            "at_s": nearest.at_s,
        },
    }


def explained_in_words(setup: Setup) -> Iterator[str]:
    """Yield closest pair, nearest limit and remedy, a line each."""
    closest = closest_pair(setup)
    if closest is not None:
        first, second = (f"UAV{uav + 1}" for uav in closest.uavs)
        when = instant_in_words(setup.maneuver, closest.at_s)
        text = f"closest pair: {first} and {second}, {closest.distance_m:.3f} m{when}"
        separation = setup.settings.separation
        minimum = "" if separation is None else f"; at least {separation.minimum_m:g} m"
        yield f"{text}{minimum}"

    nearest = nearest_limit(setup)
    extreme = nearest.extreme
    where = " at hover" if nearest.at_s is None else instant_in_words(setup.maneuver, nearest.at_s)
    value = f"{extreme.value:.4g}{extreme.unit} of {extreme.names}{where}"
    room = f"{_PERCENT * extreme.room:.0f} % of room"
    yield f"nearest limit: {extreme.quantity} {extreme.bound:.4g}{extreme.unit}: {value}, {room}"
    yield f"more room: {_remedy(setup, nearest)}"


def _remedy(setup: Setup, nearest: NearestLimit) -> str:
    """Return what gives the nearest limit more room."""
    if nearest.at_s is None:
        return "a lighter payload, more UAVs, or a wider range of controller.limits"
    number = phase_number(setup.maneuver, nearest.at_s)
    phase = setup.maneuver.phases[number - 1]
    if not phase.has_way and phase.formation is None:
        return "a lighter payload, more UAVs, or a wider range of controller.limits"
    longer = f"a longer maneuver.phase.{number} ({phase.name}), or a smaller speed_mps in it"
    return f"{longer}; or a wider range of controller.limits"
