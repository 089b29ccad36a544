"""Inputs that no plan tells: the shared law by which they are assumed, and which inputs they are."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from transport.agent.silence.silence_thresholds import Silence
from transport.model.arrays import Array
from transport.model.state import input_slice
from transport.protocol.wire.messages import Plan


def _none(*_: object) -> None:
    """Return None: no law, no state."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedLaw:
    """Control law that all agents share, as one agent evaluates it for the others."""

    # Inputs of all UAVs without corrections, (m,), from tick and state, (n,); None without a law.
    inputs: Callable[[int, Array], Array | None] = _none
    # Estimate at the tick at which a plan starts, (n,): the difference of the plan's first step
    # from the law holds for later ones. None where the state is not known, or where that difference
    # is mostly the error of the sender's estimate, which changes from tick to tick.
    start_state: Callable[[int], Array | None] = _none
    # Rules by which the others act alone as their information is overdue or late, and that after failures of
    # UAVs; and the inputs of a UAV alone, (4,), from UAV, tick and state. None: they never do.
    silence: Silence | None = None
    silence_after_failures: Silence | None = None
    inputs_alone: Callable[[int, int, Array], Array] | None = None


class PeriodBegin:
    """The state at the begin of a period, (n,), and the law there, which is computed when it is first asked for.

    Without a state neither laws nor fail-safe are evaluated.
    """

    __slots__ = ("_by_law", "_has_law", "_law", "tick", "x")

    def __init__(self, tick: int, x: Array | None, law: SharedLaw) -> None:
        self.tick = tick
        self.x = x
        self._law = law
        self._has_law = False
        self._by_law: Array | None = None

    @property
    def by_law(self) -> Array | None:
        """Inputs of all UAVs by the shared law without corrections, (m,); None where there is none."""
        if not self._has_law and self.x is not None:
            self._by_law = self._law.inputs(self.tick, self.x)
            self._has_law = True
        return self._by_law


@dataclass(frozen=True, slots=True, kw_only=True)
class Silent:
    """How much other agents are assumed to act alone, by input, (m,) each."""

    alone: Array  # share of the law alone, 0 to 1
    correlation: Array  # of the errors of their estimates with the own ones


@dataclass(frozen=True, slots=True, kw_only=True)
class Unannounced:
    """Inputs of a tick that no plan has told, as masks, (m,), which `tell` changes."""

    by_law: npt.NDArray[np.bool_]  # of agents that follow the shared control law
    by_fail_safe: npt.NDArray[np.bool_]  # of UAVs on their fail-safe

    def tell(self, uav: int) -> None:
        """Declare the inputs of a UAV, 0-based, told."""
        self.by_law[input_slice(uav)] = False
        self.by_fail_safe[input_slice(uav)] = False

    def any(self) -> bool:
        """Return whether an input is unannounced."""
        return bool(self.by_fail_safe.any() or self.by_law.any())


@dataclass(frozen=True, slots=True, kw_only=True)
class Assumed:
    """Inputs assumed in place of the last plan of a departed agent."""

    start_tick: int  # first tick that they are for
    inputs: Array  # (steps, 4 owned), none for an agent that acted alone

    def played(self, tick: int) -> int:
        """Return the number of steps played before a tick."""
        return tick - self.start_tick


class FirstStep(NamedTuple):
    """The first step of a plan, and what it tells of its sender's law."""

    plan: Plan
    u_start: Array  # inputs of all UAVs by the law at its start, (m,)
    beyond_law: Array  # how the first step differs from these, (4 owned,)
