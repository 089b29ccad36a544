"""Sensors of the autopilots, which measure position, velocity, attitude, rates and specific force of UAVs."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.state import SENSED, SENSORS, is_measured
from transport.plant.plant_run import PlantRun
from transport.plant.wind_and_noise import drawn


class Sensors:
    """Sensors of the autopilots: position, velocity, attitude, body rates, specific force of UAVs.

    A measurement errs by white noise and a constant bias, and shows its quantity as it was some
    periods before.
    """

    def __init__(self, setup: PlantRun) -> None:
        sheet = setup.run.sensors
        self._seed = setup.run.rules.seed
        self._noise = np.repeat(sheet.noise, 3)  # standard deviations, (15,)
        self._ages = np.repeat(sheet.ages, 3)  # periods, (15,)
        bias = np.repeat(sheet.bias, 3)
        names = [f"bias/{uav}" for uav in range(1, setup.run.system.N + 1)]
        self._bias = np.array([bias * drawn(self._seed, name, 0, SENSED) for name in names])
        # Outages: UAV, 0-based, sensor by its place in SENSORS, and the tick of its return, if any.
        self._outages: list[tuple[int, int, int | None]] = []
        # True values at the newest ticks, (N, 15) each, the newest first.
        self._true: deque[Array] = deque(maxlen=max(sheet.ages) + 1)

    def observe(self, model: Model, x: Array, u: Array, forces: Array | None) -> None:
        """Take in the next tick: the state, (n,), and the inputs, (4 N,), and forces until then."""
        sensed, *_ = model.sense(x, u, forces=forces)
        self._true.appendleft(sensed.reshape(-1, SENSED))

    def measured(self, tick: int, uavs: Sequence[int]) -> Array:
        """Return the measurements of UAVs, 0-based, at the newest tick, (UAVs, 15).

        Source: docs/equations.md (61).
        """
        ages = np.minimum(self._ages, len(self._true) - 1)
        true = np.array(self._true)[ages, :, np.arange(SENSED)].T
        draws = [drawn(self._seed, f"sensors/{uav + 1}", tick, SENSED) for uav in uavs]
        noise = np.array([self._noise * draw for draw in draws])
        measured: Array = true[list(uavs)] + self._bias[list(uavs)] + noise
        for row, missing in zip(measured, self.missing(tick, uavs), strict=True):
            row.reshape(-1, 3)[[not is_measured(s, missing) for s in range(len(SENSORS))]] = 0.0
        return measured

    def fail(self, uav: int, sensors: Sequence[str], until: int | None) -> None:
        """Let sensors of a UAV, 0-based, measure nothing until a tick, or None for good."""
        self._outages += [(uav, SENSORS.index(sensor), until) for sensor in sensors]

    def missing(self, tick: int, uavs: Sequence[int]) -> tuple[int, ...]:
        """Return the sensors without a measurement of each UAV, as bits (`model.state.SENSORS`)."""
        bits = dict.fromkeys(uavs, 0)
        for uav, sensor, until in self._outages:
            if uav in bits and (until is None or tick < until):
                bits[uav] |= 1 << sensor
        return tuple(bits.values())
