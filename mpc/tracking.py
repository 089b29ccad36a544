"""The shared control law along a flat reference.

A time-varying linear-quadratic regulator, and the program about it.

The team's cost is constant + sum_k c(k)' M(k) c(k), M(k) = R + B(k)' P(k+1) B(k), by the
corrections c. So an agent's optimum follows from the others' corrections; only where its trajectory
violates a constraint is a QP solved about it.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array, frozen, padded, rows
from transport.model.discretisation import zero_order_hold
from transport.model.flat import Track
from transport.model.linearisation import Model
from transport.mpc.cost import Cost
from transport.mpc.expressions import UserCosts
from transport.mpc.fail_safe import FailSafe
from transport.mpc.feedback import Gains, Regulator

INSTANTS = 16  # gains computed in a sampling period while the team flies: 8 ms of processor time for four UAVs
_STEPS = 2  # integration steps per sampling period of the difference of reference and model


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracker:
    """The regulator along a reference at instants 0..L-1 from `first` on.

    The last one, at rest, holds from then on.
    """

    gains: Sequence[
        Gains
    ]  # laws of several teams share them, as a copy would take as long as their computation
    first: int = 0  # number of the first instant, that of the reference

    def over(self, start: int, steps: int) -> Sequence[Gains]:
        """Return the gains at some instants."""
        at = rows(start - self.first, steps, len(self.gains))
        return self.gains[at] if isinstance(at, slice) else [self.gains[i] for i in at]


class Recursion:
    """Linear-quadratic regulator along a reference in the making, some instants at a time, backwards from its end.

    The user's terms count as deviations from the reference. Until the instant `since` the regulator
    `before` of another team holds, if any. UAVs without an agent, 0-based, have the fail-safe and
    its feedback, (4, n): (70)-(72).
    """

    def __init__(
        self, model: Model, track: Track, regulator: Regulator, cost: Cost, terms: UserCosts, period_s: float,
        uncontrolled: Mapping[int, Array], fail_safe: FailSafe, before: Tracker | None, since: int,
    ) -> None:  # fmt: skip
        self._model, self._track, self._regulator, self._cost, self._terms = (
            model,
            track,
            regulator,
            cost,
            terms,
        )
        since -= track.first  # instants are rows from here on
        self._period_s, self._uncontrolled, self._fail_safe, self._since = (
            period_s,
            uncontrolled,
            fail_safe,
            since,
        )
        self._found: list[Gains] = []  # from the end on
        self._P, self._p = regulator.T @ regulator.P @ regulator.T.T, np.zeros(model.system.n)
        self._before: Sequence[Gains] = []
        self.ready = (
            track.first + since
        )  # instant from which on the result holds; before, it is `meanwhile`
        if before is None:
            moving = np.flatnonzero(
                (track.X[-1] != track.X).any(axis=1) | (track.U[-1] != track.U).any(axis=1)
            )
            self._last = int(moving.max(initial=-1)) + 1
        else:
            self._before, self._last = before.gains, len(before.gains) - 1
            self.ready += -(-max(self._last + 1 - since, 0) // INSTANTS)

    def meanwhile(self, off: Collection[int], horizon: int) -> Tracker:
        """Return the regulator until this one is ready.

        The gains before, but not of and by UAVs off, 0-based.
        """
        gains = list(self._before)
        for k in range(self._since, min(self.ready - self._track.first + horizon, len(gains))):
            K, feedforward = gains[k].K.copy(), gains[k].feedforward.copy()
            K[state.input_indices(sorted(off))] = 0.0
            for uav in off:
                K[:, state.uav_slice(uav)] = 0.0
            for uav, feedback in self._uncontrolled.items():
                at = state.input_slice(uav)
                K[at], feedforward[at] = feedback, self._on_reference(uav, k) - self._track.U[k, at]
            frozen(K, feedforward)
            gains[k] = replace(gains[k], K=K, feedforward=feedforward)
        return Tracker(gains=gains, first=self._track.first)

    def advance(self, instant: int | None = None) -> None:
        """Compute the share of an instant after the first, or what is missing."""
        count = (
            self._last + 1
            if instant is None
            else INSTANTS * (instant - self._track.first - self._since)
        )
        for k in range(self._last - len(self._found), max(self._last - count, self._since - 1), -1):
            self._found.append(self._step(k))

    def result(self) -> Tracker:
        """Return the regulator; compute what is missing of it."""
        self.advance()
        return Tracker(
            gains=[*self._before[: self._since], *reversed(self._found)], first=self._track.first
        )

    def _on_reference(self, uav: int, k: int) -> Array:
        return self._fail_safe.inputs(uav, self._track.X[k], self._track.first + k)

    def _step(self, k: int) -> Gains:
        model, track, regulator, cost, P = (
            self._model,
            self._track,
            self._regulator,
            self._cost,
            self._P,
        )
        n, m, controlled = model.system.n, model.system.m, regulator.controlled
        R = cost.R[controlled]
        x, u = track.X[k], track.U[k].copy()
        fixed = np.zeros((m, n))
        for uav, feedback in self._uncontrolled.items():
            fixed[state.input_slice(uav)], u[state.input_slice(uav)] = (
                feedback,
                self._on_reference(uav, k),
            )
        across = _across(x)
        discrete = zero_order_hold(model.linearise(track.X_middle[k], track.U[k]), self._period_s)
        at = model.linearise(x, track.U[k])
        A, B = (discrete.A + discrete.B @ fixed) @ across, discrete.B[:, controlled]
        ahead = track.X[min(k + 1, len(track.X) - 1)]
        drift = _across(ahead) @ (model.integrate(x, u, self._period_s, _STEPS)[0] - ahead)
        PB = P @ B
        M = np.diag(cost.R)
        M[np.ix_(controlled, controlled)] = inner = np.diag(R) + B.T @ PB
        coupled, pushed = PB.T @ A, self._p + P @ drift
        gains = np.linalg.solve(inner, np.column_stack([coupled, B.T @ pushed]))
        K = fixed
        K[controlled] -= gains[:, :-1]
        feedforward = u - track.U[k]
        feedforward[controlled] = -gains[:, -1]
        A_closed = A - B @ gains[:, :-1]
        if k == self._last:
            K, feedforward = regulator.K, np.zeros(m)
        else:
            weighted = (
                np.vstack([np.sqrt(cost.Q)[:, None] * at.C, padded(self._terms.about(x), n)])
                @ across
            )
            P = weighted.T @ weighted + A.T @ P @ A - coupled.T @ gains[:, :-1]
            self._P, self._p = (P + P.T) / 2.0, A_closed.T @ pushed
        frozen(K, feedforward, M, A_closed)
        return Gains(K=K, feedforward=feedforward, M=M, A_closed=A_closed, B=discrete.B)


def _across(x: Array) -> Array:
    """Return the projection onto deviations with the rods' lengths kept, (n, n)."""
    projection = np.eye(len(x))
    for i, e in enumerate(state.StateView(x).e_P):
        own = projection[state.uav_slice(i), state.uav_slice(i)]
        for part in (state.E, state.ROD_RATE):
            own[part, part] -= np.outer(e, e)
    return projection
