"""Time series of a run, the basis of every metric and figure.

The swing at its end; estimates of the agents.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.payload_pose import NAMES, poses
from transport.log.run_log import RunLog
from transport.model import state
from transport.model.arrays import Array
from transport.model.obstacles import clearances
from transport.model.rotations import rotation
from transport.protocol.scenario.faults import failures
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.stage_cost import StageCost
from transport.protocol.wire.messages import (
    Note,
    PlantState,
    Target,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Plant states and references of N UAVs at T recorded ticks, ascending, perhaps with gaps.

    Positions are in the inertial frame (z down), m.
    """

    ticks: npt.NDArray[np.int64]  # (T,)
    times_s: Array  # t_k, (T,)
    x: Array  # states, (T, 12 + 12 N), SI
    u: Array  # inputs applied from t_k on, (T, 4 N), N and N m
    uavs_I: Array  # (T, N, 3)
    payload_reference_I: Array  # (T, 3)
    uav_references_I: Array  # (T, N, 3)
    cost: Array  # stage cost, docs/equations.md (21), (T,); of the remaining team after a UAV failure, see `StageCost`
    attitude_deg: Array  # payload roll, pitch, yaw, (T, 3)
    on_rods: npt.NDArray[np.bool_]  # whether a UAV has not been released, (T, N)
    separation_m: (
        Array  # smallest distance between two UAVs on their rods, (T,); infinite for one UAV
    )
    clearance_m: Array  # smallest distances of UAVs on their rods, rods, payload from obstacles, (T, 3); or infinite
    violation: Array  # largest constraint violation relative to the constraint's range, (T,); see `_violation`
    local_error: Array  # largest local error estimate of the plant's integration where it is known, (<= T,), SI

    @property
    def payload_error_I(self) -> Array:
        """Payload position minus its reference, (T, 3), inertial frame, m."""
        return self.x[:, state.R0] - self.payload_reference_I

    @property
    def payload_error_norm_m(self) -> Array:
        """Distance of the payload from its reference, (T,), m."""
        return np.asarray(np.linalg.norm(self.payload_error_I, axis=1))

    @property
    def payload_velocity_I(self) -> Array:
        """Payload velocity, (T, 3), inertial frame, m/s."""
        R_IP = np.array([rotation(Theta0) for Theta0 in self.x[:, state.THETA0]]).reshape(-1, 3, 3)
        return np.asarray(np.einsum("tij,tj->ti", R_IP, self.x[:, state.V0]))

    @property
    def uav_errors_I(self) -> Array:
        """UAV positions minus their references, (T, N, 3), inertial frame, m.

        NaN for released UAVs.
        """
        return np.where(self.on_rods[:, :, None], self.uavs_I - self.uav_references_I, np.nan)

    def uav_error_max_m(self, owned: Sequence[Sequence[int]]) -> Array:
        """Return the largest position error of the UAVs of each agent, (T, agents), m.

        NaN where all of them are released. `owned` has the UAVs of the agents, 0-based.
        """
        errors_m = np.linalg.norm(self.uav_errors_I, axis=2)
        largest_m = [
            np.where(self.on_rods[:, uavs], errors_m[:, uavs], -np.inf).max(axis=1)
            for uavs in map(list, owned)
        ]
        largest = np.column_stack(largest_m)
        return np.where(largest >= 0.0, largest, np.nan)

    @property
    def attitude_max_deg(self) -> Array:
        """Largest magnitude of the payload's roll, pitch and yaw, (T,), deg."""
        return np.asarray(np.abs(self.attitude_deg).max(axis=1, initial=0.0))


def series_of(setup: Setup, log: RunLog) -> Series:
    """Return the series of a run from its recorded plant states.

    Those of another number of UAVs are left out.
    """
    setup = setup.after(log.of(Target))
    plant_states = {
        entry.tick: entry for entry in log.of(PlantState) if entry.x.shape == setup.hover.x.shape
    }
    ticks = np.array(sorted(plant_states), dtype=np.int64)
    times_s: Array = ticks.astype(np.float64) * setup.settings.sampling_period_s
    N = setup.system.N
    x = np.array([plant_states[tick].x for tick in ticks]).reshape(-1, len(setup.hover.x))
    u = np.array([plant_states[tick].u for tick in ticks]).reshape(-1, state.INPUTS * N)
    y_ref = setup.reference.outputs(times_s)
    y = np.array([setup.model.outputs(row) for row in x]).reshape(y_ref.shape)
    uavs_I = y[:, : 3 * N].reshape(len(ticks), N, 3)
    cost = StageCost(setup)
    on_rods = np.ones((len(ticks), N), dtype=bool)
    for fault in failures(setup.faults):
        on_rods[ticks >= fault.tick, fault.uav] &= fault.do != "release"
    separation_m, clear_m = _separation(uavs_I, on_rods), _clearances(setup, x, on_rods)
    return Series(
        ticks=ticks,
        times_s=times_s,
        x=x,
        u=u,
        uavs_I=uavs_I,
        payload_reference_I=setup.maneuver.path(times_s)[0],
        uav_references_I=y_ref[:, : 3 * N].reshape(len(ticks), N, 3),
        cost=np.array(
            [cost.at(int(tick), *row) for tick, *row in zip(ticks, y, y_ref, u, strict=True)],
            dtype=float,
        ),
        attitude_deg=np.degrees(x[:, state.THETA0]),
        on_rods=on_rods,
        separation_m=separation_m,
        clearance_m=clear_m.min(axis=0, initial=np.inf),
        violation=_violation(setup, ticks, u, separation_m, clear_m[..., 0]),
        local_error=np.array(
            [e for tick in ticks if (e := plant_states[tick].local_error) >= 0.0], dtype=np.float64
        ),
    )


def _separation(uavs_I: Array, on_rods: npt.NDArray[np.bool_]) -> Array:
    """Return the smallest distance between any two UAVs on their rods, (T,), m."""
    i, j = np.triu_indices(uavs_I.shape[1], 1)
    distances_m = np.linalg.norm(uavs_I[:, i] - uavs_I[:, j], axis=2)
    return np.asarray(
        np.where(on_rods[:, i] & on_rods[:, j], distances_m, np.inf).min(axis=1, initial=np.inf)
    )


def _clearances(setup: Setup, x: Array, on_rods: npt.NDArray[np.bool_]) -> Array:
    """Return the smallest distances of UAVs on their rods, rods and payload from each obstacle, (k, T, 3), m."""
    N, found = setup.system.N, np.empty((len(setup.obstacles), len(x), 3))
    for row, obstacle in zip(found, setup.obstacles, strict=True):
        clear_m = clearances(setup.system, obstacle, x)
        for column in range(2):
            row[:, column] = np.where(
                on_rods, clear_m[:, N * column : N * (column + 1)], np.inf
            ).min(axis=1)
        row[:, 2] = clear_m[:, -1]
    return found


def _violation(
    setup: Setup, ticks: npt.NDArray[np.int64], u: Array, separation_m: Array, clear_m: Array
) -> Array:
    """Return the largest constraint violation at each tick as a share of the constraint's range, (T,); 0 if all hold.

    Ranges: largest minus smallest value of an input; twice its largest change per period; the
    minimum separation, and the margin of UAVs from obstacles, themselves. Changes across a gap in
    the record and own constraints do not count.
    """
    settings, N = setup.settings, setup.system.N
    lower, upper, step = settings.lower(N), settings.upper(N), settings.step(N)
    worst = (np.maximum(lower - u, u - upper) / (upper - lower)).max(axis=1, initial=0.0)
    before = np.vstack([setup.hover.u[None], u[:-1]])[: len(u)]
    change = (np.abs(u - before) - step) / (2.0 * step)
    for fault in failures(setup.faults):
        change[ticks == fault.tick, state.input_slice(fault.uav)] = (
            0.0  # stopping motors violates no limit
        )
    consecutive = np.diff(ticks, prepend=-1) == 1
    worst = np.maximum(worst, np.where(consecutive, change.max(axis=1, initial=0.0), 0.0))
    if settings.separation is not None:
        minimum_m = settings.separation.minimum_m
        worst = np.maximum(worst, (minimum_m - separation_m) / minimum_m)
    for obstacle, distance_m in zip(setup.obstacles, clear_m, strict=True):
        worst = np.maximum(worst, (obstacle.margin_m - distance_m) / obstacle.margin_m)
    return np.asarray(worst)


# End of the run in which the swing is measured, s: longer than the 3.6 s period of a pendulum of
# 3.2 m, and shorter than the last hover of the paper's maneuver, 5 s.
SWING_S = 4.0


def swing_of(setup: Setup, series: Series) -> float | None:
    """Return the largest payload position error in the last `SWING_S` of a run, m.

    None without a recorded tick.
    """
    if not len(series.ticks):
        return None
    periods = math.ceil(SWING_S / setup.settings.sampling_period_s - 1e-6)
    last = series.ticks > series.ticks[-1] - periods
    return float(series.payload_error_norm_m[last].max())


class Estimates(NamedTuple):
    """Estimates of the payload's pose (x, y, z, roll, pitch, yaw), m and rad, by all agents at some recorded ticks."""

    agents: npt.NDArray[np.intp]  # (k,), 1-based
    rows: npt.NDArray[np.intp]  # their ticks' rows in the series, (k,)
    pose: Array  # estimated, (k, 6)
    true: Array  # (k, 6)
    P: Array  # covariance of the error, (k, 6, 6)
    surprise: Array  # squared innovation of the newest measurements over its covariance, and their number, (k, 2)


def estimates_of(series: Series, log: RunLog) -> Estimates | None:
    """Return the estimates in a log; None if there are none."""
    at = {int(tick): row for row, tick in enumerate(series.ticks)}
    notes = [note for note in log.of(Note) if note.names == NAMES and note.tick in at]
    if not notes:
        return None
    numbers, rows = (
        np.array([note.values for note in notes]),
        np.array([at[note.tick] for note in notes]),
    )
    pose, P = poses(numbers)
    true = series.x[rows][:, np.r_[state.R0, state.THETA0]]
    return Estimates(np.array([note.agent for note in notes]), rows, pose, true, P, numbers[:, -2:])
