"""The user's own constraints on states and on inputs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from model.arrays import Array
from model.dynamics import Symbols
from model.parameters import System
from mpc import condensing
from mpc.decision import Decision
from mpc.expressions import Expressions, read
from mpc.rows.interface import Block, StepData
from mpc.settings import Constraint


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
    symbols = Symbols.of(system.N)
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


class UserRows:
    """Constraints on states, each soft one with a slack of its own, then those on inputs.

    Constraints without owned inputs are left to their owners. Source: docs/equations.md (30); paper (20)-(21).
    """

    def __init__(self, decision: Decision) -> None:
        self._decision, self._steps = decision, decision.settings.horizon
        self._on_state, self._on_input = compile_constraints(decision.settings.constraints, decision.system)
        self._kept = self._on_input.expressions.depends[:, decision.own].any(axis=1)
        self._soft = np.flatnonzero(~np.isnan(self._on_state.penalty))
        self.penalties = self._on_state.penalty[self._soft]
        self._state_rows = self._steps * len(self._on_state.expressions)

    def template(self) -> Array:
        """Return the slacks' columns."""
        size = self._decision.size
        rows = np.zeros((self._state_rows + self._steps * int(self._kept.sum()), size + len(self.penalties)))
        for slack, constraint in enumerate(self._soft):
            rows[constraint : self._state_rows : len(self._on_state.expressions), size + slack] = -1.0
        return rows

    def fill(self, step: StepData, to: Block) -> None:
        """Write the expressions' dependence on the decision, and their values where it is zero."""
        end, prediction, u0 = self._state_rows, step.prediction, step.linear.u0
        if end:
            on = self._on_state.expressions.at(step.linear.x0)
            n = on.slope.shape[1]  # motors, which may be further states, are not in the expressions
            effect = (on.slope @ prediction.effect[:n].reshape(n, -1)).reshape(-1, *self._decision.shape)
            condensing.fill(effect * self._decision.scale, to.A[:end])
            values = on.value + prediction.dX_free[1:, :n] @ on.slope.T
            to.lower[:end], to.upper[:end] = _bounds(self._on_state.equality, values)
        if self._kept.any():
            on, own = self._on_input.expressions.at(u0), self._decision.own
            slope = on.slope[self._kept]
            to.A[end:, : self._decision.size] = np.kron(np.eye(self._steps), slope[:, own] * self._decision.scale)
            values = on.value[self._kept] + (prediction.U_all - u0) @ slope.T
            to.lower[end:], to.upper[end:] = _bounds(self._on_input.equality[self._kept], values)


def _bounds(equality: npt.NDArray[np.bool_], values: Array) -> tuple[Array, Array]:
    """Return the bounds on the decision's part of expressions with given values, (N_p, c), (N_p c,) each."""
    return np.where(equality, -values, -np.inf).reshape(-1), -values.reshape(-1)
