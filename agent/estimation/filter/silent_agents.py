"""Other agents about which information is old, in the covariance of a filter: docs/equations.md (63c), (63e)."""

import math
from typing import Protocol

import numpy as np

from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.model import state
from transport.model.arrays import Array, padded
from transport.mpc.alone.fail_safe import FailSafe
from transport.protocol.scenario.setup.team_run import TeamRun


class Answers(Protocol):
    """How the inputs of a period answer to the state."""

    @property
    def unannounced(self) -> Unannounced:
        """Which of them follow the control law or the fail-safe."""

    @property
    def K(self) -> Array | None:
        """Gain of the control law, (m, n)."""


# Deviation of the force that the integral of a UAV alone holds from the one assumed, sideways, as a
# share of what the UAV carries: that of gusts of 1 m/s.
_INTEGRAL_SHARE = 0.015


class SilentTeam:
    """UAVs that act alone: they answer to their own motion, about hover, with their own noise."""

    def __init__(self, setup: TeamRun) -> None:
        system = setup.system
        gains = setup.settings.alone_gains
        alone = FailSafe(system, setup.hover.u, setup.hover.x[None], gains=gains)
        columns = system.n + (system.m if setup.settings.motor_lag_s > 0.0 else 0)
        self._gain = padded(np.vstack([alone.gain(uav) for uav in range(system.N)]), columns)
        slopes = np.vstack([alone.law(uav).by_sensors() for uav in range(system.N)])
        noise = np.repeat(setup.sensors.noise, state.SENSED // len(setup.sensors.noise))
        # Of their inputs, by the noise of their sensors, (m,).
        self._variance = slopes**2 @ noise**2
        self._integrals = self._integral_deviations(setup, alone)
        self.has_integrals = bool(
            self._integrals.any()
        )  # whether their forces are assumed to deviate

    @staticmethod
    def _integral_deviations(setup: TeamRun, alone: FailSafe) -> Array:
        """Return how much the forces of integrals deviate, sideways, by UAV, (N,), N.

        They do so for the time constant T of the integral; as white noise in each period that is
        2 T / T_s times the variance. Where forces are not estimated, no wind is assumed.
        """
        N, period_s = setup.system.N, setup.settings.sampling_period_s
        if not setup.settings.disturbance.estimate:
            return np.zeros(N)
        hover_N = setup.hover.u.reshape(N, state.INPUTS)[:, 0]
        as_white_noise = [math.sqrt(2.0 * alone.law(uav).follows_s / period_s) for uav in range(N)]
        return np.asarray(_INTEGRAL_SHARE * hover_N * as_white_noise)

    def integral_deviations(self, silent: Silent, unannounced: Unannounced) -> Array:
        """Return the deviation of the forces on all bodies by integrals of UAVs alone, (3 + 3 N, 2).

        Columns: x, y, inertial frame. One wind moves all UAVs: their integrals err alike.
        """
        N = len(self._integrals)
        share = (silent.alone * unannounced.by_law).reshape(N, state.INPUTS)[:, 0]
        forces = np.zeros((1 + N, 3, 2))  # on the payload and on each UAV
        forces[1:, :2] = (share * self._integrals)[:, None, None] * np.eye(2)
        return forces.reshape(-1, 2)

    def gain(self, silent: Silent, period: Answers) -> Array:
        """Return the derivative of the unannounced inputs by the own error, (m, n).

        With a share a alone: a K_alone + (1 - a) (1 - c) K; a fail-safe answers wholly.
        """
        unannounced = period.unannounced
        by_law = unannounced.by_law
        answered = np.where(by_law, (1.0 - silent.alone) * (1.0 - silent.correlation), 0.0)
        answered = np.where(unannounced.by_fail_safe, 1.0, answered)
        K = np.zeros_like(self._gain) if period.K is None else period.K
        alone = silent.alone * by_law
        return np.asarray(alone[:, None] * self._gain + answered[:, None] * K)

    def noise(self, silent: Silent, period: Answers, B: Array, T: Array, P: Array) -> Array:
        """Return the covariance of what the unannounced inputs add in a period, (s, s).

        (1 - a)^2 (1 - c^2) B K T P T' K' B' of their estimates, a^2 B V B' of their sensors.

        Args:
            silent: Share a and correlation c by input.
            period: Which inputs are unannounced, and the gain of the law.
            B: Effect of the inputs in coordinates, (s, m).
            T: Basis of the coordinates, (n, s).
            P: Covariance of the coordinates, (s, s).
        """
        by_law = period.unannounced.by_law
        alone = silent.alone[by_law]
        of_inputs = np.diag(alone**2 * self._variance[by_law])
        if period.K is not None:
            unshared = (1.0 - alone) * np.sqrt(1.0 - silent.correlation[by_law] ** 2)
            K_T = unshared[:, None] * (period.K[by_law] @ T)
            of_inputs += K_T @ P @ K_T.T
        B_law = B[:, by_law]
        return np.asarray(B_law @ of_inputs @ B_law.T)
