"""The constraints of one program, one below the other, with the slacks behind the decision."""

from collections.abc import Collection, Sequence
from itertools import pairwise

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.mpc.program.constraints.block import Block, Constraint
from transport.mpc.program.constraints.rod_tension import Tension
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Trajectory


class Rows(msgspec.Struct, frozen=True, kw_only=True):
    """Rows lower <= A [z, s] <= upper of a program."""

    A: Array  # (rows, size + slacks)
    lower: Array  # (rows,)
    upper: Array  # (rows,)


class Stack:
    """Places of the rows and slacks of several constraints.

    Attributes:
        constraints: The constraints, in the order of their rows.
        penalties: Weights of all slacks.
        rows: Rows of each constraint.
    """

    def __init__(self, decision: Decision, constraints: Sequence[Constraint]) -> None:
        self.constraints = tuple(constraints)
        self.penalties = np.concatenate([each.penalties for each in constraints])
        self._size = decision.size
        self.rows = _slices([len(each.slack) for each in constraints])
        self._slacks = _slices([len(each.penalties) for each in constraints])

    def fail(self, system: System, off: Collection[int]) -> None:
        """Take the team with bobs in place of released UAVs; UAVs, 0-based, are off.

        Of the constraints those on tensions depend on the masses of the UAVs.
        """
        for constraint in self.constraints:
            if isinstance(constraint, Tension):
                constraint.fail(system, off)

    def empty(self) -> Rows:
        """Return the rows with the entries of the slacks alone, without bounds."""
        count = self.rows[-1].stop
        A = np.zeros((count, self._size + len(self.penalties)))
        slacks = A[:, self._size :]
        for constraint, rows, columns in zip(
            self.constraints, self.rows, self._slacks, strict=True
        ):
            slacks[rows, columns] = constraint.slack
        return Rows(A=A, lower=np.full(count, -np.inf), upper=np.full(count, np.inf))

    def write(self, to: Rows, constraint: Constraint, block: Block) -> None:
        """Write the rows of one constraint."""
        rows = self.rows[self.constraints.index(constraint)]
        to.A[rows, : self._size] = block.A
        to.lower[rows] = block.lower
        to.upper[rows] = block.upper

    def fill(self, to: Rows, trajectory: Trajectory, constraints: Sequence[Constraint]) -> None:
        """Write the rows of some of the constraints about a trajectory."""
        for constraint in constraints:
            if len(constraint.slack):
                self.write(to, constraint, constraint.block(trajectory))

    def about(self, trajectory: Trajectory) -> Rows:
        """Return the rows of all constraints about a trajectory."""
        rows = self.empty()
        self.fill(rows, trajectory, self.constraints)
        return rows


def _slices(lengths: Sequence[int]) -> list[slice]:
    """Return slices of these lengths, each behind the one before."""
    ends = np.cumsum([0, *lengths]).tolist()
    return [slice(begin, end) for begin, end in pairwise(ends)]
