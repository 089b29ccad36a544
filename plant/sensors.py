"""Sensors of the vehicles' autopilots: position, velocity, attitude, body rates and specific force of each UAV.

Payload and rods have none. A measurement errs by white noise and a constant bias, and shows its quantity as it was
some sampling periods before. Random numbers are drawn from counters, as those of the environment.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.linearisation import Model
from model.state import SENSED
from protocol.scenario.links import draw_key, generator
from protocol.scenario.setup import Setup
from protocol.wire.names import PLANT


class Sensors:
    """Sensors of all UAVs."""

    def __init__(self, setup: Setup) -> None:
        self._seed, sheet = setup.scenario.seed, setup.sensors
        self._noise, bias, self._ages = (np.repeat(of, 3) for of in (sheet.noise, sheet.bias, sheet.ages))
        self._bias = np.array([bias * self._normal(f"bias/{uav}", 0) for uav in range(1, setup.system.N + 1)])
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
        noise = np.array([self._noise * self._normal(f"sensors/{uav + 1}", tick) for uav in uavs])
        found: Array = true[list(uavs)] + self._bias[list(uavs)] + noise
        return found

    def _normal(self, purpose: str, tick: int) -> Array:
        return generator(draw_key(self._seed, PLANT, purpose), tick).standard_normal(SENSED)
