"""The maneuver: the payload's reference path, phase by phase, with the targets given in flight."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from transport.model.arrays import Array, ArrayLike, assign, checked
from transport.model.path import taylor_jets as jets
from transport.model.path.curves import ORDERS
from transport.model.path.phase import Phase, Profile
from transport.model.path.target_and_stop import PathTarget, Slowing
from transport.model.physics.parameters import ParameterError

# Names of the way to a target and of the rest after it: in flight, and of one that lands.
_STAGES = ("target", "at target"), ("landing", "landed")


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Maneuver:
    """The payload's reference path r0(t)."""

    start_I: Array  # payload position at t = 0, (3,), inertial frame, m
    phases: tuple[Phase, ...]  # in this order; the end is held
    # Progress along straight phases: constant speed, minimum jerk, a step at the beginning, or as a
    # `Curve`.
    profile: Profile
    # Depth of the controllers' reference below the path while the ground carries the payload, m.
    press_m: float
    # Given during the flight, in this order: each leads away from the path before it.
    targets: tuple[PathTarget, ...]
    # Losses of time along the path with all targets, in this order.
    slowings: tuple[Slowing, ...]
    # By how much the clock by which the path is followed is ahead, s: at t it is where it is to be then.
    ahead_s: float

    def __init__(  # noqa: PLR0913  # a value object
        self,
        *,
        start_I: ArrayLike,
        phases: Sequence[Phase],
        profile: Profile = "ramp",
        press_m: float = 0.0,
        targets: Sequence[PathTarget] = (),
        slowings: Sequence[Slowing] = (),
        ahead_s: float = 0.0,
    ) -> None:
        if not phases:
            raise ParameterError("maneuver: expected at least one phase, got none")
        _check_ground(phases)
        assign(
            self,
            start_I=checked("maneuver start", start_I, (3,)),
            phases=tuple(phases),
            profile=profile,
            press_m=press_m,
            targets=tuple(targets),
            slowings=tuple(slowings),
            ahead_s=ahead_s,
        )

    def with_target(self, target: PathTarget) -> "Maneuver":
        """Return the maneuver with a further target."""
        return replace(self, targets=(*self.targets, target))

    def with_slowing(self, slowing: Slowing) -> "Maneuver":
        """Return the maneuver along whose path time is lost, also on the way to later targets."""
        return replace(self, slowings=(*self.slowings, slowing))

    def with_longer(self, number: int, factor: float) -> "Maneuver":
        """Return the maneuver with a phase, counted from 1, that takes `factor` times as long."""
        phases = list(self.phases)
        phases[number - 1] = phases[number - 1].longer(factor)
        return replace(self, phases=tuple(phases))

    @property
    def duration_s(self) -> float:
        """Sum over the phases, s."""
        return sum(phase.duration_s for phase in self.phases)

    def stages(self) -> list[tuple[str, float, float]]:
        """Return name, begin and end, s, of the stages of the flight.

        These are the phases, as far as no target ends them, and the ways to the targets.
        """
        ends_s = np.cumsum([0.0, *(phase.duration_s for phase in self.phases)]).tolist()
        stages = []
        for phase, (begin_s, end_s) in zip(self.phases, pairwise(ends_s), strict=True):
            stages.append((phase.name, begin_s, end_s))

        for target in self.targets:
            # A target replaces what is left of the ways before it.
            since_s = target.since_s
            stages = [
                (name, begin_s, min(end_s, since_s))
                for name, begin_s, end_s in stages
                if begin_s < since_s
            ]
            on_the_way, there = _STAGES[target.lands]
            stages.append((on_the_way, since_s, target.ends_s))
            if target.ends_s < ends_s[-1]:
                stages.append((there, target.ends_s, ends_s[-1]))
        return stages

    def phase_at(self, t_s: float) -> Phase:
        """Return the phase that a time belongs to.

        The first phase before the start, the last one after the end.
        """
        for target in reversed(self.targets):
            if t_s >= target.since_s:
                return Phase(
                    name=_STAGES[target.lands][t_s >= target.ends_s],
                    duration_s=target.ends_s - target.since_s,
                    displacement_I=np.zeros(3),
                )

        for phase, begin_s in self._timed_phases():
            if t_s < begin_s + phase.duration_s:
                return phase
        return self.phases[-1]

    def _timed_phases(self) -> Iterator[tuple[Phase, float]]:
        """Yield the phases and when they begin, s."""
        begin_s = 0.0
        for phase in self.phases:
            yield phase, begin_s
            begin_s += phase.duration_s

    def _by_clock(self, t_s: Array) -> Array:
        """Return the times that the clock shows at times t_s, from the beginning on."""
        return np.maximum(t_s + self.ahead_s, 0.0) if self.ahead_s else t_s

    def progress(self, t_s: float) -> float:
        """Return the time along the path without losses of time at which the payload is at a time, s."""
        return float(self._warped(self._by_clock(np.array([t_s])), 1)[0, 0]) - self.ahead_s

    def path(self, t_s: Array) -> tuple[Array, Array]:
        """Return r0 and r0' at times t_s, (k,), s.

        (k, 3) each, m and m/s, inertial; a step has no velocity: (20).
        """
        r0, v0 = self._path_jets(self._by_clock(t_s), orders=2)
        return r0, v0

    def jets(self, t_s: Array) -> Array:
        """Return the jets of a smooth path at times t_s, (k,), s: (`ORDERS`, k, 3), SI.

        With a formation (`ORDERS`, k, 5): its length and width follow. Source: (65).
        Raises: ParameterError: a phase that is not smooth.
        """
        for phase in self.phases:
            if phase.has_way and phase.curve(self.profile) is None:
                expected = "expected a smooth path, that of profile 'smooth'"
                raise ParameterError(f"phase {phase.name!r}: {expected}, got {self.profile!r}")

        t_s = self._by_clock(t_s)
        path = self._path_jets(t_s, ORDERS)
        if all(phase.formation is None for phase in self.phases):
            return path
        return np.concatenate([path, self.formation(t_s)], axis=-1)

    def formation(self, t_s: Array) -> Array:
        """Return the jets of length and width of the team, (`ORDERS`, k, 2): (66a).

        As multiples of those at hover, at times t_s, (k,), s. Changes take place at their times also
        after a target.
        """
        if self.slowings:
            w = self._warped(t_s, ORDERS)
            return jets.composed(replace(self, slowings=()).formation(w[0]), w)
        sizes = np.zeros((ORDERS, len(t_s), 2))
        sizes[0] = 1.0

        sizes_before = np.ones(2)
        for phase, begin_s in self._timed_phases():
            for step in phase.formation_steps(begin_s):
                # lambda += s (lambda_after - lambda_before)
                s = step.covered(t_s)
                sizes += s[..., None] * (step.sizes - sizes_before)
                sizes_before = step.sizes
        return sizes

    def press(self, t_s: Array) -> tuple[Array, Array]:
        """Return the depth p l(t) of the controllers' reference below the path, and its rate: (59).

        At times t_s, (k,), s: (k,), m, and (k,), m/s.
        """
        if self.slowings:
            w = self._warped(self._by_clock(t_s), 2)
            depth, sinking = replace(self, slowings=(), ahead_s=0.0).press(w[0])
            return depth, sinking * w[1]
        level = np.full(len(t_s), float(self.phases[0].kind == "take_off"))
        rate = np.zeros(len(t_s))
        t_s = self._by_clock(t_s)
        if self.targets:
            # Targets are given in flight: a landing before the newest one does not take place.
            level_change, rate_change = self.targets[-1].ground_load(t_s)
            level = level + level_change
            rate = rate + rate_change

        # Landings after the first target do not take place: the level of then stays.
        until_s = self.targets[0].since_s if self.targets else math.inf
        t_s = np.minimum(t_s, until_s)
        for phase, begin_s in self._timed_phases():
            level_change, rate_change = phase.ground_load(t_s - begin_s)
            level = level + level_change
            rate = rate + rate_change
        return self.press_m * level, self.press_m * rate

    def _path_jets(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the path at times of the clock, (k,), s: (orders, k, 3), SI, inertial.

        Each target leads away from the path of the phases and of the targets before it.
        Source: (20), (75), (77).
        """
        if self.slowings:
            # r(w(t)), with the path r without losses of time.
            w = self._warped(t_s, orders)
            return jets.composed(replace(self, slowings=())._path_jets(w[0], orders), w)
        # Backwards from the newest target: the times along the path that it leads away from.
        legs = []
        times_s = t_s
        for target in reversed(self.targets):
            leg = _Leg.of(target, times_s, orders)
            legs.append(leg)
            times_s = leg.before_s

        # Forwards: the path of the phases, led away by each target.
        r = self._phase_jets(times_s, orders)
        for leg in reversed(legs):
            r = leg.led(r)
        return r

    def _phase_jets(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the path of the phases alone, arguments as `_path_jets`: (20)."""
        r = np.zeros((orders, len(t_s), 3))
        r[0] = self.start_I
        for phase, begin_s in self._timed_phases():
            r += phase.jets(self.profile, t_s - begin_s, orders)
        return r

    def _warped(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the time along the path without losses of time, (orders, k), s: (77)."""
        # w(t) = t without losses, then w_1(w_2(...)): the last one is nearest to the clock.
        w = np.zeros((orders, len(t_s)))
        w[0] = t_s
        if orders > 1:
            w[1] = 1.0
        for slowing in reversed(self.slowings):
            w = jets.composed(slowing.warped(w[0], orders), w)
        return w


@dataclass(frozen=True, slots=True, kw_only=True)
class _Leg:
    """A target at the times at which the path is evaluated, and the times along the path before it."""

    target: PathTarget
    t_s: Array  # times of the maneuver, (k,), s
    # Jets of the time w(t) along the path before, (orders, k), s, on which the payload brakes; None
    # if it leaves that path in flight: then w(t) = t.
    w: Array | None

    @staticmethod
    def of(target: PathTarget, t_s: Array, orders: int) -> "_Leg":
        """Return the leg of a target at times of the maneuver, (k,), s."""
        w = target.braking.warped(t_s, orders) if target.brakes else None
        return _Leg(target=target, t_s=t_s, w=w)

    @property
    def before_s(self) -> Array:
        """Times at which `led` needs the path before: w(t), and last that of its rest; else t."""
        return self.t_s if self.w is None else np.append(self.w[0], self.target.rest_s)

    def led(self, r: Array) -> Array:
        """Return the jets of the path with the target, (orders, k, 3): (75), (77), (78).

        r: Those of the path before at the times `before_s`, which are changed.
        """
        is_led = self.t_s >= self.target.since_s
        rest_I = None
        if self.w is not None:
            rest_I = r[0, -1]
            r = r[:, :-1]
            r[:, is_led] = jets.composed(r[:, is_led], self.w[:, is_led])
        if is_led.any():
            r[:, is_led] = self.target.joined(self.t_s[is_led], r[:, is_led], rest_I)
        return r


def _check_ground(phases: Sequence[Phase]) -> None:
    """Check that the payload stays where it has landed until a take-off.

    Raises: ParameterError: a phase drags it along the ground.
    """
    has_landed = False
    for phase in phases:
        if phase.kind == "take_off":
            has_landed = False
        elif has_landed and phase.has_way:
            expected = "expected a take-off, or no way, after a landing"
            raise ParameterError(f"phase {phase.name!r}: {expected}")
        elif phase.kind == "land":
            has_landed = True
