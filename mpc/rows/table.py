"""All constraint rows of the QP, stacked."""

import numpy as np

from model.arrays import Array
from mpc.decision import Decision
from mpc.rows.interface import Block, ConstraintRows, StepData
from mpc.rows.rate import RateRows
from mpc.rows.separation import SeparationRows
from mpc.rows.tilt import TiltRows
from mpc.rows.user import UserRows

# In the order of their rows and slacks.
CONSTRAINTS = (RateRows, SeparationRows, TiltRows, UserRows)


class Rows:
    """Rows of all constraints that are set; their constant entries are computed once.

    Attributes:
        penalties: Weights of all slacks, (slacks,).
    """

    def __init__(self, decision: Decision) -> None:
        constraints: list[ConstraintRows] = [make(decision) for make in CONSTRAINTS]
        templates = [constraint.template() for constraint in constraints]
        self.penalties = np.concatenate([constraint.penalties for constraint in constraints])
        self._template = np.zeros((sum(map(len, templates)), decision.size + len(self.penalties)))
        self._parts: list[tuple[ConstraintRows, slice]] = []
        row, column = 0, decision.size
        for constraint, template in zip(constraints, templates, strict=True):
            rows, slacks = slice(row, row + len(template)), slice(column, column + len(constraint.penalties))
            self._template[rows, : decision.size] = template[:, : decision.size]
            self._template[rows, slacks] = template[:, decision.size :]
            if len(template):
                self._parts.append((constraint, rows))
            row, column = rows.stop, slacks.stop

    def fill(self, step: StepData) -> tuple[Array, Array, Array]:
        """Return A, row_lower and row_upper of one step. Source: docs/equations.md (28)-(30); paper (26)-(27)."""
        A = self._template.copy()
        lower, upper = np.full(len(A), -np.inf), np.full(len(A), np.inf)
        for constraint, rows in self._parts:
            constraint.fill(step, Block(A=A[rows], lower=lower[rows], upper=upper[rows]))
        return A, lower, upper
