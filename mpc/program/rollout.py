"""Trajectories of the nonlinear model under the control law, within limits of inputs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from transport.model.arrays import Array, frozen
from transport.model.kernels.compiled_step import Feedback
from transport.model.kernels.native import Places
from transport.model.linear import motor_lag as motors
from transport.model.linear.linearisation import Model
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.settings_period_horizon_weights import ControllerSettings


class Rollout(NamedTuple):
    """Trajectory of the nonlinear model."""

    Z: Array  # states at steps 0..N_p, (N_p + 1, n), with motor lag (N_p + 1, n + m)
    U: Array  # inputs at steps 0..N_p - 1, (N_p, m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuation:
    """How the inputs of all UAVs act: within bounds, over a sampling period each."""

    lower: Array  # smallest inputs, (m,), N and N m, or rad/s
    upper: Array
    period: motors.Period  # with the lag of known motors

    @staticmethod
    def of(settings: ControllerSettings, uavs: int) -> "Actuation":
        """Return the actuation of that many UAVs."""
        period = motors.Period(
            duration_s=settings.sampling_period_s, steps=1, lag_s=settings.motor_lag_s
        )
        lower = settings.lower(uavs)
        upper = settings.upper(uavs)
        frozen(lower, upper)
        return Actuation(lower=lower, upper=upper, period=period)

    def without_limits(self, inputs: Places) -> "Actuation":
        """Return the same with some of the inputs unbounded."""
        lower = self.lower.copy()
        upper = self.upper.copy()
        lower[inputs] = -np.inf
        upper[inputs] = np.inf
        frozen(lower, upper)
        return replace(self, lower=lower, upper=upper)


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnRates:
    """Limits of the owned inputs along a trajectory: rates from those before it, then bounds."""

    decision: Decision
    before: Array  # inputs before the first step, (m_own,)


def rollout(
    model: Model,
    actuation: Actuation,
    z0: Array,
    law: FeedbackLaw,
    forces: Array | None = None,
    own: OwnRates | None = None,
) -> Rollout:
    """Return the trajectory under u = u_law(x0) + c + K (x - x0), all inputs within their bounds.

    z0 is the state at step 0, (n,), with motor lag [x, actual inputs], (n + m,); forces are the
    estimated external forces, N, and mass. With `own` the owned inputs keep their rates, too.
    Source: docs/equations.md (35a), (73).
    """
    period = actuation.period
    if own is None and period.lag_s == 0.0:
        at_x0 = law.uncorrected + law.c
        feedback = Feedback(at_x=at_x0, K=law.K, lower=actuation.lower, upper=actuation.upper)
        compiled = model.rollout(z0, feedback, period.duration_s, forces)
        if compiled is not None:
            return Rollout(*compiled)

    step = _step(model, period, forces)
    return _by_steps(step, z0, law, actuation, own)


def _step(
    model: Model, period: motors.Period, forces: Array | None
) -> Callable[[Array, Array], Array]:
    """Return the map from state and input to the state one period later."""
    if period.lag_s == 0.0:
        return model.stepper(period.duration_s, forces)

    def after_step(z: Array, u: Array) -> Array:
        return motors.integrate(model, z, u, period, forces)

    return after_step


def _by_steps(
    step: Callable[[Array, Array], Array],
    z0: Array,
    law: FeedbackLaw,
    actuation: Actuation,
    own: OwnRates | None,
) -> Rollout:
    """Return the trajectory step by step: u = u_law(x0) + c + K_k (x - x0) within limits, (73)."""
    at_x0 = law.uncorrected + law.c
    gains = law.K if law.K.ndim == 3 else [law.K] * len(at_x0)
    Z = [z0]
    U: list[Array] = []
    for k, K in enumerate(gains):
        wanted = at_x0[k] + K @ (Z[k] - z0)
        u = np.minimum(np.maximum(wanted, actuation.lower), actuation.upper)
        if own is not None:
            places = own.decision.own
            before = own.before if k == 0 else U[-1][places]
            u[places] = own.decision.limit_rate(wanted[places], before)
        U.append(u)
        Z.append(step(Z[k], u))
    return Rollout(np.array(Z), np.array(U))
