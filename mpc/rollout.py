"""Trajectories of the nonlinear model under the control law, within limits of inputs."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from transport.model import motors
from transport.model.arrays import Array
from transport.model.linearisation import Model
from transport.mpc.decision import Decision
from transport.mpc.feedback import FeedbackLaw
from transport.mpc.settings import ControllerSettings


class Rollout(NamedTuple):
    """Trajectory of the nonlinear model."""

    Z: Array  # states at steps 0..N_p, (N_p + 1, n), with motor lag (N_p + 1, n + m)
    U: Array  # inputs at steps 0..N_p - 1, (N_p, m)


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnInputs:
    """Owned inputs of a trajectory: without limits, or within bounds and rates."""

    decision: Decision
    before: Array | None = None  # inputs before the first step, (m_own,): with limits


def rollout(
    model: Model,
    settings: ControllerSettings,
    z0: Array,
    law: FeedbackLaw,
    forces: Array | None = None,
    own: OwnInputs | None = None,
) -> Rollout:
    """Return the trajectory under u = u_law(x0) + c + K (x - x0), all inputs within their bounds.

    z0 is the state at step 0, (n,), with motor lag [x, actual inputs], (n + m,); forces are the
    estimated external forces, N, and mass. The inputs `own` have other limits.
    Source: docs/equations.md (35a), (73).
    """
    lower = settings.lower(model.system.N)
    upper = settings.upper(model.system.N)
    period_s = settings.sampling_period_s
    lag_s = settings.motor_lag_s
    at_x0 = law.uncorrected + law.c
    if own is None and law.K.ndim == 2 and lag_s == 0.0:
        compiled = model.rollout(z0, at_x0, law.K, (lower, upper), period_s, forces)
        if compiled is not None:
            return Rollout(*compiled)

    step = model.stepper(period_s, forces)
    gains = law.K if law.K.ndim == 3 else [law.K] * len(at_x0)
    before = None if own is None else own.before
    Z = [z0]
    U = []
    for k, K in enumerate(gains):
        wanted = at_x0[k] + K @ (Z[k] - z0)
        u = np.minimum(np.maximum(wanted, lower), upper)
        if own is not None:
            owned = wanted[own.decision.own]
            if before is not None:
                owned = own.decision.limit_rate(owned, before)
                before = owned
            u[own.decision.own] = owned
        U.append(u)

        if lag_s > 0.0:
            Z.append(motors.integrate(model, Z[k], u, period_s, 1, lag_s, forces)[0])
        else:
            Z.append(step(Z[k], u))
    return Rollout(np.array(Z), np.array(U))
