"""Noise that the Kalman filter assumes: first errors, sensors, the model's errors, unknown forces.

Standard deviations, SI, where no other quantity or unit is said; docs/equations.md after (63), (64)
has their reasons. benchmarks/estimates.py measures how well they fit together: it compares the
errors of the estimates with their covariance.
"""

from dataclasses import dataclass

import numpy as np

from transport.agent.estimation.filter.manifold import UAV_BLOCKS
from transport.agent.estimation.filter.unknown_forces import PAYLOAD_FORCE, UAV_FORCE
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.protocol.scenario.setup.team_run import SensorSheet


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstErrors:
    """Errors of the reference as an estimate before the first measurement."""

    payload_position_m: float = 0.3
    payload_velocity_mps: float = 0.2
    payload_tilt_rad: float = 0.06
    payload_yaw_rad: float = 0.015  # a formation at rest turns its load with it
    payload_rate_rads: float = 0.1
    payload_yaw_rate_rads: float = 0.02
    rod_rad: float = 0.06
    rod_rate_rads: float = 0.1
    uav_attitude_rad: float = 0.1
    uav_rate_rads: float = 0.2

    def by_coordinate(self, N: int) -> Array:
        """Return the standard deviations in coordinates of the manifold, (12 + 10 N,)."""
        payload = [
            *[self.payload_position_m] * 3,
            *[self.payload_velocity_mps] * 3,
            *[self.payload_tilt_rad] * 2,
            self.payload_yaw_rad,
            *[self.payload_rate_rads] * 2,
            self.payload_yaw_rate_rads,
        ]
        uav = (self.rod_rad, self.rod_rate_rads, self.uav_attitude_rad, self.uav_rate_rads)
        return np.concatenate([payload, np.tile(np.repeat(uav, UAV_BLOCKS), N)])


@dataclass(frozen=True, slots=True, kw_only=True)
class LeastSensorNoise:
    """Least noise assumed of sensors.

    Without it the filter would trust exact sensors more than the errors of its model allow.
    """

    position_m: float = 1e-3
    velocity_mps: float = 5e-3
    attitude_rad: float = 1e-3
    rate_rads: float = 2e-3
    specific_force_mps2: float = 0.1

    def variances(self, sheet: SensorSheet) -> Array:
        """Return the variances of a UAV's measurements, (15,), SI; a bias counts as noise."""
        least = [
            self.position_m,
            self.velocity_mps,
            self.attitude_rad,
            self.rate_rads,
            self.specific_force_mps2,
        ]
        noise = np.maximum(sheet.noise, least)
        return np.repeat(noise**2 + sheet.bias**2, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelNoise:
    """Errors of the equations of motion."""

    # White accelerations, m/s^2 and rad/s^2, in each sampling period. Where no forces are estimated
    # they are all that the model lacks: the largest ones, and the level scales their variance
    # (level.py).
    acceleration_alone: float = 0.01
    # Where forces are estimated: beside the random walks of these, unscaled.
    acceleration_beside_forces: float = 1e-3
    # Lag of motors that agents do not know: what it does after a change of the inputs must not
    # count as a force.
    unknown_lag_s: float = 0.03
    # Relative remainder of the difference equation for the covariance, far below the other errors.
    remainder: float = 1e-4

    def acceleration_variances(self, deviation: float, period_s: float, N: int) -> Array:
        """Return the variances that accelerations add per period, by coordinate, (12 + 10 N,).

        They act on velocities and rates of the payload and of each UAV.
        """
        is_rate = [0.0, 1.0, 0.0, 1.0]
        payload = np.repeat(is_rate, 3)
        uav = np.repeat(is_rate, UAV_BLOCKS)
        rates = np.concatenate([payload, np.tile(uav, N)])
        return deviation**2 * (period_s**2 * rates)


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomWalk:
    """Random walk of an unknown, in units of its scale: its variance grows at a constant rate."""

    first: float  # standard deviation at the start
    # Standard deviation of the change over a second, 1/sqrt(s): over t seconds sqrt(t) times that.
    change_per_root_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceNoise:
    """Unknown forces on the team as random walks, at the level 1 (level.py), which scales their variances.

    Scales: forces, on payload and UAVs, by the weight of the payload and of the lightest UAV; the
    payload's mass error by its mass; drag, per speed, by the mass of the body, 1/s.
    """

    payload_force: RandomWalk = RandomWalk(first=0.03, change_per_root_s=0.045)
    payload_mass: RandomWalk = RandomWalk(first=0.2, change_per_root_s=0.015)
    uav_force: RandomWalk = RandomWalk(first=0.03, change_per_root_s=0.036)
    payload_drag: RandomWalk = RandomWalk(first=0.3, change_per_root_s=0.015)
    uav_drag: RandomWalk = RandomWalk(first=0.3, change_per_root_s=0.015)
    same_air: float = 0.8  # correlation of the forces on payload and UAVs along one axis

    def first(self, system: System) -> Array:
        """Return the standard deviations at the start, (7,), SI, in the order of `forces`."""
        first = np.array([walk.first for walk in self._walks])
        return np.asarray(self._scales(system) * first)

    def change(self, system: System, period_s: float) -> Array:
        """Return the covariance of the change in a sampling period, (7, 7), SI."""
        change_per_root_s = np.array([walk.change_per_root_s for walk in self._walks])
        deviations = np.sqrt(period_s) * self._scales(system) * change_per_root_s

        correlations = np.eye(len(deviations))
        unknowns = np.arange(len(deviations))
        along_axes = zip(unknowns[PAYLOAD_FORCE], unknowns[UAV_FORCE], strict=True)
        for payload, uavs in along_axes:
            correlations[payload, uavs] = self.same_air
            correlations[uavs, payload] = self.same_air
        covariance: Array = correlations * np.outer(deviations, deviations)
        return covariance

    @property
    def _walks(self) -> list[RandomWalk]:
        """The random walks in the order of `forces`."""
        return [
            *[self.payload_force] * 2,
            self.payload_mass,
            *[self.uav_force] * 2,
            self.payload_drag,
            self.uav_drag,
        ]

    @staticmethod
    def _scales(system: System) -> Array:
        """Return the scales of the unknowns, (7,), SI, in the order of `forces`."""
        payload_kg = system.payload.mass
        uav_kg = min(uav.mass for uav in system.uavs)
        payload_N = system.gravity * payload_kg
        uav_N = system.gravity * uav_kg
        return np.array([payload_N, payload_N, payload_kg, uav_N, uav_N, payload_kg, uav_kg])
