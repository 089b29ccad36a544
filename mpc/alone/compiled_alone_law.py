"""The law of a UAV alone at a state of the team, by the compiled kernel.

`kernels.c` computes what `uav_motion.motion_of` and `AloneLaw.inputs` do, in a tenth of the time: on a late
network an agent asks for the inputs of others alone at every tick that it estimates again.
"""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.model.physics.parameters import System
from transport.mpc.alone.alone_law import AloneLaw
from transport.mpc.alone.uav_motion import Setpoint


class CompiledAloneLaw:
    """The law of one UAV, 0-based."""

    def __init__(self, system: System, uav: int, law: AloneLaw) -> None:
        # Arrays whose addresses the kernel is given at every call.
        self._x: Array = np.zeros(system.n)
        self._integral_I: Array = np.zeros(3)
        self._law = law.numbers()

        x = native.address(self._x)
        own = x + self._x.itemsize * state.uav_slice(uav).start
        self._before = x, own, native.address(self._law)
        self._integral_address = native.address(self._integral_I)

    def inputs(self, x: Array, setpoint: Setpoint, integral_I: Array | None = None) -> Array:
        """Return the inputs at a state of the team, (n,), before limits, (4,)."""
        u = np.empty(state.INPUTS)
        self._x[:] = x
        self._integral_I[:] = 0.0 if integral_I is None else integral_I
        native.KERNELS.alone_inputs(
            *self._before, setpoint.address, self._integral_address, native.address(u)
        )
        return u
