"""Rows of the QP: input bounds and rates, separation of the UAVs, the user's own constraints and terms of the cost.

All are linear in the decision after one linearisation about (x0, u0), as in paper (20)-(21), (26)-(27).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np
import numpy.typing as npt

from model import state
from model.arrays import Array
from model.compiled import Compiled
from model.dynamics import Symbols
from model.linearisation import Model
from mpc.expressions import Relation, read, read_term
from mpc.settings import Constraint, CostTerm, SettingsError


@dataclass(frozen=True, slots=True, kw_only=True)
class Affine:
    """Values and slopes of several scalar constraints at the linearisation point.

    Attributes:
        value: (c,).
        slope: With respect to the state or the input, (c, n) or (c, m).
    """

    value: Array
    slope: Array


class UserConstraints:
    """The user's constraints of one kind (states or inputs), compiled with exact derivatives.

    Args:
        relations: As read, each with its settings; the order is kept, inequalities and equalities mixed.
        symbols: The symbols they were read with.
        parameters: Physical parameters of the system.

    Attributes:
        equality: Which are equalities, (c,).
        depends: Which elements of the state or input each constraint has, (c, n) or (c, m).
        penalty: Price of a violation where the constraint is softened, nan where it is hard, (c,).
    """

    def __init__(self, relations: list[tuple[Relation, Constraint]], symbols: Symbols, parameters: Array) -> None:
        self.equality = np.array([relation.kind == "equality" for relation, _ in relations], dtype=bool)
        softened = [c.soft and r.on == "state" and r.kind == "inequality" for r, c in relations]
        self.penalty = np.array(
            [c.penalty if soft else np.nan for soft, (_, c) in zip(softened, relations, strict=True)]
        )
        self._parameters = parameters
        if not relations:
            self._function = None
            self.depends = np.zeros((0, 0), dtype=bool)
            return
        variable = symbols.x if relations[0][0].on == "state" else symbols.u
        value = ca.vertcat(*[relation.value for relation, _ in relations])
        slope = ca.jacobian(value, variable)
        self.depends = np.array(ca.DM(slope.sparsity(), 1).full(), dtype=bool)
        self._function = Compiled(
            ca.Function("constraints", [variable, symbols.p], [ca.densify(value), ca.densify(slope)])
        )

    def __len__(self) -> int:
        return len(self.equality)

    def at(self, point: Array) -> Affine:
        """Linearise about a state or an input. Source: docs/equations.md (30)."""
        if self._function is None:
            return Affine(value=np.zeros(0), slope=np.zeros((0, len(point))))
        value, slope = self._function(point, self._parameters)
        return Affine(value=value, slope=slope.reshape(len(self), -1))


class UserCosts:
    """The user's terms of the cost, compiled with exact derivatives.

    Args:
        terms: As written.
        model: The system.
    Raises: SettingsError: one cannot be read; the text says which and why.

    Attributes:
        weights: Price per square of each, (t,).
    """

    def __init__(self, terms: Sequence[CostTerm], model: Model) -> None:
        symbols = Symbols.of(model.system.N)
        self._terms = tuple(terms)
        self.weights = np.array([term.weight for term in terms])
        self._parameters = model.system.vector()
        self._function: Compiled | None = None
        if terms:
            value = ca.vertcat(*[read_term(term.expression, symbols) for term in terms])
            slope = ca.densify(ca.jacobian(value, symbols.x))
            self._function = Compiled(ca.Function("costs", [symbols.x, symbols.p], [ca.densify(value), slope]))

    def __len__(self) -> int:
        return len(self.weights)

    def at(self, x: Array) -> Affine:
        """Linearise about a state. Source: docs/equations.md (48)."""
        if self._function is None:
            return Affine(value=np.zeros(0), slope=np.zeros((0, len(x))))
        value, slope = self._function(x, self._parameters)
        return Affine(value=value, slope=slope.reshape(len(self), -1))

    def about(self, x: Array) -> Array:
        """What they make of small deviations from a state: square roots of the weights times slopes, (t, n).

        Raises: SettingsError: one has no finite value and slope there.
        """
        at = self.at(x)
        for term, value, slope in zip(self._terms, at.value, at.slope, strict=True):
            if not np.isfinite([value, *slope]).all():
                raise SettingsError(
                    f"cost {term.expression!r}: expected a finite value and slope at hover, got {value}"
                )
        roots: Array = np.sqrt(self.weights)[:, None] * at.slope
        return roots


def compile_constraints(constraints: tuple[Constraint, ...], model: Model) -> tuple[UserConstraints, UserConstraints]:
    """Read and compile the user's constraints on states and on inputs.

    Raises: SettingsError: one cannot be read; the text says which and why.
    """
    symbols = Symbols.of(model.system.N)
    relations = [(read(constraint.expression, symbols), constraint) for constraint in constraints]
    p = model.system.vector()
    on_state = UserConstraints([pair for pair in relations if pair[0].on == "state"], symbols, p)
    on_input = UserConstraints([pair for pair in relations if pair[0].on == "input"], symbols, p)
    return on_state, on_input


def tilt_states(owned: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Where roll and pitch of some UAVs, 0-based, are in the state, (2 owned,)."""
    starts = [state.uav_slice(uav).start + state.THETA.start for uav in owned]
    return np.array([start + angle for start in starts for angle in (0, 1)], dtype=np.intp)


def pairs_of(N: int, owned: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Pairs of UAVs, 0-based, of which somebody owns at least one; the rest is left to others, (pairs, 2)."""
    pairs = [pair for pair in combinations(range(N), 2) if pair[0] in owned or pair[1] in owned]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def separation_rows(positions: Array, pairs: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Pairwise distances of the UAVs as linear functions of their positions.

    |r_i - r_j| is replaced by d' (r_i - r_j), d the present direction: a lower bound, so that keeping it
    above the limit keeps the true distance above it too.

    Args:
        positions: Of the UAVs at the linearisation point, (3 N,), m.
        pairs: Which, (pairs, 2).
    Returns: Distances now, (pairs,), m; rows with distance = row . positions, (pairs, 3 N).
    Source: docs/equations.md (29).
    """
    r = positions.reshape(-1, 3)
    apart = r[pairs[:, 0]] - r[pairs[:, 1]]
    distances = np.sqrt((apart * apart).sum(axis=1))
    # Two UAVs in one point have no direction; any will do to push them apart.
    together = distances == 0.0
    d = apart / np.where(together, 1.0, distances)[:, None]
    d[together] = [1.0, 0.0, 0.0]
    rows = np.zeros((len(pairs), len(positions)))
    for row, (i, j), direction in zip(rows, pairs.tolist(), d, strict=True):
        row[3 * i : 3 * i + 3] = direction
        row[3 * j : 3 * j + 3] = -direction
    return distances, rows


def rate_rows(steps: int, m: int) -> Array:
    """Differences of successive decisions, ((steps - 1) m, steps m)."""
    rows = np.zeros(((steps - 1) * m, steps * m))
    index = np.arange((steps - 1) * m)
    rows[index, index] = -1.0
    rows[index, index + m] = 1.0
    return rows
