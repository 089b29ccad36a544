"""Time-varying linear-quadratic regulator along a flat reference: docs/equations.md (70)-(72)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array, frozen, padded, rows
from transport.model.digests_and_shared_results import digest
from transport.model.linear.discretisation import zero_order_hold
from transport.model.path.flat_reference import Track
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.law.hover_law import HoverLaw
from transport.mpc.program.feedback_law import FeedbackError, Gains
from transport.mpc.program.user_expressions import ON_REFERENCE

# Gains computed in a sampling period while the team flies: 8 ms of processor time for four UAVs.
GAINS_PER_PERIOD = 16
_STEPS = 2  # integration steps per sampling period of the difference of reference and model


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracker:
    """The regulator along a reference at instants 0..L-1 from `first` on.

    The last one, at rest, holds from then on.
    """

    # Laws of several teams share the gains: a copy would take as long as their computation.
    gains: Sequence[Gains]
    key: bytes  # digest of what the gains follow from
    first: int = 0  # number of the first instant, that of the reference

    def over(self, start: int, steps: int) -> Sequence[Gains]:
        """Return the gains at some instants."""
        chosen = rows(start - self.first, steps, len(self.gains))
        if isinstance(chosen, slice):
            return self.gains[chosen]
        return [self.gains[row] for row in chosen]


class Recursion:
    """Backward Riccati recursion along a reference, `GAINS_PER_PERIOD` instants per sampling period.

    The user's terms count as deviations from the reference. UAVs without an agent have the
    fail-safe. Until the instant `since` the regulator `before` of another team holds, if any.
    """

    def __init__(
        self,
        law: HoverLaw,
        fail_safe: FailSafe,
        track: Track,
        key: bytes,
        before: Tracker | None,
        since: int,
    ) -> None:
        if law.regulator is None:
            raise FeedbackError("expected a shared control law, got none")
        self._law = law
        self._regulator = law.regulator
        self._fail_safe = fail_safe
        self._track = track
        self._period_s = law.crew.settings.sampling_period_s
        self._key = key
        self._since_row = since - track.first  # rows of the reference from here on

        # Cost-to-go x'Px + 2p'x at the instant computed last, from which the next step goes back.
        self._P = law.regulator.T @ law.regulator.P @ law.regulator.T.T
        self._p = np.zeros(law.hovering.model.system.n)
        self._computed: list[Gains] = []  # from the end on

        self._before: Sequence[Gains] = []
        self.ready = since  # instant from which on the result holds; before, it is `meanwhile`
        if before is None:
            self._last = _first_at_rest(track)
        else:
            # At rest, where the last gains are held, the regulator of the new team holds at once.
            held = max(self._since_row + 1 - len(before.gains), 0)
            self._before = [*before.gains, *[before.gains[-1]] * held]
            self._last = len(self._before) - 1
            missing = self._last + 1 - self._since_row
            self.ready += -(-missing // GAINS_PER_PERIOD)

    @property
    def computed(self) -> int:
        """Number of instants whose gains are computed."""
        return len(self._computed)

    def meanwhile(self, off: frozenset[int], horizon: int) -> Tracker:
        """Return the regulator until this one is ready: the gains before, without UAVs off."""
        gains = list(self._before)
        until = min(self.ready - self._track.first + horizon, len(gains))
        for k in range(self._since_row, until):
            before = gains[k]
            K = before.K.copy()
            feedforward = before.feedforward.copy()
            K[state.input_indices(sorted(off))] = 0.0
            for uav in off:
                K[:, state.uav_slice(uav)] = 0.0
            for uav in self._law.hovering.uncontrolled:
                own = state.input_slice(uav)
                K[own] = self._fail_safe_gain(uav, k)
                feedforward[own] = self._on_reference(uav, k) - self._track.U[k, own]
            # A + B K,   on the manifold as in (70)
            A_closed = before.A_closed + before.B @ (K - before.K) @ _projection(self._track.X[k])
            frozen(K, feedforward, A_closed)
            gains[k] = replace(before, K=K, feedforward=feedforward, A_closed=A_closed)
        return Tracker(gains=gains, key=digest(self._key, "meanwhile"), first=self._track.first)

    def advance(self, instant: int | None = None) -> None:
        """Compute the gains that are due until an instant; without one, all that are missing."""
        due = self._last + 1
        if instant is not None:
            due = GAINS_PER_PERIOD * (instant - self._track.first - self._since_row)

        next_row = self._last - len(self._computed)
        down_to = max(self._last - due, self._since_row - 1)
        for k in range(next_row, down_to, -1):
            self._computed.append(self._step(k))

    def result(self) -> Tracker:
        """Return the regulator; compute what is missing of it."""
        self.advance()
        gains = [*self._before[: self._since_row], *reversed(self._computed)]
        return Tracker(gains=gains, key=self._key, first=self._track.first)

    def _fail_safe_gain(self, uav: int, k: int) -> Array:
        """Return the feedback of a UAV's fail-safe on the reference, (4, n)."""
        return self._fail_safe.gain_along(uav, self._track.X[k], self._track.first + k)

    def _on_reference(self, uav: int, k: int) -> Array:
        """Return the inputs of a UAV's fail-safe on the reference, (4,)."""
        return self._fail_safe.inputs(uav, self._track.X[k], self._track.first + k)

    def _step(self, k: int) -> Gains:
        """Go one step back from V(x) = x'Px + 2p'x, and return the gains at row k.

        M = R + B'PB,  K = -M^-1 B'PA,  c_ff = -M^-1 B'(p + P d),
        P <- C'QC + A'P(A + BK),  p <- (A + BK)'(p + P d)      Source: docs/equations.md (71)
        """
        controlled = self._regulator.controlled
        step = self._difference(k)
        A = step.A
        B = step.B[:, controlled]

        PB = self._P @ B
        M_controlled = np.diag(self._law.hovering.cost.R[controlled]) + B.T @ PB
        BPA = PB.T @ A
        p_ahead = self._p + self._P @ step.drift
        solved = np.linalg.solve(M_controlled, np.column_stack([BPA, B.T @ p_ahead]))
        K_controlled = solved[:, :-1]
        A_closed = A - B @ K_controlled

        if k == self._last:
            # At rest the regulator about hover holds, with its P and p = 0.
            K = self._regulator.K
            feedforward = np.zeros(len(K))
        else:
            K = step.K_fixed.copy()
            K[controlled] -= K_controlled
            feedforward = step.u_fixed - self._track.U[k]
            feedforward[controlled] = -solved[:, -1]
            P = step.weighted.T @ step.weighted + A.T @ self._P @ A - BPA.T @ K_controlled
            self._P = (P + P.T) / 2.0
            self._p = A_closed.T @ p_ahead

        M = np.diag(self._law.hovering.cost.R)
        M[np.ix_(controlled, controlled)] = M_controlled
        frozen(K, feedforward, M, A_closed)
        return Gains(K=K, feedforward=feedforward, M=M, A_closed=A_closed, B=step.B)

    def _difference(self, k: int) -> "_Difference":
        """Return the difference equation about row k, with the fail-safes in force, (70)."""
        model = self._law.hovering.model
        x = self._track.X[k]
        u = self._track.U[k]
        K_fixed, u_fixed = self._fixed(k)

        # A_k, B_k are the hold about the middle of the period, Pi keeps the rods' lengths.
        Pi = _projection(x)
        middle = model.linearise(self._track.X_middle[k], u)
        discrete = zero_order_hold(middle, self._period_s)
        A = (discrete.A + discrete.B @ K_fixed) @ Pi

        # The stage cost with the user's terms: |weighted dx|^2.
        crew = self._law.crew
        terms = padded(crew.user_costs.about(x, ON_REFERENCE), len(x))
        outputs = np.sqrt(self._law.hovering.cost.Q)[:, None] * model.linearise(x, u).C
        weighted = np.vstack([outputs, terms]) @ Pi
        return _Difference(
            A=A,
            B=discrete.B,
            drift=self._drift(k, u_fixed),
            weighted=weighted,
            K_fixed=K_fixed,
            u_fixed=u_fixed,
        )

    def _fixed(self, k: int) -> tuple[Array, Array]:
        """Return the feedback of UAVs without agents, (m, n), and the inputs on the reference."""
        hovering = self._law.hovering
        K_fixed = np.zeros((hovering.model.system.m, hovering.model.system.n))
        u_fixed = self._track.U[k].copy()
        for uav in hovering.uncontrolled:
            own = state.input_slice(uav)
            K_fixed[own] = self._fail_safe_gain(uav, k)
            u_fixed[own] = self._on_reference(uav, k)
        return K_fixed, u_fixed

    def _drift(self, k: int, u_fixed: Array) -> Array:
        """Return d_k = Pi_(k+1) (model's step from the reference - reference), (n,): (70)."""
        X = self._track.X
        x_ahead = X[min(k + 1, len(X) - 1)]
        moved = self._law.hovering.model.advance(X[k], u_fixed, self._period_s, _STEPS)
        drift: Array = _projection(x_ahead) @ (moved - x_ahead)
        return drift


@dataclass(frozen=True, slots=True, kw_only=True)
class _Difference:
    """Difference equation of the deviation from the reference over one sampling period."""

    A: Array  # state matrix with the feedback of UAVs without agents, (n, n)
    B: Array  # input matrix, (n, m)
    drift: Array  # difference between the model's step and the reference, (n,)
    weighted: Array  # root of the stage cost, (outputs + terms, n)
    K_fixed: Array  # feedback of UAVs without agents, (m, n)
    u_fixed: Array  # reference inputs, those of UAVs without agents by the fail-safe, (m,)


def _first_at_rest(track: Track) -> int:
    """Return the row from which on a track rests."""
    differs = (track.X[-1] != track.X).any(axis=1) | (track.U[-1] != track.U).any(axis=1)
    return int(np.flatnonzero(differs).max(initial=-1)) + 1


def _projection(x: Array) -> Array:
    """Return the projection that keeps the rods' lengths, (n, n): I - e e' for each rod."""
    projection = np.eye(len(x))
    for i, e in enumerate(state.StateView(x).e_P):
        own = projection[state.uav_slice(i), state.uav_slice(i)]
        for part in (state.E, state.ROD_RATE):
            own[part, part] -= np.outer(e, e)
    return projection
