"""The maneuver: phases of payload motion, straight, along a table or a curve, and the references that follow."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from transport.model import jets, state
from transport.model.arrays import Array, ArrayLike, assign, checked
from transport.model.curves import ORDERS, Curve
from transport.model.hover import Hover
from transport.model.identity import digest
from transport.model.parameters import ParameterError, System

Profile = Literal["ramp", "min_jerk", "step", "smooth"]
PhaseKind = Literal["move", "take_off", "land", "circle", "eight", "spline"]

_ROUNDING = (
    1e-9  # by which ends of a computed table may differ from duration and displacement, s and m
)

# Share of a take-off before the payload rises, and of a landing after it has sunk: its weight goes
# to or from the team.
HANDOVER = 0.25


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Phase:
    """One piece of the payload's path, straight, along a table or a curve.

    Take-off and landing: minimum jerk.
    """

    name: str  # for figures and progress, e.g. "climb"
    duration_s: float  # > 0
    displacement_I: Array  # from start to end of the phase, (3,), inertial frame (z down), m
    kind: PhaseKind
    # Times and positions since the start, s and m, (k, 4), at constant speed between rows. None: by
    # the profile.
    way: Array | None
    curve: Curve | None  # of the kinds circle, eight and spline, or of a smoothed table
    # Shares of the duration, and length and width of the team from then on, as multiples of those
    # at hover, (k, 3).
    formation: Array | None

    def __init__(
        self, *, name: str, duration_s: float, displacement_I: ArrayLike, kind: PhaseKind = "move",
        way: ArrayLike | None = None, curve: Curve | None = None, formation: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        displacement_I = checked(f"phase {name!r} displacement", displacement_I, (3,))
        assign(
            self,
            name=name,
            duration_s=float(duration_s),
            displacement_I=displacement_I,
            kind=kind,
            curve=curve,
        )
        if way is not None:
            way = checked(f"phase {name!r} way", way, (None, 4))
            ends = np.array([np.zeros(4), [duration_s, *displacement_I]])
            if len(way) < 2 or np.abs(way[[0, -1]] - ends).max() > _ROUNDING:
                raise ParameterError(
                    f"phase {name!r} way: expected rows from {ends[0].tolist()} to {ends[1].tolist()}"
                )
            for row in np.flatnonzero(np.diff(way[:, 0]) <= 0.0):
                problem = (
                    f"row {row + 2}: expected a time > {way[row, 0]:g} s, got {way[row + 1, 0]:g}"
                )
                raise ParameterError(f"phase {name!r} way: {problem}")
        if formation is not None:
            formation = checked(f"phase {name!r} formation", formation, (None, 3))
            shares = np.array([0.0, *formation[:, 0]])
            if (
                not (np.diff(shares) > 0.0).all()
                or shares[-1] > 1.0
                or not (formation[:, 1:] > 0.0).all()
            ):
                expected = "expected rows of shares of the duration, rising above 0 to 1 at most, and two numbers > 0"
                raise ParameterError(
                    f"phase {name!r} formation: {expected}, got {formation.tolist()}"
                )
        assign(self, way=way, formation=formation)


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """A target given during the flight.

    The payload leaves its path for it, and may run through a curve from there.
    """

    since_s: float  # time from which on the path changes, s
    point_I: Array  # position of the target, (3,), inertial frame, m
    approach: Curve  # straight, of length 1, whose share is that of the target in the path
    way: Curve | None = None  # from the target on; None: the target is the end

    @property
    def reached_s(self) -> float:
        """Time at which the payload's reference is at the target, s."""
        return self.since_s + self.approach.duration_s

    @property
    def ends_s(self) -> float:
        """Time from which on the reference is at rest, s."""
        return self.reached_s + (0.0 if self.way is None else self.way.duration_s)

    @property
    def end_I(self) -> Array:
        """Position of the reference from then on, (3,), m."""
        return np.asarray(self.goal(np.array([self.ends_s]), 1)[0, 0])

    def goal(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the target, and of the curve after it, at times t_s, (k,).

        (orders, k, 3), SI.
        """
        found = (
            np.zeros((orders, len(t_s), 3))
            if self.way is None
            else self.way.path(t_s - self.reached_s, orders)
        )
        found[0] += self.point_I
        return found

    def joined(self, t_s: Array, found: Array) -> Array:
        """Return jets of a path since then, (orders, k, 3), led to the target by a mean of both, as smooth: (75)."""
        orders, goal = len(found), self.goal(t_s, len(found))
        share = self.approach.covered(t_s - self.since_s, orders)[..., None]
        mean = found + jets.product(share, goal - found)
        return np.asarray(np.where((t_s >= self.reached_s)[:, None], goal, mean))


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Maneuver:
    """The payload's reference path r0(t)."""

    start_I: Array  # payload position at t = 0, (3,), inertial frame, m
    phases: tuple[Phase, ...]  # in this order; the end is held
    profile: Profile  # of straight phases: constant speed, minimum jerk, a step at the beginning, or as a `Curve`
    press_m: float  # how far below the ground the controllers' reference is while the ground carries the payload, m
    targets: tuple[
        Target, ...
    ]  # given during the flight, in this order: each leads away from the path before it

    def __init__(
        self, *, start_I: ArrayLike, phases: Sequence[Phase], profile: Profile = "ramp", press_m: float = 0.0,
        targets: Sequence[Target] = (),
    ) -> None:  # fmt: skip
        for phase, after in pairwise(phases):
            if phase.kind == "land" and after.kind == "move" and after.displacement_I.any():
                raise ParameterError(
                    f"phase {after.name!r}: expected a take-off, or no way, after a landing"
                )
        start_I = checked("maneuver start", start_I, (3,))
        assign(
            self,
            start_I=start_I,
            phases=tuple(phases),
            profile=profile,
            press_m=press_m,
            targets=tuple(targets),
        )

    def with_target(self, target: Target) -> "Maneuver":
        """Return the maneuver with a further target."""
        return replace(self, targets=(*self.targets, target))

    @property
    def duration_s(self) -> float:
        """Sum over the phases, s."""
        return sum(phase.duration_s for phase in self.phases)

    def stages(self) -> list[tuple[str, float, float]]:
        """Return name, begin and end, s, of the phases as far as they are flown, and of the ways to the targets."""
        ends_s = np.cumsum([0.0, *(phase.duration_s for phase in self.phases)]).tolist()
        found = [
            (phase.name, *between)
            for phase, between in zip(self.phases, pairwise(ends_s), strict=True)
        ]
        for target in self.targets:
            since_s = target.since_s
            found = [
                (name, begin, min(end, since_s)) for name, begin, end in found if begin < since_s
            ]
            found.append(("target", since_s, target.ends_s))
            if target.ends_s < ends_s[-1]:
                found.append(("at target", target.ends_s, ends_s[-1]))
        return found

    def phase_at(self, t_s: float) -> Phase:
        """Return the phase that a time belongs to.

        The first phase before the start, the last one after the end.
        """
        for target in reversed(self.targets):
            if t_s >= target.since_s:
                name = "target" if t_s < target.ends_s else "at target"
                return Phase(
                    name=name, duration_s=target.ends_s - target.since_s, displacement_I=np.zeros(3)
                )
        end_s = 0.0
        for phase in self.phases:
            end_s += phase.duration_s
            if t_s < end_s:
                break
        return phase

    def path(self, t_s: Array) -> tuple[Array, Array]:
        """Return r0 and r0' at times t_s, (k,).

        (k, 3) each, m and m/s, inertial; a step has no velocity: (20).
        """
        r, v = self._along(t_s, 2)
        return r, v

    def jets(self, t_s: Array) -> Array:
        """Return jets of the path at t_s, (`ORDERS`, k, 3), 5 with formation.

        (65). Raises: ParameterError.
        """
        for phase in self.phases:
            if self._curve(phase) is None and (phase.displacement_I.any() or phase.way is not None):
                expected = "expected a smooth path, that of profile 'smooth'"
                raise ParameterError(f"phase {phase.name!r}: {expected}, got {self.profile!r}")
        found = self._along(t_s, ORDERS)
        if all(phase.formation is None for phase in self.phases):
            return found
        return np.concatenate([found, self.formation(t_s)], axis=-1)

    def _along(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the path, (orders, k, 3).

        Phases that are not smooth have position and velocity.
        """
        found, begin = np.zeros((orders, len(t_s), 3)), 0.0
        found[0] = self.start_I
        for phase in self.phases:
            curve = self._curve(phase)
            if curve is not None:
                found += curve.path(t_s - begin, orders)
            elif phase.way is not None:
                found[:2] += np.stack(_by_table(phase.way, t_s - begin))
            else:
                found[:2] += np.multiply.outer(
                    np.stack(self._progress(phase, t_s - begin)), phase.displacement_I
                )
            begin += phase.duration_s
        for target in self.targets:
            after = t_s >= target.since_s
            if after.any():
                found[:, after] = target.joined(t_s[after], found[:, after])
        return found

    def formation(self, t_s: Array) -> Array:
        """Return the jets of length and width of the team as multiples of those at hover, (`ORDERS`, k, 2): (66a)."""
        found, begin, held = np.zeros((ORDERS, len(t_s), 2)), 0.0, np.ones(2)
        found[0] = 1.0
        for phase in self.phases:
            before = begin
            for share, *then in [] if phase.formation is None else phase.formation:
                span = begin + share * phase.duration_s - before
                change = Curve(kind=None, duration_s=span, ramp_s=span / 2.0).covered(
                    t_s - before, ORDERS
                )
                found += change[..., None] * (then - held)
                before, held = before + span, np.array(then)
            begin += phase.duration_s
        return found

    def _curve(self, phase: Phase) -> Curve | None:
        if (
            phase.curve is not None
            or self.profile != "smooth"
            or phase.kind != "move"
            or phase.way is not None
        ):
            return phase.curve
        size_I = tuple(phase.displacement_I.tolist())
        return Curve(
            kind=None, duration_s=phase.duration_s, ramp_s=phase.duration_s / 2.0, size_I=size_I
        )

    def press(self, t_s: Array) -> tuple[Array, Array]:
        """Return how far below the payload's path the controllers' reference is, (k,), m, and its rate, m/s: (59)."""
        level = np.full(len(t_s), float(self.phases[0].kind == "take_off"))
        rate = np.zeros(len(t_s))
        if self.targets:  # given in flight; landings after them do not take place
            t_s = np.minimum(t_s, self.targets[0].since_s)
        begin = 0.0
        for phase in self.phases:
            span = HANDOVER * phase.duration_s
            if phase.kind != "move":
                sign, first = (
                    (1.0, phase.duration_s - span) if phase.kind == "land" else (-1.0, 0.0)
                )
                s, s_dot = _profile("min_jerk", (t_s - begin - first) / span)
                level, rate = level + sign * s, rate + sign / span * s_dot
            begin += phase.duration_s
        return self.press_m * level, self.press_m * rate

    def _progress(self, phase: Phase, t_s: Array) -> tuple[Array, Array]:
        """Return the share of a straight phase's displacement since its beginning, and its rate, (k,) each, 1/s."""
        begin, span, profile = 0.0, phase.duration_s, self.profile
        if phase.kind != "move":
            span, profile = (1.0 - HANDOVER) * phase.duration_s, "min_jerk"
            begin = phase.duration_s - span if phase.kind == "take_off" else 0.0
        s, s_dot = _profile(profile, (t_s - begin) / span)
        return s, s_dot / span


class Reference:
    """The reference outputs and states of a maneuver: the hover configuration moved along the path."""

    def __init__(self, system: System, hover: Hover, maneuver: Maneuver) -> None:
        self.maneuver = maneuver
        self._system, self._hover = system, hover
        rods = state.StateView(hover.x).e_P
        self._offsets = np.array(
            [uav.rho - uav.rod_length * e for uav, e in zip(system.uavs, rods, strict=True)]
        )

    @property
    def key(self) -> bytes:
        """Digest of the numbers that the reference follows from."""
        return digest("hover", self._system, self._hover, self.maneuver)

    def with_maneuver(self, maneuver: Maneuver) -> "Reference":
        """Return the reference of another maneuver of the team."""
        return Reference(self._system, self._hover, maneuver)

    def followed(self, t_s: Array) -> tuple[Array, Array]:
        """Return outputs and states that controllers follow, lower while the payload is on the ground: (59)."""
        y, x, (depth, rate) = self.outputs(t_s), self.states(t_s), self.maneuver.press(t_s)
        y[:, 2 : 3 * self._system.N : 3] += depth[:, None]
        y[:, -4] += depth
        y[:, -1] += rate
        x[:, state.R0.start + 2] += depth
        x[:, state.V0.start + 2] += rate
        return y, x

    def outputs(self, t_s: Array) -> Array:
        """Return y_ref at times t_s, (k,), s.

        Level payload, no yaw rates, (k, 4 N + 9), SI: (14), (20).
        """
        r0, v0 = self.maneuver.path(t_s)
        N = self._system.N
        y = np.zeros((len(t_s), self._system.p))
        y[:, : 3 * N] = (r0[:, None, :] + self._offsets).reshape(len(t_s), 3 * N)
        y[:, -6:-3], y[:, -3:] = r0, v0
        return y

    def states(self, t_s: Array) -> Array:
        """Return x_ref at times t_s, (k,), s.

        Hover at r0(t) with velocity r0'(t), (k, 12 + 12 N), SI.
        """
        x = np.tile(self._hover.x, (len(t_s), 1))
        x[:, : state.V0.stop] += np.hstack(self.maneuver.path(t_s))
        return x


def _profile(profile: Profile, tau: Array) -> tuple[Array, Array]:
    """Return the share of the displacement at normalised time tau, and its derivative with respect to tau."""
    inside = (tau >= 0.0) & (tau < 1.0)
    c = np.clip(tau, 0.0, 1.0)
    if profile == "ramp":
        return c, np.where(inside, 1.0, 0.0)
    if profile == "min_jerk":
        return c**3 * (10.0 + c * (6.0 * c - 15.0)), np.where(
            inside, 30.0 * (c * (1.0 - c)) ** 2, 0.0
        )
    return np.where(tau >= 0.0, 1.0, 0.0), np.zeros_like(tau)


def _by_table(way: Array, t_s: Array) -> tuple[Array, Array]:
    """Return position and velocity along a table, (k, 3) each; its ends are held."""
    times, places = way[:, 0], way[:, 1:]
    r = np.column_stack([np.interp(t_s, times, places[:, axis]) for axis in range(3)])
    speeds = np.diff(places, axis=0) / np.diff(times)[:, None]
    row = np.searchsorted(times, t_s, side="right") - 1
    inside = (row >= 0) & (row < len(speeds))
    return r, np.where(inside[:, None], speeds[np.clip(row, 0, len(speeds) - 1)], 0.0)
