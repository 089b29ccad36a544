"""Effects that the controller does not model: wind and gusts, drag, noise of measured states.

Random numbers are drawn from counters (Philox) keyed by seed and purpose, with the tick as counter:
those of a tick do not depend on the order of calls.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import with_released
from transport.model.physics.parameters import Payload
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.plant.actual_bodies import about, actual_system
from transport.plant.plant_run import PlantRun
from transport.protocol.scenario.links.random_streams import Streams, draw_key
from transport.protocol.wire.names import PLANT

# Gusts are drawn at these intervals, so that the wind is the same at any sampling period.
GUST_STEP_S = 0.05
_SAME = 1e-9  # tolerance, in intervals
# Drag of payload and of each UAV in moving air where a scenario has no coefficients, kg/s.
_DRAG_IN_WIND = 0.4, 0.2


def drawn(seed: int, purpose: str, tick: int, count: int) -> Array:
    """Return standard normal numbers of the plant for a purpose and a tick, (count,)."""
    return _streams(seed, purpose).at(tick).standard_normal(count)


@lru_cache(maxsize=256)
def _streams(seed: int, purpose: str) -> Streams:
    """Return the random numbers of the plant for a purpose."""
    return Streams(draw_key(seed, PLANT, purpose))


class Environment:
    """Wind, drag, sensors and actual masses of the plant.

    Attributes:
        system: The actual bodies.
        model: Their equations of motion.
    """

    def __init__(self, setup: PlantRun) -> None:
        section = setup.section
        N = setup.run.system.N
        self.system = actual_system(setup)
        is_known = np.array_equal(self.system.drag, setup.run.system.drag)
        is_nominal = (
            section.payload_mass_factor == section.uav_mass_factor == 1.0
            and section.payload_inertia_factor in (None, 1.0)
            and not any(section.payload_centre_m)
            and not section.uav
        )
        self.model = setup.run.model if is_nominal and is_known else Model(self.system)
        self._rho = np.array([uav.rho for uav in setup.run.system.uavs])
        self._seed = setup.run.rules.seed

        wind = section.wind
        self._mean_I = np.array(wind.speed_mps)
        self._gust_I = np.array(wind.gust_mps)
        self._is_windy = bool(self._mean_I.any() or self._gust_I.any())
        self._gust_decay = math.exp(-GUST_STEP_S / wind.gust_time_constant_s)
        self._gusts_per_tick = setup.run.settings.sampling_period_s / GUST_STEP_S
        self._gusts: list[Array] = []  # in units of their standard deviation, by interval
        self._unknown_drag = self._drag_without_coefficients(setup)

        # Standard deviations of all states, (12 + 12 N,): each number for three axes.
        noise = section.noise
        payload = [noise.position_m, noise.velocity_mps, noise.attitude_rad, noise.rate_rads]
        uav = [noise.rod_direction_rad, noise.rod_rate_rads, noise.attitude_rad, noise.rate_rads]
        self._deviations = np.repeat([*payload, *uav * N], 3)

    def _drag_without_coefficients(self, setup: PlantRun) -> Array:
        """Return the drag of payload and UAVs where `[system]` has none, (1 + N,), kg/s.

        By default moving air has a hold on them and still air has none.
        """
        N = setup.run.system.N
        if self.system.drag.any() or setup.run.system.drag.any():
            return np.zeros(1 + N)
        wind = setup.section.wind
        payload, uav = _DRAG_IN_WIND if self._is_windy else (0.0, 0.0)
        if wind.drag_payload_kgps is not None:
            payload = wind.drag_payload_kgps
        if wind.drag_uav_kgps is not None:
            uav = wind.drag_uav_kgps
        return np.array([payload, *[uav] * N])

    def release(self, uav: int) -> None:
        """Replace a UAV, 0-based, by a bob of negligible mass and drag.

        Source: docs/equations.md (50).
        """
        self.system = with_released(self.system, [uav])
        self.model = Model(self.system)
        self._unknown_drag[1 + uav] = 0.0

    def load(self, payload: Payload) -> None:
        """Replace the payload by another one, whose centre of mass may be at another point."""
        uavs = [
            replace(uav, rho=rho - payload.centre)
            for uav, rho in zip(self.system.uavs, self._rho, strict=True)
        ]
        self.system = replace(self.system, payload=payload, uavs=tuple(uavs))
        self.model = Model(self.system)

    def of_centre(self, x: Array) -> Array:
        """Return a state, (n,), with place and velocity of the actual centre of mass of the payload."""
        return about(x, self.system.payload.centre)

    def wind(self, tick: int) -> Array:
        """Return the velocity of the air, (3,), inertial frame, m/s.

        Source: docs/equations.md (43).
        """
        interval = tick * self._gusts_per_tick
        # Rounding must not put the beginning of an interval into the one before.
        is_beginning = abs(interval - round(interval)) < _SAME
        before = round(interval) if is_beginning else math.floor(interval)
        share = max(0.0, interval - before)

        gust = self._gust(before)
        if share > _SAME:
            gust = (1.0 - share) * gust + share * self._gust(before + 1)
        return self._mean_I + self._gust_I * gust

    def _gust(self, interval: int) -> Array:
        """Return the gust at the beginning of an interval, (3,), in standard deviations.

        First-order Gauss-Markov process: g_0 = n_0, g_j = d g_{j-1} + sqrt(1 - d^2) n_j.
        """
        decay = self._gust_decay
        while len(self._gusts) <= interval:
            gust = drawn(self._seed, "wind", len(self._gusts), 3)
            if self._gusts:
                gust = decay * self._gusts[-1] + math.sqrt(1.0 - decay**2) * gust
            self._gusts.append(gust)
        return self._gusts[interval]

    def forces(self, tick: int, x: Array) -> Array | None:
        """Return the forces of the air over [t_k, t_{k+1}) at a state x(t_k), (n,).

        Drag against the bodies' own velocities is a part of the equations of motion where `[system]`
        has coefficients; moving air then adds D W. Other drag is d (W - v), held over the period.

        Returns: Forces on payload and UAVs, (3 + 3 N,), inertial frame, N; None if there are none.
        Source: docs/equations.md (42).
        """
        if not (self._is_windy or self._unknown_drag.any()):
            return None
        air_I = self.wind(tick)
        if not self.system.has_drag:
            relative = air_I - self.model.velocities(self.of_centre(x))
            return np.asarray((self._unknown_drag[:, None] * relative).reshape(-1))

        # D = d I + (d^z - d) b b'
        view = StateView(x)
        forces = [self.system.payload.drag * air_I]
        for uav, Theta in zip(self.system.uavs, view.Theta, strict=True):
            across, along = uav.drag
            b_I = rotation(Theta)[:, 2]
            forces.append(across * air_I + (along - across) * (b_I @ air_I) * b_I)
        return np.concatenate(forces)

    def measured(self, tick: int, agent: int, x: Array) -> Array:
        """Return a state x(t_k), (n,), as measured by the sensors of an agent, 1-based.

        Errors are normal and independent.

        Returns: (n,), with |e| = 1 and e . Omega = 0; x itself without noise. Source:
            docs/equations.md (44).
        """
        if not self._deviations.any():
            return x
        noise = self._deviations * drawn(self._seed, f"noise/{agent}", tick, len(x))
        measured = x + noise
        true = StateView(x)
        error = StateView(noise)
        rods = StateView(measured)

        # A rod direction errs by a small rotation about each axis; the one along the rod has no
        # effect.
        turned = true.e_P + np.cross(error.e_P, true.e_P)
        rods.e_P[:] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        # Without spin about the rod: Omega_i minus its part along e_i.
        rods.Omega_P[:] -= rods.e_P * (rods.e_P * rods.Omega_P).sum(axis=1, keepdims=True)
        return measured
