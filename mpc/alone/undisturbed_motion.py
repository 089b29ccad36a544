"""The motion that a team takes along a hover reference under its control law, undisturbed.

Every process can compute it: a hover reference with corners becomes a motion that the payload can
follow without swing. UAVs alone, and those without an agent, follow their part of it.
Source: docs/equations.md (31f).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.mpc.alone.uav_motion import Setpoint, setpoint_of
from transport.mpc.reference import KEPT

_STEPS = 2  # of the integration in a sampling period
# Times from which on the motion is held: after the end of the reference, s, and after the last instant
# at which it moves, s. A long hover costs nothing.
_SETTLES_S, _RESTS_S = 20.0, 60.0
_KEPT_INSTANTS = 512  # of setpoints: more than estimators look back and horizons ahead


class AtInstant(NamedTuple):
    """State and inputs of the team at an instant."""

    x: Array  # (n,)
    u: Array  # (m,)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlledTeam:
    """A team under its control law."""

    model: Model  # equations of motion
    inputs: Callable[[Array, int], Array]  # at a state, (n,), and an instant, within limits, (m,)
    period_s: float  # time between instants, s


class UndisturbedMotion:
    """States and inputs of a team from an instant on, integrated as far as they are asked for.

    Args:
        team: The team.
        X_ref: Reference states at instants 0..K-1, (K, n); the last one is held.
        before: Motion under an earlier law, in force until instant `first`, where this one begins;
            None: it begins on the reference.
        first: Instant at which it begins.
        key: Digest of the values that the motion follows from.
    """

    def __init__(
        self,
        team: ControlledTeam,
        X_ref: Array,
        *,
        before: "UndisturbedMotion | None" = None,
        first: int = 0,
        key: bytes = b"",
    ) -> None:
        self.key = key
        self._team = team
        self._X_ref = X_ref
        moving = np.flatnonzero((X_ref != X_ref[-1]).any(axis=1))
        at_rest = int(moving.max(initial=-1)) + 1 + round(_RESTS_S / team.period_s)
        at_end = len(X_ref) - 1 + round(_SETTLES_S / team.period_s)
        self._last = max(first, min(at_rest, at_end))
        self._setpoints: dict[tuple[int, int], Setpoint] = {}  # by UAV and instant
        # Instants known, and the number of the first of them.
        self._known: list[AtInstant] = []
        self._first = first
        x = X_ref[min(first, len(X_ref) - 1)]
        if before is not None:
            self._first = max(0, first - KEPT)
            self._known += before.over(self._first, first - self._first)
            x = before.at(first).x
        self._known.append(AtInstant(x, team.inputs(x, first)))

    def warm_up(self) -> None:
        """Integrate to the end: later no instant takes longer."""
        self.at(self._last)

    @property
    def last(self) -> int:
        """Instant from which on the motion is held."""
        return self._last

    def at(self, instant: int) -> AtInstant:
        """Return the motion at an instant; before the first one kept, that one."""
        index = min(max(instant, self._first), self._last) - self._first
        while len(self._known) <= index:
            self._extend()
        return self._known[index]

    def setpoint(self, uav: int, instant: int) -> Setpoint:
        """Return the part of a UAV, 0-based, at an instant, computed once for all that follow it."""
        setpoint = self._setpoints.get((uav, instant))
        if setpoint is None:
            system = self._team.model.system
            if len(self._setpoints) >= _KEPT_INSTANTS * system.N:
                del self._setpoints[next(iter(self._setpoints))]
            setpoint = setpoint_of(system, uav, *self.at(instant))
            self._setpoints[uav, instant] = setpoint
        return setpoint

    def over(self, instant: int, steps: int) -> Sequence[AtInstant]:
        """Return the motion at successive instants."""
        return [self.at(instant + step) for step in range(steps)]

    def _extend(self) -> None:
        """Add the next instant: x(k+1) by the equations of motion under u(k). Source: (31f)."""
        now = self._known[-1]
        instant = self._first + len(self._known)
        team = self._team
        x = team.model.advance(now.x, now.u, team.period_s, _STEPS)
        if not np.abs(x).max() < state.LARGEST:
            x = self._X_ref[min(instant, len(self._X_ref) - 1)]
        self._known.append(AtInstant(x, team.inputs(x, instant)))
