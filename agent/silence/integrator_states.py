"""Integrator states of UAVs alone, forces in N, as one agent assumes them.

Source: docs/equations.md (32f).
"""

from collections.abc import Collection

from transport.model.arrays import Array


class IntegratorForces:
    """Forces that the integrals have followed, by the estimate of one agent.

    The others' share in them is only what this agent expects of them, so agents need not agree.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        # External forces that the integrals balance, -h, (3 + 3 N,), inertial frame, N. None before
        # the first estimate.
        self._balanced: Array | None = None

    def follow(self, forces: Array, *, share_alone: float, follows_s: float) -> None:
        """Follow the external forces estimated at a tick, (3 + 3 N,), inertial frame, N.

        With the team, at a share alone of 0, these forces are the estimated ones. Alone, also in
        part, they follow with the time constant of the integrals, `follows_s`.
        """
        if self._balanced is None or share_alone == 0.0:
            self._balanced = forces
            return
        #   h(k+1) = h(k) + T_s / T_h (-F(k) - h(k))    (32f)
        step = self._period_s / follows_s
        self._balanced = self._balanced + step * (forces - self._balanced)

    def part(self, uav: int, motors_off: Collection[int]) -> Array | None:
        """Return the force of the integral of a UAV, 0-based, (3,), N; None without any estimate.

        UAVs without motors carry nothing, also those that are released.
        """
        balanced = self._balanced
        if balanced is None:
            return None
        #   g_i = h_i + h_0 / n,   n the UAVs that carry the payload    (32f)
        carrying = len(balanced) // 3 - 1 - len(motors_off)
        own = slice(3 + 3 * uav, 6 + 3 * uav)
        integral_I: Array = -(balanced[own] + balanced[:3] / carrying)
        return integral_I
