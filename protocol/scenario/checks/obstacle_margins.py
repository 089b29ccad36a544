"""Margins of obstacles along the reference, also between the instants at which it is computed."""

from collections.abc import Callable, Sequence

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.obstacles import Obstacle, bodies, clearances
from transport.model.physics.parameters import System
from transport.model.physics.rotations import rotation
from transport.model.state import THETA0, StateView

# An interval of the path is halved until the team moves by less than this within it, m. Between two
# such instants a clearance is less than half of it smaller than at one of them.
_RESOLUTION_M = 0.01


def first_blocked(
    system: System,
    obstacles: Sequence[Obstacle],
    states_at: Callable[[Array], Array],
    times_s: Array,
) -> tuple[int, str] | None:
    """Return the first obstacle, from 1, whose margins a path violates, with expected and got.

    The path is given by the states of the team, (k, n), at times, (k,), s. `times_s` are the rising
    instants to begin with; more are added where an obstacle is near. None if all margins are kept.
    """
    for number, obstacle in enumerate(obstacles, start=1):
        times, clear_m = _nearest(system, obstacle, states_at, times_s)
        margins_m = obstacle.margins(system.N)

        row, body = np.unravel_index(np.argmin(clear_m - margins_m), clear_m.shape)
        if clear_m[row, body] < margins_m[body]:
            between = f"{bodies(system.N)[body]} and the {obstacle.name} along the reference"
            got_m = max(float(clear_m[row, body]), 0.0)
            got = f"{got_m:.3g} m at {times[row]:g} s"
            return number, f"expected {margins_m[body]:g} m between {between}, got {got}"
    return None


def _nearest(
    system: System, obstacle: Obstacle, states_at: Callable[[Array], Array], times_s: Array
) -> tuple[Array, Array]:
    """Return instants, (k,), s, dense near the obstacle, and clearances then, (k, 2 N + 1), m."""
    margins_m = obstacle.margins(system.N)
    x = states_at(times_s)
    times = times_s
    clear_m = clearances(system, obstacle, x)

    while len(times) > 1:
        # A distance changes by no more than its body moves (it is 1-Lipschitz), so between two
        # instants with clearances a and b and a way w it is at least (a + b - w) / 2.
        moved_m = _moved(system, x)
        over_m = (clear_m - margins_m).min(axis=1)
        least_m = (over_m[1:] + over_m[:-1] - moved_m) / 2.0

        halved = np.flatnonzero((least_m < 0.0) & (moved_m > _RESOLUTION_M))
        middles_s = (times[halved] + times[halved + 1]) / 2.0
        inside = (middles_s > times[halved]) & (middles_s < times[halved + 1])  # not by rounding
        if not inside.any() or over_m.min() < 0.0:
            break

        x_middle = states_at(middles_s[inside])
        places = halved[inside] + 1
        times = np.insert(times, places, middles_s[inside])
        x = np.insert(x, places, x_middle, axis=0)
        clear_m = np.insert(clear_m, places, clearances(system, obstacle, x_middle), axis=0)
    return times, clear_m


def _moved(system: System, x: Array) -> Array:
    """Return the largest way of any UAV or attachment point between states, (k - 1,), m."""
    view = StateView(x)
    rho = np.array([uav.rho for uav in system.uavs])
    lengths_m = np.array([uav.rod_length for uav in system.uavs])
    R_IP = np.array([rotation(Theta) for Theta in x[:, THETA0]])

    attachments_I = view.r0_I[:, None] + np.einsum("kij,nj->kni", R_IP, rho)
    uavs_I = attachments_I - lengths_m[:, None] * np.einsum("kij,knj->kni", R_IP, view.e_P)
    points_I = np.concatenate([attachments_I, uavs_I], axis=1)
    return np.asarray(np.linalg.norm(np.diff(points_I, axis=0), axis=2).max(axis=1))
