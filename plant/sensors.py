"""Sensors of the vehicles' autopilots: position, velocity, attitude, body rates and specific force of each UAV.

Payload and rods have none. A measurement errs by white noise and a constant bias, and shows its quantity as it was
some sampling periods before.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.linearisation import Model
from model.state import SENSED
from plant.environment import drawn
from protocol.scenario.setup import Setup


class Sensors:
    """Sensors of all UAVs."""

    def __init__(self, setup: Setup) -> None:
        self._seed, sheet = setup.scenario.seed, setup.sensors
        self._noise, bias, self._ages = (np.repeat(of, 3) for of in (sheet.noise, sheet.bias, sheet.ages))
        uavs = range(1, setup.system.N + 1)
        self._bias = np.array([bias * drawn(self._seed, f"bias/{uav}", 0, SENSED) for uav in uavs])
        # True values at the newest ticks, (N, 15) each, the newest first.
        self._true: deque[Array] = deque(maxlen=max(sheet.ages) + 1)

    def observe(self, model: Model, x: Array, u: Array, forces: Array | None) -> None:
        """Take in the next tick: the state, (n,), and the inputs, (4 N,), and forces until then."""
        self._true.appendleft(model.sense(x, u, forces=forces)[0].reshape(-1, SENSED))

    def measured(self, tick: int, uavs: Sequence[int]) -> Array:
        """Return the measurements of UAVs, 0-based, at the newest tick, (UAVs, 15). Source: docs/equations.md (61).

        Before the first tick the team is at rest.
        """
        ages = np.minimum(self._ages, len(self._true) - 1)
        true = np.array(self._true)[ages, :, np.arange(SENSED)].T
        noise = np.array([self._noise * drawn(self._seed, f"sensors/{uav + 1}", tick, SENSED) for uav in uavs])
        found: Array = true[list(uavs)] + self._bias[list(uavs)] + noise
        return found
