"""Distances that a team kept from obstacles and within itself, and violations of constraints."""

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.obstacles import clearances
from transport.protocol.scenario.faults.faults_by_tick import failures
from transport.protocol.scenario.setup.run_setup import Setup

# Share of its range from which on an input is at its limit.
AT_LIMIT = 1e-4
# Inputs of a UAV: of one that is commanded moments, and of one that is commanded body rates.
_INPUTS = {
    False: ("thrust", "roll moment", "pitch moment", "yaw moment"),
    True: ("thrust", "roll rate", "pitch rate", "yaw rate"),
}


def separation_of(uavs_I: Array, on_rods: npt.NDArray[np.bool_]) -> Array:
    """Return the smallest distance between any two UAVs on their rods, (T,), m."""
    i, j = np.triu_indices(uavs_I.shape[1], 1)
    distances_m = np.linalg.norm(uavs_I[:, i] - uavs_I[:, j], axis=2)
    both = on_rods[:, i] & on_rods[:, j]
    return np.asarray(np.where(both, distances_m, np.inf).min(axis=1, initial=np.inf))


def clearances_of(setup: Setup, x: Array, on_rods: npt.NDArray[np.bool_]) -> Array:
    """Return the smallest distances from each of k obstacles, (k, T, 3), m.

    The last axis has UAVs on their rods, their rods, and the payload.
    """
    N = setup.system.N
    smallest_m = np.empty((len(setup.obstacles), len(x), 3))
    for of_obstacle_m, obstacle in zip(smallest_m, setup.obstacles, strict=True):
        distances_m = clearances(setup.system, obstacle, x)
        uavs_m = distances_m[:, :N]
        rods_m = distances_m[:, N : 2 * N]
        of_obstacle_m[:, 0] = np.where(on_rods, uavs_m, np.inf).min(axis=1)
        of_obstacle_m[:, 1] = np.where(on_rods, rods_m, np.inf).min(axis=1)
        of_obstacle_m[:, 2] = distances_m[:, -1]
    return smallest_m


def violations_of(
    setup: Setup, ticks: npt.NDArray[np.int64], u: Array, separation_m: Array, clearance_m: Array
) -> dict[str, Array]:
    """Return by how much each limit is exceeded at each tick, by its name, (T,); 0 or less if it holds.

    It is a share of the limit's range: largest minus smallest value of an input; twice its
    largest change per period; the minimum separation, and the margin of UAVs from obstacles,
    themselves. Changes across a gap in the record and own constraints do not count.
    """
    N = setup.system.N
    lower = setup.settings.lower(N)
    upper = setup.settings.upper(N)
    excess = np.maximum(lower - u, u - upper) / (upper - lower)
    violations = {
        "inputs": excess.max(axis=1, initial=0.0),
        "change of inputs": _change_excess(setup, ticks, u),
    }

    separation = setup.settings.separation
    if separation is not None:
        missing_m = separation.minimum_m - separation_m
        violations["separation"] = missing_m / separation.minimum_m

    obstacles = zip(setup.obstacles, clearance_m, strict=True)
    for number, (obstacle, distance_m) in enumerate(obstacles, start=1):
        missing_m = obstacle.margin_m - distance_m
        name = f"margin from obstacle {number} ({obstacle.name})"
        violations[name] = missing_m / obstacle.margin_m
    return violations


def _change_excess(setup: Setup, ticks: npt.NDArray[np.int64], u: Array) -> Array:
    """Return by how much the inputs change too fast, as a share of their range, (T,).

    0 across a gap in the record.
    """
    step = setup.settings.largest_step(setup.system.N)
    before = np.vstack([setup.hover.u[None], u[:-1]])[: len(u)]
    excess = (np.abs(u - before) - step) / (2.0 * step)
    for fault in failures(setup.faults):
        # Stopping motors violates no limit.
        excess[ticks == fault.tick, state.input_slice(fault.uav)] = 0.0

    consecutive = np.diff(ticks, prepend=-1) == 1
    return np.where(consecutive, excess.max(axis=1, initial=0.0), 0.0)


def limits_reached(
    setup: Setup, ticks: npt.NDArray[np.int64], u: Array
) -> dict[tuple[int, str], float]:
    """Return at which limits of its inputs each UAV was, and for which share of its ticks.

    The shares, above 0, are by UAV (0-based) and limit, largest first. Ticks with its motors off do
    not count. At a limit is an input within `AT_LIMIT` of its range from it, so that a solver's
    tolerance does not decide; a change across a gap in the record is at none.
    """
    at_limit = _at_limit(setup, ticks, u)
    stopped = {fault.uav: fault.tick for fault in failures(setup.faults)}

    shares: dict[tuple[int, str], float] = {}
    for uav in range(setup.system.N):
        is_on = ticks < stopped.get(uav, np.inf)
        entries = range(*state.input_slice(uav).indices(u.shape[1]))
        for name, entry in zip(_INPUTS[setup.system.commands_rates], entries, strict=True):
            for kind, reached in at_limit.items():
                share = float(reached[is_on, entry].mean()) if is_on.any() else 0.0
                if share > 0.0:
                    shares[uav, f"{kind} of {name}" if kind == "change" else f"{kind} {name}"] = (
                        share
                    )
    return dict(sorted(shares.items(), key=lambda entry: -entry[1]))


def _at_limit(
    setup: Setup, ticks: npt.NDArray[np.int64], u: Array
) -> dict[str, npt.NDArray[np.bool_]]:
    """Return which inputs are at a limit, (k, 4 N) each: the smallest, the largest, or the largest change."""
    N = setup.system.N
    lower = setup.settings.lower(N)
    upper = setup.settings.upper(N)
    margin = AT_LIMIT * (upper - lower)
    before = np.vstack([setup.hover.u[None], u[:-1]])[: len(u)]
    change = np.abs(u - before)
    is_followed = np.diff(ticks, prepend=-1) == 1
    return {
        "smallest": u <= lower + margin,
        "largest": u >= upper - margin,
        "change": is_followed[:, None]
        & (change >= (1.0 - 2.0 * AT_LIMIT) * setup.settings.largest_step(N)),
    }
