"""Hard constraints of the user that no plan meets: a slack in place of no solution.

The other agents, or the state, can make hard rows infeasible. The program is then solved again, in
which each of these constraints has a slack of its own for its largest violation over the horizon.
Source: docs/equations.md (30e).
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from transport.model.arrays import Array
from transport.mpc.program.constraints.shared_rows import default_penalties
from transport.mpc.program.constraints.stack import Stack
from transport.mpc.program.constraints.user_constraints import OwnInputs, OwnStates
from transport.mpc.program.decision import Decision
from transport.mpc.program.quadratic_program import QP

# Violation that is the tolerance of a solver, in units of the expression.
_NONE = 1e-6
# Characters of an expression in a note, which has room for a thousand.
_SHOWN = 900


def softened_problem(text: str) -> str:
    """Return the note of a step whose plan exceeds a hard constraint, from its expression."""
    return f"no plan meets {text[:_SHOWN]}: softened"


class Softening:
    """The hard constraints of the user in the programs of one stack.

    Attributes:
        texts: Their expressions.
    """

    def __init__(self, decision: Decision, stack: Stack) -> None:
        rows, of_constraint, texts = [], [], list[str]()
        for constraint, place in zip(stack.constraints, stack.rows, strict=True):
            if not isinstance(constraint, OwnInputs | OwnStates):
                continue
            # The rows of a step have the constraints in turn.
            count = len(constraint.texts)
            for turn, text in enumerate(constraint.texts):
                if text is None:
                    continue
                own = np.arange(place.start + turn, place.stop, count)
                rows.append(own)
                of_constraint.append(np.full(len(own), len(texts)))
                texts.append(text)

        self.texts = tuple(texts)
        self._rows = np.concatenate(rows) if rows else np.zeros(0, dtype=np.intp)
        self._constraint = np.concatenate(of_constraint) if rows else np.zeros(0, dtype=np.intp)
        settings = decision.settings
        # That of a soft constraint on places: with a steeper one several agents, each of which
        # corrects an equality on states that none can meet, overshoot until the team is lost.
        self._penalty, _ = default_penalties(settings.weights, decision.system.N, settings.horizon)

    def softened(self, qp: QP) -> QP:
        """Return the program with two slacks for each hard constraint: above and below its bounds.

        minimise ... + p (s + 1/2 s's)   subject to   A z - s_above <= upper,   lower <= A z + s_below

        The rows of an equality are there twice: in one row its slacks would be an offset, the same at
        each step.
        """
        n = len(qp.g)
        m = len(qp.A)
        count = len(self.texts)
        slacks = 2 * count
        is_equality = np.isfinite(qp.row_lower[self._rows])
        repeated = self._rows[is_equality]

        H = np.zeros((n + slacks, n + slacks))
        H[:n, :n] = qp.H
        H[n:, n:] = self._penalty * np.eye(slacks)

        A = np.zeros((m + len(repeated), n + slacks))
        A[:m, :n] = qp.A
        A[m:, :n] = qp.A[repeated]
        A[self._rows, n + self._constraint] = -1.0
        A[m + np.arange(len(repeated)), n + count + self._constraint[is_equality]] = 1.0

        row_lower = np.concatenate([qp.row_lower, qp.row_lower[repeated]])
        row_upper = np.concatenate([qp.row_upper, np.full(len(repeated), np.inf)])
        row_lower[self._rows] = -np.inf
        return replace(
            qp,
            H=H,
            g=np.concatenate([qp.g, np.full(slacks, self._penalty)]),
            lower=np.concatenate([qp.lower, np.zeros(slacks)]),
            upper=np.concatenate([qp.upper, np.full(slacks, np.inf)]),
            A=A,
            row_lower=row_lower,
            row_upper=row_upper,
        )

    def violations(self, z: Array) -> Mapping[str, float]:
        """Return the planned violations by expression, in its unit, from a softened solution."""
        above, below = z[-2 * len(self.texts) :].reshape(2, -1)
        largest = np.maximum(above, below)
        return {
            text: float(violation)
            for text, violation in zip(self.texts, largest, strict=True)
            if violation > _NONE
        }
