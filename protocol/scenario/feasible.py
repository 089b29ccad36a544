"""Limits that a flat reference keeps, checked before anything starts."""

import math
from collections.abc import Callable, Collection
from itertools import combinations

import numpy as np

from model.arrays import Array
from model.flat import LEAST_TENSION, MOST_TILT, flight, slowed
from model.hover import Hover
from model.parameters import System
from model.state import INPUTS, StateView
from mpc.settings import ControllerSettings

# Largest slowing tried, and relative accuracy of the one found.
_SLOWEST = 64.0
_ACCURACY = 1e-3


def exceeded(
    path: Array, system: System, hover: Hover, settings: ControllerSettings, released: Collection[int] = ()
) -> str | None:
    """Return the first limit that the team exceeds along a path, as expected and got; None if it keeps all.

    Given are the jets of the path, (7, k, 3), and UAVs, 0-based, released before it. Source: docs/equations.md (69).
    """
    left = [uav for uav in range(system.N) if uav not in released]
    held = hover.tensions[left]
    if not held.min() >= LEAST_TENSION * held.mean():
        return f"expected all rods of the UAVs left to carry the payload at hover, got {held.min():.4g} N in one"
    rho, lengths = np.array([uav.rho for uav in system.uavs]), np.array([uav.rod_length for uav in system.uavs])
    if path.shape[-1] > 3:
        aside = float((np.linalg.norm((path[0, :, None, 3:] - 1.0) * rho[:, :2], axis=-1) / lengths).max())
        if aside >= 1.0:
            return f"expected a formation with UAVs less than a rod's length off their attachments, got {aside:.3g}"
    flown, limits = flight(system, hover, path, released=released), settings.limits
    view, inputs = StateView(flown.x), flown.u.reshape(len(flown.x), system.N, INPUTS)[:, left]
    pulled = (flown.tensions / hover.tensions)[:, left]
    tilt_deg = min(math.degrees(MOST_TILT), settings.tilt.limit_deg if settings.tilt else math.inf)
    places = rho - lengths[:, None] * view.e_P
    apart = [np.linalg.norm(places[:, i] - places[:, j], axis=1).min() for i, j in combinations(left, 2)]
    lowest: list[tuple[str, str, float, float]] = [
        ("a thrust of at least", " N", limits.thrust_N[0], inputs[..., 0].min()),
        ("a share of the rod tension at hover of at least", "", LEAST_TENSION, pulled.min()),
    ]
    if settings.tension is not None:
        lowest.append(("a rod tension of at least", " N", settings.tension.minimum_N, flown.tensions.min()))
    if settings.separation is not None and apart:
        lowest.append(("a distance of UAVs of at least", " m", settings.separation.minimum_m, min(apart)))
    highest: list[tuple[str, str, float, float]] = [
        ("a thrust of at most", " N", limits.thrust_N[1], inputs[..., 0].max()),
        ("a UAV tilt of at most", " deg", tilt_deg, math.degrees(np.abs(view.Theta[:, left]).max())),
    ]
    what, unit = ("a commanded rate", " rad/s") if system.commands_rates else ("a moment", " N m")
    largest = zip(settings.upper(1)[1:], np.abs(inputs[..., 1:]).max(axis=(0, 1)), strict=True)
    highest += [(f"{what} about axis {axis} of at most", unit, *both) for axis, both in enumerate(largest, start=1)]
    for sign, limit_list in ((1.0, highest), (-1.0, lowest)):
        for what, unit, limit, got in limit_list:
            if not sign * got <= sign * limit:
                return f"expected {what} {limit:.4g}{unit} along the reference, got {got:.4g}{unit}"
    return None


def least_slowing(
    path: Array, system: System, hover: Hover, settings: ControllerSettings, released: Collection[int] = ()
) -> float | None:
    """Return the least factor on all durations with which the team keeps all limits; None if none does."""
    fits: Callable[[float], bool] = lambda factor: (  # noqa: E731
        exceeded(slowed(path, factor), system, hover, settings, released) is None
    )
    low, high = 1.0, 2.0
    while not fits(high):
        if high >= _SLOWEST:
            return None
        low, high = high, 2.0 * high
    while high > (1.0 + _ACCURACY) * low:
        middle = (low + high) / 2.0
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
