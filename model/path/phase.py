"""One phase of a maneuver, a straight leg, a table or a curve, and the motion along it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from transport.model.arrays import Array, ArrayLike, assign, checked
from transport.model.path.curves import ORDERS, Curve
from transport.model.physics.parameters import ParameterError

Profile = Literal["ramp", "min_jerk", "step", "smooth"]
PhaseKind = Literal["move", "take_off", "land", "circle", "eight", "spline"]

# Share of a take-off before the payload rises, and of a landing after it has sunk: its weight goes
# to or from the team.
HANDOVER = 0.25

# Difference allowed between the ends of a computed table and duration and displacement, s and m.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FormationStep:
    """A smooth change of the team's length and width: (66a)."""

    begin_s: float  # time of the maneuver, s
    span_s: float
    sizes: Array  # length and width after it, as multiples of those at hover, (2,)

    def covered(self, t_s: Array) -> Array:
        """Return the jets of the share of the change at times t_s, (k,), s: (`ORDERS`, k).

        s as in (65) with t_r = T / 2.
        """
        timing = Curve(kind=None, duration_s=self.span_s, ramp_s=self.span_s / 2.0)
        return timing.covered(t_s - self.begin_s, ORDERS)


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Phase:
    """One piece of the payload's path, straight, along a table or a curve.

    Take-off and landing: minimum jerk.
    """

    name: str  # for figures and progress, e.g. "climb"
    duration_s: float
    displacement_I: Array  # from start to end of the phase, (3,), inertial frame (z down), m
    kind: PhaseKind
    # A curve, or a table of times and positions since the start, s and m, (k, 4), at constant speed
    # between rows. None: straight, by the profile of the maneuver.
    way: Curve | Array | None
    # Shares of the duration, and length and width of the team from then on, as multiples of those
    # at hover, (k, 3).
    formation: Array | None

    def __init__(
        self,
        *,
        name: str,
        duration_s: float,
        displacement_I: ArrayLike,
        kind: PhaseKind = "move",
        way: Curve | ArrayLike | None = None,
        formation: ArrayLike | None = None,
    ) -> None:
        field = f"phase {name!r}"
        displacement_I = checked(f"{field} displacement", displacement_I, (3,))
        if way is not None and not isinstance(way, Curve):
            way = _checked_table(f"{field} way", way, [float(duration_s), *displacement_I])
        if formation is not None:
            formation = _checked_formation(f"{field} formation", formation)

        assign(
            self,
            name=name,
            duration_s=float(duration_s),
            displacement_I=displacement_I,
            kind=kind,
            way=way,
            formation=formation,
        )

    def longer(self, factor: float) -> "Phase":
        """Return the phase with `factor` times the duration and the times of speeding up and way points.

        Not of a table, which has its own times.
        """
        way = self.way
        if isinstance(way, Curve):
            times_s = None if way.times_s is None else [factor * time_s for time_s in way.times_s]
            duration_s = factor * way.duration_s
            ramp_s = factor * way.ramp_s
            way = replace(way, duration_s=duration_s, ramp_s=ramp_s, times_s=times_s)
        return replace(self, duration_s=factor * self.duration_s, way=way)

    @property
    def has_way(self) -> bool:
        """Return whether the payload moves."""
        return bool(self.displacement_I.any()) or self.way is not None

    def curve(self, profile: Profile) -> Curve | None:
        """Return the curve of a smooth phase; None of one whose acceleration jumps."""
        if isinstance(self.way, Curve):
            return self.way

        is_straight = self.kind == "move" and self.way is None
        if profile == "smooth" and is_straight:
            return Curve(
                kind=None,
                duration_s=self.duration_s,
                ramp_s=self.duration_s / 2.0,
                size_I=tuple(self.displacement_I.tolist()),
            )
        return None

    def jets(self, profile: Profile, t_s: Array, orders: int) -> Array:
        """Return the jets of the displacement at times since the start, s, (orders, k, 3), SI.

        A phase that is not smooth has position and velocity: (20).
        """
        curve = self.curve(profile)
        if curve is not None:
            return curve.path(t_s, orders)

        displacement = np.zeros((orders, len(t_s), 3))
        if isinstance(self.way, np.ndarray):
            displacement[0], displacement[1] = _along_table(self.way, t_s)
        else:
            # r = sigma Delta,  r' = sigma' Delta / d: (20).
            sigma, sigma_rate = self._share_covered(profile, t_s)
            displacement[0] = np.multiply.outer(sigma, self.displacement_I)
            displacement[1] = np.multiply.outer(sigma_rate, self.displacement_I)
        return displacement

    def formation_steps(self, start_s: float) -> list[FormationStep]:
        """Return the changes of the formation in a phase that starts at `start_s`."""
        if self.formation is None:
            return []

        steps = []
        begin_s = start_s
        for share, length, width in self.formation:
            span_s = start_s + share * self.duration_s - begin_s
            sizes = np.array([length, width])
            steps.append(FormationStep(begin_s=begin_s, span_s=span_s, sizes=sizes))
            begin_s = begin_s + span_s
        return steps

    def ground_load(self, t_s: Array) -> tuple[Array, Array]:
        """Return the change of the level of (59) since the start of the phase, and its rate, 1/s.

        At times since the start, s, (k,): -1 after a take-off, 1 after a landing.
        """
        if self.kind not in ("take_off", "land"):
            return np.zeros(len(t_s)), np.zeros(len(t_s))

        span_s = HANDOVER * self.duration_s
        sign = 1.0 if self.kind == "land" else -1.0
        begin_s = self.duration_s - span_s if self.kind == "land" else 0.0

        share, slope = _sigma("min_jerk", (t_s - begin_s) / span_s)
        return sign * share, sign / span_s * slope

    def _share_covered(self, profile: Profile, t_s: Array) -> tuple[Array, Array]:
        """Return sigma, the share of a straight displacement, and its rate, 1/s, (k,): (20)."""
        if self.kind not in ("take_off", "land"):
            sigma, slope = _sigma(profile, t_s / self.duration_s)
            return sigma, slope / self.duration_s

        # The payload stands while its weight is handed over, which begins a take-off and ends a
        # landing: (59).
        span_s = (1.0 - HANDOVER) * self.duration_s
        begin_s = self.duration_s - span_s if self.kind == "take_off" else 0.0
        sigma, slope = _sigma("min_jerk", (t_s - begin_s) / span_s)
        return sigma, slope / span_s


def _checked_table(field: str, way: ArrayLike, end: Sequence[float]) -> Array:
    """Return a table of times and positions that leads to an end, s and m, (4,).

    Raises: ParameterError: it does not, or its times do not rise.
    """
    table = checked(field, way, (None, 4))

    ends = np.array([np.zeros(4), end])
    if len(table) < 2 or np.abs(table[[0, -1]] - ends).max() > _ROUNDING:
        expected = f"expected rows from {ends[0].tolist()} to {ends[1].tolist()}"
        raise ParameterError(f"{field}: {expected}")

    times_s = table[:, 0]
    for row in np.flatnonzero(np.diff(times_s) <= 0.0):
        later = row + 1
        expected = f"expected a time > {times_s[row]:g} s"
        raise ParameterError(f"{field}: row {later + 1}: {expected}, got {times_s[later]:g}")
    return table


def _checked_formation(field: str, formation: ArrayLike) -> Array:
    """Return rows of a formation.

    Raises: ParameterError: shares that do not rise from 0 to 1, or sizes that are not positive.
    """
    rows = checked(field, formation, (None, 3))
    shares, sizes = np.split(rows, [1], axis=1)

    is_rising = bool((np.diff(shares[:, 0], prepend=0.0) > 0.0).all()) and shares[-1] <= 1.0
    if not (is_rising and (sizes > 0.0).all()):
        raise ParameterError(
            f"{field}: expected rows of shares of the duration, rising above 0 to 1 at most, "
            f"and two numbers > 0, got {rows.tolist()}"
        )
    return rows


def _sigma(profile: Profile, tau: Array) -> tuple[Array, Array]:
    """Return sigma at normalised time tau, and its derivative with respect to tau: (20)."""
    is_inside = (tau >= 0.0) & (tau < 1.0)
    within = np.clip(tau, 0.0, 1.0)

    if profile == "ramp":
        return within, np.where(is_inside, 1.0, 0.0)

    if profile == "min_jerk":
        # sigma = 10 tau^3 - 15 tau^4 + 6 tau^5,  sigma' = 30 tau^2 (1 - tau)^2
        sigma = within**3 * (10.0 + within * (6.0 * within - 15.0))
        slope = 30.0 * (within * (1.0 - within)) ** 2
        return sigma, np.where(is_inside, slope, 0.0)

    if profile == "step":
        return np.where(tau >= 0.0, 1.0, 0.0), np.zeros_like(tau)

    # A smooth phase is a curve and has no sigma.
    raise ValueError(f"expected ramp, min_jerk or step, got {profile!r}")


def _along_table(table: Array, t_s: Array) -> tuple[Array, Array]:
    """Return position and velocity along a table, (k, 3) each; its ends are held."""
    times_s = table[:, 0]
    places = table[:, 1:]
    r = np.column_stack([np.interp(t_s, times_s, places[:, axis]) for axis in range(3)])

    speeds = np.diff(places, axis=0) / np.diff(times_s)[:, None]
    row = np.searchsorted(times_s, t_s, side="right") - 1
    is_inside = (row >= 0) & (row < len(speeds))
    v = np.where(is_inside[:, None], speeds[np.clip(row, 0, len(speeds) - 1)], 0.0)
    return r, v
