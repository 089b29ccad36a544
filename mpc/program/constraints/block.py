"""The form that all constraints have in a program: rows about a trajectory."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

from transport.model.arrays import Array
from transport.mpc.program.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Block:
    """Rows lower <= A z + slack s <= upper; z = 0 and s = 0 is the trajectory itself.

    Source: docs/equations.md (28).
    """

    effect: Callable[[], Array]  # computes `A`, for which there is not always a need
    lower: Array  # (rows,), infinite where there is no bound
    upper: Array  # (rows,)
    slack: Array  # entries of the slacks of the constraint, (rows, slacks)

    @cached_property
    def A(self) -> Array:
        """Effect of the scaled decision on the rows, (rows, size)."""
        return self.effect()

    def holds(self, tolerance: float) -> bool:
        """Return whether the trajectory keeps the constraint, up to a tolerance in its unit."""
        return bool((self.lower <= tolerance).all() and (self.upper >= -tolerance).all())


class Constraint(Protocol):
    """A kind of constraint on the trajectories of a team, as one agent has it in its program."""

    in_kernel: ClassVar[bool]  # whether the compiled kernel `fill` writes the same rows
    penalties: Array  # weight of the largest violation, of each slack, (slacks,)
    slack: Array  # entries of the slacks in the rows, the same about any trajectory, (rows, slacks)

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows about a trajectory, as many as `slack` has, the first step's first."""
