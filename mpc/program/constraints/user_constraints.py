"""The user's own constraints as text, on states or on inputs: docs/equations.md (30)."""

from typing import ClassVar

import numpy as np

from transport.model.arrays import Array
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.constraints.shared_rows import default_penalties, share
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Announced, Signals, TimeInvariant, Trajectory
from transport.mpc.program.user_expressions import UserConstraints

# Share of the others' announced corrections that an agent leaves to them, where they keep a row
# together. The rest is taken as the same for all: agents whose corrections differ come together.
_HEEDED = 0.5


class OwnStates:
    """Constraints on states, h(x) <= 0 or h(x) = 0, each soft one with a slack of its own.

    Attributes:
        texts: Their expressions in the order of a step's rows, None for a soft one.
    """

    in_kernel: ClassVar = False

    def __init__(self, decision: Decision) -> None:
        settings, system = decision.settings, decision.system
        penalties = default_penalties(settings.weights, system.N, settings.horizon)
        self._constraints = UserConstraints(settings.constraint, system, "state", penalties)
        soft = np.flatnonzero(~np.isnan(self._constraints.penalty))
        self.penalties = self._constraints.penalty[soft]
        self.texts = [
            text if np.isnan(penalty) else None
            for text, penalty in zip(
                self._constraints.texts, self._constraints.penalty, strict=True
            )
        ]

        # h(x) - slack <= 0 in each step's rows.
        of_step = np.zeros((len(self._constraints), len(soft)))
        of_step[soft, np.arange(len(soft))] = -1.0
        self.slack = np.tile(of_step, (decision.shape[0], 1))

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows of all of them at steps 1..N_p."""
        signals = trajectory.of_states(self._constraints.at)
        return _rows(signals, self._constraints.equality, self.slack)


class OwnInputs:
    """Constraints on inputs, g(u) <= 0 or g(u) = 0, always hard.

    Constraints without an owned input are left to their owners.

    Attributes:
        texts: Expressions of the others in the order of a step's rows.
        is_shared: Whether several agents keep one of them.
    """

    in_kernel: ClassVar = False

    def __init__(self, decision: Decision) -> None:
        self._constraints = UserConstraints(decision.settings.constraint, decision.system, "input")
        # Owned inputs in each constraint, of all inputs in it: (constraints, m).
        depends = self._constraints.depends
        self._kept = depends[:, decision.own].any(axis=1)
        self.texts = [self._constraints.texts[row] for row in np.flatnonzero(self._kept)]
        # Every agent corrects its share of what several of them keep.
        self._share = share(depends[self._kept], decision.own)
        self.is_shared = bool((self._share > 1.0).any())
        self.penalties = np.zeros(0)
        self.slack = np.zeros((decision.shape[0] * int(self._kept.sum()), 0))

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows of those with an owned input at steps 0..N_p - 1."""
        signals = trajectory.of_inputs(self._expand)
        if self.is_shared:
            signals = self._shared(signals, trajectory)
        return _rows(signals, self._constraints.equality[self._kept], self.slack)

    def _shared(self, signals: Signals, trajectory: Trajectory) -> Signals:
        """Return signals of which the own decision has a multiple of its effect, (30c)."""
        values = signals.values
        if isinstance(trajectory, TimeInvariant) and trajectory.announced is not None:
            values = self._about_law(trajectory, trajectory.announced)
        by_row = np.tile(self._share, len(signals.values))
        return Signals(values=values, by_decision=lambda: by_row[:, None] * signals.effect)

    def _about_law(self, trajectory: TimeInvariant, announced: Announced) -> Array:
        """Return the values without a decision, which is about the inputs in force, (steps, rows).

        phi(u) - (1 - b) (sum_j D_j c_j - n D_o c_o) + n D_o (u0_o - u_o), u, c as announced,
        n the factor of the share
        """
        own = trajectory.decision.own
        u0 = trajectory.linear.u0
        value, slope = self._expand(u0)

        by_all = announced.c @ slope.T
        by_own = self._share * (announced.c[:, own] @ slope[:, own].T)
        at_law = value + (announced.U - u0) @ slope.T
        to_u0 = self._share * ((u0[own] - announced.U[:, own]) @ slope[:, own].T)
        return np.asarray(at_law - (1.0 - _HEEDED) * (by_all - by_own) + to_u0)

    def _expand(self, u: Array) -> tuple[Array, Array]:
        """Return values and slopes of the kept constraints at inputs of all UAVs, (m,)."""
        value, slope = self._constraints.at(u)
        return value[self._kept], slope[self._kept]


def _rows(signals: Signals, equality: Array, slack: Array) -> Block:
    """Return rows signal <= 0, or signal = 0 where the constraint is an equality."""
    lower = np.where(equality, -signals.values, -np.inf)
    return Block(
        effect=lambda: signals.effect,
        lower=lower.reshape(-1),
        upper=-signals.values.reshape(-1),
        slack=slack,
    )
