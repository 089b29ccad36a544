"""Time series of a run, the basis of every metric and figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from transport.analysis.distances_and_violations import clearances_of, separation_of, violations_of
from transport.analysis.targets_in_log import led_as_logged
from transport.log.run_log import RunLog
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.protocol.scenario.faults.faults_by_tick import failures
from transport.protocol.scenario.setup.collisions import Contact
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState


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
    # Stage cost, docs/equations.md (21), (T,); of the remaining team after a UAV failure, see
    # `StageCost`.
    cost: Array
    attitude_deg: Array  # payload roll, pitch, yaw, (T, 3)
    on_rods: npt.NDArray[np.bool_]  # whether a UAV has not been released, (T, N)
    # Smallest distance between two UAVs on their rods, (T,); infinite for one UAV.
    separation_m: Array
    # Smallest distances of UAVs on their rods, rods, payload from obstacles, (T, 3); or infinite.
    clearance_m: Array
    contact: Contact | None  # first contact of two UAVs with a size; None if there is none
    # Excess over each limit by its name, as a share of its range, (T,); see `violations_of`.
    violations: Mapping[str, Array]
    # Largest local error estimate of the plant's integration where it is recorded, (<= T,), SI.
    local_error: Array

    @property
    def violation(self) -> Array:
        """Largest excess over a limit, as a share of its range, (T,); 0 if all hold."""
        none = np.zeros(len(self.ticks))
        return np.asarray(np.max([none, *self.violations.values()], axis=0))

    @property
    def row_of_tick(self) -> dict[int, int]:
        """Rows of the series by tick."""
        return {int(tick): row for row, tick in enumerate(self.ticks)}

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
        columns = []
        for group in owned:
            uavs = list(group)
            flying_m = np.where(self.on_rods[:, uavs], errors_m[:, uavs], -np.inf)
            columns.append(flying_m.max(axis=1))

        largest_m = np.column_stack(columns)
        return np.where(largest_m >= 0.0, largest_m, np.nan)

    @property
    def attitude_max_deg(self) -> Array:
        """Largest magnitude of the payload's roll, pitch and yaw, (T,), deg."""
        return np.asarray(np.abs(self.attitude_deg).max(axis=1, initial=0.0))


def series_of(setup: Setup, log: RunLog) -> Series:
    """Return the series of a run from its recorded plant states.

    States of another number of UAVs are left out.
    """
    setup = led_as_logged(setup, log)
    states = _recorded_states(setup, log)
    N = setup.system.N
    ticks = np.array([entry.tick for entry in states], dtype=np.int64)
    times_s: Array = ticks.astype(np.float64) * setup.settings.sampling_period_s
    x = np.array([entry.x for entry in states]).reshape(-1, len(setup.hover.x))
    u = np.array([entry.u for entry in states]).reshape(-1, state.INPUTS * N)

    y_ref = setup.reference.outputs(times_s)
    y = np.array([setup.model.outputs(row) for row in x]).reshape(y_ref.shape)
    uavs_I = y[:, : 3 * N].reshape(len(ticks), N, 3)
    on_rods = _on_rods(setup, ticks)
    separation_m = separation_of(uavs_I, on_rods)
    clearance_m = clearances_of(setup, x, on_rods)

    return Series(
        ticks=ticks,
        times_s=times_s,
        x=x,
        u=u,
        uavs_I=uavs_I,
        payload_reference_I=setup.maneuver.path(times_s)[0],
        uav_references_I=y_ref[:, : 3 * N].reshape(len(ticks), N, 3),
        cost=_costs(setup, ticks, y, y_ref, u),
        attitude_deg=np.degrees(x[:, state.THETA0]),
        on_rods=on_rods,
        separation_m=separation_m,
        clearance_m=clearance_m.min(axis=0, initial=np.inf),
        contact=setup.contacts().over(states),
        violations=violations_of(setup, ticks, u, separation_m, clearance_m[..., 0]),
        local_error=_local_errors(states),
    )


def _recorded_states(setup: Setup, log: RunLog) -> list[PlantState]:
    """Return the plant states of the run's UAVs, one for each tick, ascending."""
    by_tick = {
        entry.tick: entry for entry in log.of(PlantState) if entry.x.shape == setup.hover.x.shape
    }
    return [by_tick[tick] for tick in sorted(by_tick)]


def _on_rods(setup: Setup, ticks: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return whether each UAV has not been released, (T, N)."""
    on_rods = np.ones((len(ticks), setup.system.N), dtype=bool)
    for fault in failures(setup.faults):
        if fault.do == "release":
            on_rods[ticks >= fault.tick, fault.uav] = False
    return on_rods


def _costs(setup: Setup, ticks: npt.NDArray[np.int64], y: Array, y_ref: Array, u: Array) -> Array:
    """Return the stage cost, docs/equations.md (21), (T,), of outputs, references and inputs."""
    cost = StageCost(setup)
    costs = [
        cost.at(int(tick), y_k, y_ref_k, u_k)
        for tick, y_k, y_ref_k, u_k in zip(ticks, y, y_ref, u, strict=True)
    ]
    return np.array(costs, dtype=float)


def _local_errors(states: Sequence[PlantState]) -> Array:
    """Return the local errors of the plant's integration, without those not recorded (< 0)."""
    errors = [entry.local_error for entry in states if entry.local_error >= 0.0]
    return np.array(errors, dtype=np.float64)
