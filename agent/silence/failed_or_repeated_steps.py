"""Since when the inputs of an agent are fresh, as its plans say.

A step that fails sends the shifted previous plan, and an agent whose every step fails sends plans for
ever. So a plan says how long ago its inputs were fresh (`Plan.stale`): actuators and other agents count
from there, and the agent is to them as one that is silent.

A class of the user may die without failing: it returns the same again and again. It cannot be told
from a class that means it, but a feedback that does not move although what it measures has moved is
none. Its inputs count as fresh up to the first of these steps.
"""

import numpy as np

from transport.model.arrays import Array
from transport.mpc.alone.fail_safe import PLAYED_S
from transport.protocol.wire.messages import Measurement

# Change of a measured number, SI, below which a feedback need not answer: rounding errors at rest.
_SAME = 1e-6


class Freshness:
    """Tick of the last solved step of an agent; before the first one, of its first step."""

    def __init__(self) -> None:
        self._solved_tick: int | None = None

    def age(self, tick: int, *, is_solved: bool) -> int:
        """Return how long ago the inputs of a step were fresh, ticks."""
        if is_solved or self._solved_tick is None:
            return 0
        return tick - self._solved_tick

    def conclude(self, tick: int, *, is_solved: bool) -> None:
        """Take in whether the step of a tick was solved."""
        if is_solved or self._solved_tick is None:
            self._solved_tick = tick


class Repetition:
    """How long a class of the user has returned the same inputs, whatever it measured."""

    def __init__(self, period_s: float) -> None:
        self._longest = max(1, round(PLAYED_S / period_s))  # ticks that are not suspicious
        self._inputs: Array | None = None
        self._measured: Array | None = None  # at the first of the steps with these inputs
        self._since = 0  # tick of that step

    def age(self, tick: int, inputs: Array, measurement: Measurement) -> int:
        """Return since when the inputs of a step are the same, ticks; 0 unless that is suspicious.

        Args:
            tick: Tick k, once for each.
            inputs: As returned, before limits, (rows, 4 owned): a class whose UAVs are at their limits
                moves them all the same.
            measurement: The newest one.
        """
        measured = np.concatenate([measurement.payload, measurement.uav_states.ravel()])
        if self._inputs is None or not np.array_equal(inputs, self._inputs):
            self._inputs = inputs.copy()
            self._measured = measured
            self._since = tick
            return 0
        age = tick - self._since
        has_moved = np.abs(measured - self._measured).max() > _SAME
        return age if has_moved and age > self._longest else 0
