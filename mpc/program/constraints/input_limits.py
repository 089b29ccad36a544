"""Limits of the owned inputs and of their rates: docs/equations.md (28), (28a)."""

from typing import ClassVar

import numpy as np

from transport.model.arrays import Array
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Signals, TimeInvariant, TimeVarying, Trajectory


class Rates:
    """Largest change of owned inputs between steps; the first is a bound of `Decision`."""

    in_kernel: ClassVar = True

    def __init__(self, decision: Decision) -> None:
        steps, m = decision.shape
        self._rate = np.tile(decision.rate, steps - 1)
        self.penalties = np.zeros(0)
        self.slack = np.zeros(((steps - 1) * m, 0))

        # Where the decision is the inputs about constant ones, the rows are always the same.
        scale = np.diag(np.tile(decision.scale, steps))
        inputs = Signals(values=np.zeros(decision.shape), by_decision=lambda: scale)
        self.of_inputs = self._about(inputs)

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows -rate <= u(k) - u(k-1) <= rate for k = 1..N_p - 1."""
        if isinstance(trajectory, TimeInvariant):
            return self.of_inputs
        return self._about(trajectory.own_inputs())

    def _about(self, inputs: Signals) -> Block:
        """Return the rows about some owned inputs."""
        m = inputs.values.shape[1]
        changes = np.diff(inputs.values, axis=0).reshape(-1)

        def effect() -> Array:
            # Rows of a step are m behind those of the step before.
            return np.asarray(inputs.effect[m:] - inputs.effect[:-m])

        return Block(
            effect=effect,
            lower=-self._rate - changes,
            upper=self._rate - changes,
            slack=self.slack,
        )


class InputBounds:
    """Bounds of the owned inputs as rows, where the decision is corrections and not inputs."""

    in_kernel: ClassVar = False

    def __init__(self, decision: Decision) -> None:
        self.penalties = np.zeros(0)
        self.slack = np.zeros((decision.size, 0))

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows of `Decision.bounds`, in units of the inputs."""
        if not isinstance(trajectory, TimeVarying):
            raise TypeError("expected a trajectory along a reference: else inputs are the decision")
        decision = trajectory.decision
        inputs = trajectory.own_inputs()
        lower, upper = decision.bounds(inputs.values, trajectory.u0)
        unit = np.tile(decision.scale, decision.shape[0])

        return Block(
            effect=lambda: inputs.effect,
            lower=lower * unit,
            upper=upper * unit,
            slack=self.slack,
        )


def within_limits(trajectory: TimeVarying, share: float) -> bool:
    """Return whether bounds and rates hold, up to a share of the inputs' range."""
    decision = trajectory.decision
    inputs = trajectory.U[:, decision.own]
    changes = np.diff(np.vstack([trajectory.u0[decision.own], inputs]), axis=0)
    excess = np.stack(
        [decision.lower - inputs, inputs - decision.upper, np.abs(changes) - decision.rate]
    )
    return bool((excess <= share * (decision.upper - decision.lower)).all())
