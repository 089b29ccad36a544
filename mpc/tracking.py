"""The shared control law along a flat reference.

A time-varying linear-quadratic regulator, and the program about it.

The team's cost is constant + sum_k c(k)' M(k) c(k), M(k) = R + B(k)' P(k+1) B(k), by the
corrections c. So an agent's optimum follows from the others' corrections; only where its trajectory
violates a constraint is a QP solved about it.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from transport.model import motors, state
from transport.model.arrays import Array, frozen, padded, rows
from transport.model.discretisation import zero_order_hold
from transport.model.flat import Track
from transport.model.linearisation import Model
from transport.model.obstacles import Obstacle
from transport.mpc.cost import Cost
from transport.mpc.expressions import UserCosts
from transport.mpc.fail_safe import FailSafe
from transport.mpc.feedback import FeedbackLaw, Gains, Regulator
from transport.mpc.prediction import Linear
from transport.mpc.qp import QP
from transport.mpc.rows import Clearance, Decision, Rows, separation_rows
from transport.mpc.settings import ControllerSettings

INSTANTS = 16  # gains computed in a sampling period while the team flies: 8 ms of processor time for four UAVs
_STEPS = 2  # integration steps per sampling period of the difference of reference and model
_ROUNDING = 1e-9  # from this share of the range of inputs on, or of m or rad, a constraint counts as violated


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


def rollout(
    model: Model, settings: ControllerSettings, z0: Array, law: FeedbackLaw, forces: Array | None = None,
    decision: Decision | None = None, before: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return states, (N_p + 1, n or n + m), and inputs, (N_p, m), under the control law, within bounds: (35a), (73).

    Inputs of a decision are free, or within rates if the owned ones `before` the first step are
    given, (m_own,).
    """
    lower, upper = bounds = settings.lower(model.system.N), settings.upper(model.system.N)
    period_s, lag_s, at_x0 = (
        settings.sampling_period_s,
        settings.motor_lag_s,
        law.uncorrected + law.c,
    )
    if decision is None and law.K.ndim == 2 and lag_s == 0.0:
        found = model.rollout(z0, at_x0, law.K, bounds, period_s, forces)
        if found is not None:
            return found
    step, Z, U = model.stepper(period_s, forces), [z0], []
    for wanted, gain in zip(at_x0, law.K if law.K.ndim == 3 else [law.K] * len(at_x0), strict=True):
        wanted += gain @ (Z[-1] - z0)
        u = np.minimum(np.maximum(wanted, lower), upper)
        if decision is not None:
            own = wanted[decision.own]
            if before is not None:
                own = before = decision.clip(
                    np.clip(own, before - decision.rate, before + decision.rate)
                )
            u[decision.own] = own
        Z.append(
            motors.integrate(model, Z[-1], u, period_s, 1, lag_s, forces)[0]
            if lag_s
            else step(Z[-1], u)
        )
        U.append(u)
    return np.array(Z), np.array(U)


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Trajectory under the control law with the corrections that are optimal without constraints."""

    law: FeedbackLaw  # with these corrections
    along: Sequence[Gains]  # its expansion
    linear: Linear  # of the step
    Z: Array  # states at steps 0..N_p, (N_p + 1, n)
    U_all: Array  # inputs, the owned ones without limits, (N_p, m)
    within: bool  # whether no constraint is violated


class Along:
    """Program about the trajectory of the law along a reference.

    The decision changes the owned corrections.
    """

    def __init__(self, decision: Decision, obstacles: Sequence[Obstacle] = ()) -> None:
        self._decision, self._rows, self._settings = decision, Rows(decision), decision.settings
        self._clearance = Clearance(decision, obstacles) if obstacles else None
        clear = () if self._clearance is None else self._clearance.penalties
        self._penalties = np.concatenate([self._rows.penalties, clear])

    def course(
        self, model: Model, linear: Linear, law: FeedbackLaw, along: Sequence[Gains]
    ) -> Course:
        """Return the trajectory of a step. Source: docs/equations.md (72), (73)."""
        own, others, c = self._decision.own, self._decision.others, law.c.copy()
        M = np.array([at.M for at in along])
        c[:, own] = 0.0
        if c.any():
            pushed = np.einsum("kij,kj->ki", M[:, own[:, None], others], c[:, others])
            c[:, own] = -np.linalg.solve(M[:, own[:, None], own], pushed[:, :, None])[:, :, 0]
        law = replace(law, c=c)
        Z, U = rollout(model, self._settings, linear.x0, law, linear.forces, self._decision)
        low, high, rate = self._decision.lower, self._decision.upper, self._decision.rate
        changes = np.diff(np.vstack([linear.u0[own], U[:, own]]), axis=0)
        over = [low - U[:, own], U[:, own] - high, np.abs(changes) - rate]
        within = all((part <= _ROUNDING * (high - low)).all() for part in over) and self._keeps(
            model, Z, U
        )
        return Course(law=law, along=along, linear=linear, Z=Z, U_all=U, within=within)

    def program(self, model: Model, course: Course) -> QP:
        """Return the QP of a course.

        Without rows if it violates no constraint. Source: docs/equations.md (74).
        """
        decision, law, along, rows = self._decision, course.law, course.along, self._rows
        (steps, m), size, own, scale = decision.shape, decision.size, decision.own, decision.scale
        penalties = self._penalties[: 0 if course.within else None]
        slacks = len(penalties)
        H = np.zeros((size + slacks, size + slacks))
        for k in range(steps):
            at = slice(m * k, m * (k + 1))
            H[at, at] = 2.0 * scale[:, None] * along[k].M[np.ix_(own, own)] * scale
        H[range(size, size + slacks), range(size, size + slacks)] = penalties
        g = np.concatenate([np.zeros(size), penalties])
        lower = np.concatenate([np.full(size, -np.inf), np.zeros(slacks)])
        upper = np.full(size + slacks, np.inf)
        if course.within:
            none = upper[:0]
            return QP(
                H=H,
                g=g,
                lower=lower,
                upper=upper,
                A=np.zeros((0, size)),
                row_lower=none,
                row_upper=none,
            )
        # Effect of the decision on the states at a step, and on the inputs of all steps.
        effect, inputs, states = np.zeros((len(course.Z[0]), size)), np.zeros((steps, m, size)), []
        slack_N, loosened = np.zeros((steps, len(rows.on_tensions))), []
        for k in range(steps):
            all_inputs = law.K[k] @ effect
            all_inputs[own, m * k : m * (k + 1)] += np.diag(scale)
            inputs[k] = all_inputs[own]
            if len(rows.on_tensions):
                slack_N[k], slope = rows.on_tensions.at(
                    np.concatenate([course.Z[k], course.U_all[k]])
                )
                loosened.append(slope @ np.vstack([effect, all_inputs]))
            effect = along[k].A_closed @ effect
            effect[:, m * k : m * (k + 1)] += along[k].B[:, own] * scale
            states.append(effect)
        N, Z, last, u0 = model.system.N, course.Z[1:], size + len(rows.penalties), course.linear.u0
        places, C = (
            model.outputs_along(Z)[:, : 3 * N],
            [model.linearise(x, u0).C[: 3 * N] for x in Z],
        )
        far, directions = zip(*(separation_rows(at, rows.pairs) for at in places), strict=True)
        apart = np.array(
            [d @ C_k @ effect for d, C_k, effect in zip(directions, C, states, strict=True)]
        )
        nominal, angles = course.U_all[:, own], Z[:, rows.angles].reshape(-1)
        (low, high), each = decision.bounds(nominal, u0), np.tile(scale, steps)
        changed, rate = np.diff(nominal, axis=0).reshape(-1), np.tile(decision.rate, steps - 1)
        tilted, tilt = np.array(states)[:, rows.angles], last - 1 - int(len(loosened) > 0)
        # Rows, column and sign of their slack, bounds.
        table: list[tuple[Array, int, float, Array | float, Array | float]] = [
            (inputs, 0, 0.0, low * each, high * each),
            (np.diff(inputs, axis=0), 0, 0.0, -rate - changed, rate - changed),
            (apart, size, 1.0, rows.minimum_m - np.concatenate(far), np.inf),
            (tilted, tilt, -1.0, -np.inf, rows.limit - angles),
            (tilted, tilt, 1.0, -rows.limit - angles, np.inf),
            (np.array(loosened), last - 1, -1.0, -np.inf, -slack_N.reshape(-1)),
        ]
        if self._clearance is not None:
            keep, (excess, normals) = (
                self._clearance,
                self._clearance.excess(Z, places.reshape(len(Z), -1, 3)),
            )
            clear = [
                keep.rows(Z[k], normals[:, k], effect, C[k] @ effect)
                for k, effect in enumerate(states)
            ]
            for i, beyond in enumerate(excess):
                table.append(
                    (
                        np.array([found[i] for found in clear]),
                        last + i,
                        1.0,
                        -beyond.reshape(-1),
                        np.inf,
                    )
                )
        count = sum(part.size for part, *_ in table) // size
        A, row_lower, row_upper, begin = (
            np.zeros((count, size + slacks)),
            np.empty(count),
            np.empty(count),
            0,
        )
        for part, slack, sign, least, most in table:
            at = slice(begin, begin + part.size // size)
            A[at, :size], row_lower[at], row_upper[at], begin = (
                part.reshape(-1, size),
                least,
                most,
                at.stop,
            )
            if sign and part.size:
                A[at, slack] = sign
        return QP(H=H, g=g, lower=lower, upper=upper, A=A, row_lower=row_lower, row_upper=row_upper)

    def planned(
        self, model: Model, course: Course, announced: FeedbackLaw, z: Array, w: float
    ) -> tuple[Array, Array]:
        """Return owned inputs and corrections of a plan, (N_p, m_own) each, by a solution and its weight w."""
        own = self._decision.own
        if course.within and (
            w == 1.0 or np.array_equal(course.law.c[:, own], announced.c[:, own])
        ):
            return self._decision.clip(course.U_all[:, own]), course.law.c[:, own]
        c = announced.c.copy()
        c[:, own] = (
            w * (course.law.c[:, own] + self._decision.inputs(z)) + (1.0 - w) * announced.c[:, own]
        )
        law = replace(course.law, c=c)
        u0, forces = course.linear.u0, course.linear.forces
        _, U = rollout(model, self._settings, course.Z[0], law, forces, self._decision, u0[own])
        return U[:, own], c[:, own]

    def _keeps(self, model: Model, Z: Array, U: Array) -> bool:
        """Return whether distances, from obstacles too, angles and tensions along a trajectory keep their limits."""
        rows, taut = self._rows, self._rows.on_tensions
        if not np.isfinite(Z).all() or (np.abs(Z[1:, rows.angles]) > rows.limit + _ROUNDING).any():
            return False
        if not all(
            (taut.at(np.concatenate(point))[0] <= _ROUNDING).all()
            for point in zip(Z, U, strict=False)
        ):
            return False
        if not len(rows.pairs) and self._clearance is None:
            return True
        places = model.outputs_along(Z[1:])[:, : 3 * model.system.N].reshape(len(Z) - 1, -1, 3)
        if (
            self._clearance is not None
            and (self._clearance.excess(Z[1:], places)[0] < -_ROUNDING).any()
        ):
            return False
        apart = np.linalg.norm(places[:, rows.pairs[:, 0]] - places[:, rows.pairs[:, 1]], axis=2)
        return bool((apart >= rows.minimum_m - _ROUNDING).all())
