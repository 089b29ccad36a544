"""The interface of all constraint rows."""

from dataclasses import dataclass
from typing import Protocol

from model.arrays import Array
from mpc.prediction import Linear, Prediction


@dataclass(frozen=True, slots=True, kw_only=True)
class StepData:
    """The numbers of one step that rows are made of.

    Attributes:
        linear: Linearisation of the step.
        prediction: Of the team.
        positions: Positions of the UAVs at steps 1..N_p with v = 0, (N_p, at least 3 N), the first of these columns.
        position_effect: Effect of the scaled decision on them, (at least 3 N, N_p, m_own).
        U: Announced inputs of all UAVs over the horizon, (N_p, m).
    """

    linear: Linear
    prediction: Prediction
    positions: Array
    position_effect: Array
    U: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """The rows of one constraint, views into those of the QP; `ConstraintRows.fill` writes into them.

    Attributes:
        A: At first the template, (rows, N_p m_own + all slacks).
        lower, upper: At first infinite, (rows,).
    """

    A: Array
    lower: Array
    upper: Array


class ConstraintRows(Protocol):
    """Rows row_lower <= A z <= row_upper of one constraint; z is the scaled decision, then the slacks.

    Attributes:
        penalties: Weight of each slack of these rows, (own slacks,).
    """

    penalties: Array

    def template(self) -> Array:
        """Return the constant entries, (rows, N_p m_own + own slacks); zero where `fill` writes.

        A slack relaxes a lower bound with coefficient 1, an upper bound with -1. No rows: the constraint is not set.
        """

    def fill(self, step: StepData, to: Block) -> None:
        """Write the entries and bounds of one step."""
