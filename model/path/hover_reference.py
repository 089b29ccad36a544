"""The reference that moves the hover configuration along the path of a maneuver."""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.digests_and_shared_results import digest
from transport.model.path.maneuver import Maneuver
from transport.model.physics.hover import Hover
from transport.model.physics.parameters import System


class HoverReference:
    """Reference outputs and states: the hover configuration moved along the path of a maneuver."""

    def __init__(self, system: System, hover: Hover, maneuver: Maneuver) -> None:
        self.maneuver = maneuver
        self._system = system
        self._hover = hover

        # r_i - r_0 = rho_i - l_i e_i of the level team, (N, 3), m.
        rods = state.StateView(hover.x).e_P
        self._offsets = np.array(
            [uav.rho - uav.rod_length * e for uav, e in zip(system.uavs, rods, strict=True)]
        )

    @property
    def key(self) -> bytes:
        """Digest of the numbers that the reference follows from."""
        return digest("hover", self._system, self._hover, self.maneuver)

    def with_maneuver(self, maneuver: Maneuver) -> "HoverReference":
        """Return the reference of another maneuver of the team."""
        return HoverReference(self._system, self._hover, maneuver)

    def followed(self, t_s: Array) -> tuple[Array, Array]:
        """Return outputs and states that controllers follow, at times t_s, (k,), s.

        Lower while the payload is on the ground: docs/equations.md (59).
        """
        y = self.outputs(t_s)
        x = self.states(t_s)
        depth, sinking = self.maneuver.press(t_s)

        N = self._system.N
        y[:, 2 : 3 * N : 3] += depth[:, None]
        y[:, -4] += depth
        y[:, -1] += sinking

        x[:, state.R0.start + 2] += depth
        x[:, state.V0.start + 2] += sinking
        return y, x

    def outputs(self, t_s: Array) -> Array:
        """Return y_ref at times t_s, (k,), s.

        Level payload, no yaw rates, (k, 4 N + 9), SI: (14), (20).
        """
        r0, v0 = self.maneuver.path(t_s)
        N = self._system.N
        places = r0[:, None, :] + self._offsets

        y = np.zeros((len(t_s), self._system.p))
        y[:, : 3 * N] = places.reshape(len(t_s), 3 * N)
        y[:, -6:-3] = r0
        y[:, -3:] = v0
        return y

    def states(self, t_s: Array) -> Array:
        """Return x_ref at times t_s, (k,), s.

        Hover at r0(t) with velocity r0'(t), (k, 12 + 12 N), SI.
        """
        x = np.tile(self._hover.x, (len(t_s), 1))
        x[:, : state.V0.stop] += np.hstack(self.maneuver.path(t_s))
        return x
