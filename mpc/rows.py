"""All constraint rows of the QP, row_lower <= A z <= row_upper: rates, separation, tilt, the user's, rod tensions.

z is the scaled decision, then the slacks. A slack relaxes a lower bound with coefficient 1, an upper bound with -1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
import numpy.typing as npt

from model import state
from model.arrays import Array
from model.dynamics import Symbols, motion
from model.parameters import System
from mpc.decision import Decision
from mpc.expressions import Expressions, read
from mpc.prediction import Linear, Prediction, stacked
from mpc.settings import Constraint


class Rows:
    """Rows of all constraints that are set, in the order of their slacks; constant entries and bounds are here.

    Source: docs/equations.md (28)-(30); paper (26)-(27).

    Attributes:
        A, lower, upper: Constant entries, zero where a step's are written, and bounds, infinite there.
        penalties: Weights of all slacks, (slacks,).
        pairs: UAVs whose distance is limited, (pairs, 2).
        minimum_m: Smallest distance.
        angles: Positions in x of the limited roll and pitch angles.
        limit: Largest angle, rad.
        on_tensions: Smallest allowed less the actual rod tension of the owned UAVs; none if it is not limited.
    """

    def __init__(self, decision: Decision) -> None:
        settings, steps, size = decision.settings, decision.settings.horizon, decision.size
        separation, tilt, self._user = settings.separation, settings.tilt, UserRows(decision)
        self.pairs = pairs_of(decision.system.N, decision.uavs)[: None if separation else 0]
        starts = [state.uav_slice(uav).start + state.THETA.start for uav in decision.uavs if tilt]
        self.angles = np.array([start + axis for start in starts for axis in (0, 1)], dtype=np.intp)
        self.minimum_m = separation.minimum_m if separation else 0.0
        self.limit = math.radians(tilt.limit_deg) if tilt else 0.0
        own_slacks = [separation.penalty] * min(1, len(self.pairs)) if separation else []
        own_slacks += [tilt.penalty] if tilt else []
        self.penalties = np.concatenate([np.array(own_slacks), self._user.penalties])
        self._decision, self.on_tensions = decision, self._user.on_tensions
        half, columns = steps * len(self.angles), size + len(own_slacks)
        ends = np.cumsum(
            [decision.size - len(decision.own), steps * len(self.pairs), half, half, len(self._user.slacks)]
        )
        rate, self._apart, self._up, self._down, self._users = map(slice, [0, *ends[:-1].tolist()], ends.tolist())
        self.A = np.zeros((int(ends[-1]), size + len(self.penalties)))
        self.lower, self.upper = np.full(len(self.A), -np.inf), np.full(len(self.A), np.inf)
        self.A[rate, :size] = rate_rows(*decision.shape) * np.tile(decision.scale, steps)
        self.upper[rate] = np.tile(decision.rate, steps - 1)
        self.lower[rate] = -self.upper[rate]
        self.A[self._apart, size : size + 1] = 1.0
        self.A[self._up, columns - 1], self.A[self._down, columns - 1] = -1.0, 1.0
        self.A[self._users, columns:] = self._user.slacks

    def fill(self, linear: Linear, prediction: Prediction, free: Array, effect: Array) -> tuple[Array, Array, Array]:
        """Return A, lower and upper of one step; the positions of the UAVs are the first of the weighted outputs.

        Given are these without decision, (N_p, outputs), and the effect of the scaled decision on them, (outputs, N_p,
        m_own).
        """
        A, lower, upper = self.A.copy(), self.lower.copy(), self.upper.copy()
        size, N = self._decision.size, self._decision.system.N
        _, direction = separation_rows(linear.model.y[: 3 * N], self.pairs)
        A[self._apart, :size] = stacked(np.tensordot(direction, effect[: 3 * N], 1))
        lower[self._apart] = self.minimum_m - (free[:, : 3 * N] @ direction.T).reshape(-1)
        angles = (linear.x0[self.angles] + prediction.dX_free[1:, self.angles]).reshape(-1)
        A[self._up, :size] = A[self._down, :size] = stacked(prediction.effect[self.angles] * self._decision.scale)
        upper[self._up], lower[self._down] = self.limit - angles, -self.limit - angles
        self.fill_user(linear, prediction, A, lower, upper)
        return A, lower, upper

    def fill_user(self, linear: Linear, prediction: Prediction, A: Array, lower: Array, upper: Array) -> None:
        """Write the rows of the user's constraints."""
        if len(self._user.slacks):
            rows = self._users
            self._user.fill(linear, prediction, A[rows], lower[rows], upper[rows])


def rate_rows(steps: int, m: int) -> Array:
    """Return the differences of successive decisions, ((steps - 1) m, steps m). Source: docs/equations.md (28a)."""
    return np.eye((steps - 1) * m, steps * m, m) - np.eye((steps - 1) * m, steps * m)


def pairs_of(N: int, owned: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Return the pairs of UAVs, 0-based, with at least one owned UAV, (pairs, 2); the others' agents keep the rest."""
    pairs = [pair for pair in combinations(range(N), 2) if pair[0] in owned or pair[1] in owned]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def separation_rows(positions: Array, pairs: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Return pairwise distances of the UAVs as linear functions of their positions.

    |r_i - r_j| is replaced by d' (r_i - r_j), d the present direction: a lower bound, so that keeping it
    above the limit keeps the actual distance above it too.

    The positions are those at the linearisation point, (3 N,), m; the pairs are UAVs, 0-based, (pairs, 2).

    Returns: Distances now, (pairs,), m; rows with distance = row . positions, (pairs, 3 N).
    Source: docs/equations.md (29).
    """
    r = positions.reshape(-1, 3)
    apart = r[pairs[:, 0]] - r[pairs[:, 1]]
    distances = np.sqrt((apart * apart).sum(axis=1))
    # Two UAVs in one point have no direction; any direction separates them.
    together = distances == 0.0
    d = apart / np.where(together, 1.0, distances)[:, None]
    d[together] = [1.0, 0.0, 0.0]
    rows, each = np.zeros((len(pairs), len(r), 3)), np.arange(len(pairs))
    rows[each, pairs[:, 0]], rows[each, pairs[:, 1]] = d, -d
    return distances, rows.reshape(len(pairs), len(positions))


@dataclass(frozen=True, slots=True, kw_only=True)
class UserConstraints:
    """The user's constraints on states or on inputs, in the order given, inequalities and equalities mixed.

    Attributes:
        expressions: At most zero, or zero.
        equality: Which are equalities, (c,).
        penalty: Weight of the slack of a soft constraint, nan for a hard one, (c,).
    """

    expressions: Expressions
    equality: npt.NDArray[np.bool_]
    penalty: Array


def compile_constraints(constraints: Sequence[Constraint], system: System) -> tuple[UserConstraints, UserConstraints]:
    """Read and compile the user's constraints on states and on inputs.

    Raises: SettingsError: one cannot be read; the text says which and why.
    """
    symbols = Symbols.of(system.N, system.commands_rates)
    relations = [(read(constraint.expression, symbols), constraint) for constraint in constraints]
    p, found = system.vector(), []
    for on, variable in (("state", symbols.x), ("input", symbols.u)):
        chosen = [(relation, constraint) for relation, constraint in relations if relation.on == on]
        soft = [c.soft and on == "state" and relation.kind == "inequality" for relation, c in chosen]
        found.append(
            UserConstraints(
                expressions=Expressions([relation.value for relation, _ in chosen], variable, symbols.p, p),
                equality=np.array([relation.kind == "equality" for relation, _ in chosen], dtype=bool),
                penalty=np.array([c.penalty if s else np.nan for s, (_, c) in zip(soft, chosen, strict=True)]),
            )
        )
    return found[0], found[1]


def tension_margins(decision: Decision) -> Expressions:
    """Return tension.minimum_N less the rod tensions of the owned UAVs, of states and inputs, (n + m,); none unlimited.

    Source: docs/equations.md (9), (30b).
    """
    symbols, section = Symbols.of(decision.system.N, decision.system.commands_rates), decision.settings.tension
    margins: list[ca.SX] = []
    if section is not None:
        tensions = ca.substitute(motion(symbols).tensions, symbols.F, ca.SX.zeros(symbols.F.numel()))
        margins = [section.minimum_N - tensions[uav] for uav in decision.uavs]
    return Expressions(margins, ca.vertcat(symbols.x, symbols.u), symbols.p, decision.system.vector())


class UserRows:
    """Constraints on states, each soft one with a slack of its own, then those on inputs; rod tensions with one slack.

    Constraints without owned inputs are left to their owners. Source: docs/equations.md (30), (30b); paper (20)-(21).

    Attributes:
        penalties: Weights of the slacks, (slacks,).
        slacks: Their columns, (rows, slacks).
    """

    def __init__(self, decision: Decision) -> None:
        self._decision, steps = decision, decision.settings.horizon
        self._on_state, self._on_input = compile_constraints(decision.settings.constraint, decision.system)
        self.on_tensions = tension_margins(decision)
        self._kept = self._on_input.expressions.depends[:, decision.own].any(axis=1)
        soft = np.flatnonzero(~np.isnan(self._on_state.penalty))
        self.penalties = self._on_state.penalty[soft]
        each = len(self._on_state.expressions)
        self._state_rows = steps * each
        self._tension_rows = self._state_rows + steps * int(self._kept.sum())
        count, section = len(self.on_tensions), decision.settings.tension
        if section is not None:
            self.penalties = np.append(self.penalties, section.penalty)
        self.slacks = np.zeros((self._tension_rows + steps * count, len(self.penalties)))
        for slack, constraint in enumerate(soft):
            self.slacks[constraint : self._state_rows : each, slack] = -1.0
        self.slacks[self._tension_rows :, -1:] = -1.0

    def fill(self, linear: Linear, prediction: Prediction, A: Array, lower: Array, upper: Array) -> None:
        """Write the expressions' dependence on the decision, and their values where it is zero."""
        end, size, u0, scale = self._state_rows, self._decision.size, linear.u0, self._decision.scale
        last = self._tension_rows
        if end:
            on = self._on_state.expressions.at(linear.x0)
            n = on.slope.shape[1]  # motors, which may be further states, are not in the expressions
            effect = (on.slope @ prediction.effect[:n].reshape(n, -1)).reshape(-1, *self._decision.shape)
            A[:end, :size] = stacked(effect * scale)
            values = on.value + prediction.dX_free[1:, :n] @ on.slope.T
            lower[:end], upper[:end] = _bounds(self._on_state.equality, values)
        if self._kept.any():
            on, own = self._on_input.expressions.at(u0), self._decision.own
            slope = on.slope[self._kept]
            A[end:last, :size] = np.kron(np.eye(self._decision.settings.horizon), slope[:, own] * scale)
            values = on.value[self._kept] + (prediction.U_all - u0) @ slope.T
            lower[end:last], upper[end:last] = _bounds(self._on_input.equality[self._kept], values)
        if len(self.on_tensions):
            n, own = len(linear.x0), self._decision.own
            on = self.on_tensions.at(np.concatenate([linear.x0, u0]))
            by_state, by_input = on.slope[:, :n], on.slope[:, n:].copy()
            at_once = by_input[:, own]
            by_input[:, own] = 0.0  # inputs of the others, which respond to the state
            later = np.tensordot(by_state, prediction.effect, 1)
            if len(prediction.feedback):
                later += np.tensordot(by_input, prediction.feedback, 1)
            effect = np.concatenate([at_once[:, None], later[:, :-1]], axis=1)
            A[last:, :size] = stacked(effect * scale)
            values = on.value + prediction.dX_free[:-1] @ by_state.T + (prediction.U_all - u0) @ on.slope[:, n:].T
            upper[last:] = -values.reshape(-1)


def _bounds(equality: npt.NDArray[np.bool_], values: Array) -> tuple[Array, Array]:
    """Return the bounds on the decision's part of expressions with given values, (N_p, c), (N_p c,) each."""
    return np.where(equality, -values, -np.inf).reshape(-1), -values.reshape(-1)
