"""Linear analysis of UAVs that all follow the reference alone, about hover, each by its own sensors."""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.hover import hover
from transport.model.parameters import System
from transport.mpc.actual_plant import Mismatch, delayed_step
from transport.mpc.alone import AloneLaw
from transport.mpc.manifold import tangent
from transport.mpc.margins import SampledLoop


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
        """Return the step of motion, integrals and inputs that have not arrived.

        Raises: ParameterError: the bodies have no hover.
        """
        plant_step = delayed_step(self._system, self._T, plant, self.period_s)
        kept = self._ahead + plant_step.late + 1
        sizes = [plant_step.size, 3 * self._system.N, *[self._system.m] * kept]
        motion, integrals, *commands = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
        deviation = motion[: self._T.shape[1]]

        issued = self._by_motion @ deviation + self._by_held @ integrals
        acting = [issued, *commands][self._ahead :]
        moved = plant_step.moved(motion, acting)
        integrated = self._kept * integrals + self.period_s * (self._integrals @ deviation)
        return np.vstack([moved, integrated, issued, *commands[:-1]])
