"""Linear analysis of UAVs that all follow the reference alone, about hover, each by its own sensors."""

import numpy as np

from model import state
from model.arrays import Array
from model.hover import hover
from model.parameters import System
from mpc.alone import AloneLaw
from mpc.feedback import tangent
from mpc.margins import Mismatch, SampledLoop, held_plant


class AloneLoop(SampledLoop):
    """The sampled loop of UAVs alone, with their integrals. Source: docs/equations.md (31a)-(31e), (60).

    With `next_tick` inputs act a sampling period after the measurement, from which deviations go on at their rates.
    Sensors are exact and of the present.
    """

    def __init__(self, system: System, period_s: float, *, next_tick: bool) -> None:
        self.period_s, self._system, self._ahead = period_s, system, int(next_tick)
        at_rest = hover(system)
        self._T = tangent(at_rest.x)
        thrusts_N = at_rest.u[:: state.INPUTS]
        laws = [AloneLaw(system, uav, float(thrusts_N[uav])) for uav in range(system.N)]
        ahead_s = period_s * self._ahead
        self._kept = 1.0 - period_s / laws[0].forgets_s

        # Inputs by the motion and by the forces of the integrals, and the change of these forces by the motion.
        self._by_motion = np.vstack([law.gain(ahead_s) for law in laws]) @ self._T
        self._by_held = np.zeros((system.m, 3 * system.N))
        self._integrals = np.zeros((3 * system.N, self._T.shape[1]))
        for uav, law in enumerate(laws):
            own = slice(3 * uav, 3 * uav + 3)
            integral, by_held = law.held_gains(ahead_s)
            self._by_held[state.input_slice(uav), own] = by_held
            self._integrals[own] = integral @ self._T

    def matrix(self, plant: Mismatch) -> Array:
        """Return the step of motion, integrals and inputs that have not arrived. Raises: ParameterError: no hover."""
        earlier, later, late = held_plant(self._system, self._T, plant, self.period_s)
        kept = self._ahead + late + 1
        sizes = [len(earlier[0]), 3 * self._system.N, *[self._system.m] * kept]
        blocks = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
        motion, held, commands = blocks[0], blocks[1], blocks[2:]
        deviation = motion[: self._T.shape[1]]

        issued = self._by_motion @ deviation + self._by_held @ held
        acting = [issued, *commands][self._ahead :]
        moved = later[0] @ (earlier[0] @ motion + earlier[1] @ acting[late + 1]) + later[1] @ acting[late]
        integrated = self._kept * held + self.period_s * (self._integrals @ deviation)
        return np.vstack([moved, integrated, issued, *commands[:-1]])
