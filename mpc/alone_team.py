"""UAVs that act alone, as one agent sees them: their laws, and the motion of the team that each follows its part of.

Undisturbed, the team takes a motion under its control law that every agent can compute: a hover reference with corners
becomes one that the payload can follow without swing. With a flat reference it is that reference.
Source: docs/equations.md (31f).
"""

from collections.abc import Collection

import numpy as np

from transport.model import state
from transport.model.arrays import Array, rows
from transport.model.flat import Track
from transport.model.hover import Hover
from transport.model.linearisation import Model
from transport.mpc.alone import AloneLaw, Course, course_of, motion_of
from transport.mpc.fail_safe import FailSafe
from transport.mpc.regulation import Regulation
from transport.mpc.settings import ControllerSettings

# Time before the first tick that is asked for, at which the motion starts from the reference: its start has decayed, s.
_LEAD_S = 10.0
_KEPT = 512  # ticks: more than estimators look back and horizons ahead
_STEPS = 2  # of the integration in a sampling period


class AloneTeam:
    """Control laws and courses of the UAVs of a team, alone, along a reference, (K, n), or a flat track."""

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        regulation: Regulation | None,
    ) -> None:
        self._model, self._hover, self._settings, self._regulation = (
            model,
            hover,
            settings,
            regulation,
        )
        system, thrusts_N = model.system, hover.u[:: state.INPUTS]
        self._laws = [AloneLaw(system, uav, float(thrusts_N[uav])) for uav in range(system.N)]
        self._bounds = settings.lower(system.N), settings.upper(system.N)
        self._X_ref: Array = hover.x[None]
        self._track: Track | None = None
        self._version: object = None
        self._motion: list[tuple[Array, Array]] = []  # states and inputs by tick, from `_first` on
        self._first = 0
        self._courses: dict[tuple[int, int], Course] = {}
        self._off, self._released = frozenset[int](), frozenset[int]()
        self._left: FailSafe | None = (
            None  # after failures of UAVs: those left follow the reference itself
        )

    def follow(self, X_ref: Array, track: Track | None) -> None:
        """Follow a reference, of states at instants 0..K-1, (K, n), or a flat track."""
        self._X_ref, self._track = X_ref, track
        self.fail(self._off, self._released)

    def fail(self, off: Collection[int], released: Collection[int]) -> None:
        """Set the UAVs without motors, 0-based, and those of them that are released: the others carry their load."""
        self._off, self._released, self._left = frozenset(off), frozenset(released), None
        if off:
            whole = FailSafe(self._model.system, self._hover.u, self._X_ref, self._track)
            self._left = whole.of_team(off, released)
        self._forget()

    def law(self, uav: int) -> AloneLaw:
        """Return the control law of a UAV, 0-based."""
        return self._laws[uav] if self._left is None else self._left.law(uav)

    def course(self, uav: int, tick: int) -> Course:
        """Return what a UAV, 0-based, follows at a tick."""
        if self._left is not None:
            return self._left.course(uav, tick)
        if self._regulation is not None and self._regulation.version is not self._version:
            self._forget()
            self._version = self._regulation.version
        key = uav, max(tick, 0)
        if key not in self._courses:
            while len(self._courses) > _KEPT * len(self._laws):
                del self._courses[next(iter(self._courses))]
            self._courses[key] = course_of(self._model.system, uav, *self._at(key[1]))
        return self._courses[key]

    def inputs(self, uav: int, x: Array, tick: int, held_I: Array | None = None) -> Array:
        """Return the inputs of a UAV, 0-based, alone at a state, (n,), before limits, (4,)."""
        return self.law(uav).inputs(
            motion_of(self._model.system, uav, x), self.course(uav, tick), held_I
        )

    def _forget(self) -> None:
        self._motion.clear()
        self._courses.clear()

    def _at(self, tick: int) -> tuple[Array, Array]:
        """Return state, (n,), and inputs, (m,), of the undisturbed team at a tick."""
        if self._track is not None:
            row = rows(tick - self._track.first, 1, len(self._track.U))
            return self._track.X[row][0], self._track.U[row][0]
        if (
            self._regulation is None
            or self._settings.prediction != "closed_loop"
            or self._settings.motor_lag_s > 0.0
        ):
            return self._reference(tick), self._hover.u
        if not self._motion or tick < self._first:
            lead = round(_LEAD_S / self._settings.sampling_period_s)
            self._first = max(0, tick - lead)
            x = self._reference(self._first)
            self._motion = [(x, self._inputs(x, self._first))]
        while self._first + len(self._motion) <= tick:
            self._extend()
        return self._motion[tick - self._first]

    def _extend(self) -> None:
        """Add the motion at the next tick."""
        x, u = self._motion[-1]
        ahead, _ = self._model.integrate(x, u, self._settings.sampling_period_s, _STEPS)
        tick = self._first + len(self._motion)
        if not np.abs(ahead).max() < state.LARGEST:
            ahead = self._reference(tick)
        self._motion.append((ahead, self._inputs(ahead, tick)))
        while len(self._motion) > _KEPT:
            del self._motion[0]
            self._first += 1

    def _inputs(self, x: Array, tick: int) -> Array:
        """Return the inputs of the team at a state, (n,), within limits, (m,)."""
        u = (
            None
            if self._regulation is None
            else self._regulation.inputs(x, self._reference(tick), None, tick)
        )
        return self._hover.u if u is None else np.clip(u, *self._bounds)

    def _reference(self, tick: int) -> Array:
        reference: Array = self._X_ref[min(tick, len(self._X_ref) - 1)]
        return reference
