"""Targets that a process knows, in the order of all agents, and the run with them."""

from collections.abc import Iterable

import numpy as np
from msgspec.structs import replace

from transport.model.path.target_and_stop import Slowing
from transport.protocol.admission.targets_in_plans import Place, is_of_sight, place_of
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.codec import encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.message_form import MAX_CARRIED, MAX_TARGETS
from transport.protocol.wire.messages import MAX_TICK, Target

# No team flies faster: a target that takes the payload there at more is an error, not a motion, m/s.
_FASTEST_MPS = 100.0


def braking_only(target: Target) -> Target:
    """Return a target because of an obstacle as it is followed before all have it: up to its rest."""
    return replace(
        target,
        points=target.points[:1],
        times=target.times[:1],
        way_s=0.0,
        way_ramp_s=0.0,
        informed=(),
        got=(),
        begins=MAX_TICK,
    )


def _whole_since(target: Target) -> int:
    """Return the tick from which on all of a target is followed, the later the less of it is known."""
    if not is_of_sight(target):
        return target.first_tick
    is_waiting = target.informed and not target.begins
    return MAX_TICK if is_waiting else target.begins


class KnownTargets:
    """Targets that a process knows and follows, and the run with them: `setup`.

    Each leads away from the path with those before it, from its first tick on, whenever it was heard:
    two processes that know the same targets have the same path.
    """

    def __init__(self, setup: TeamRun) -> None:
        self.setup = setup
        self._without = setup
        self._known: dict[Place, Target] = {}
        self._followed: list[Target] = []  # those of them that the path follows from, by place
        self._slowings: list[Slowing] = []  # losses of time along it

    def add(self, target: Target) -> bool:
        """Take in a target; return whether the path is a new one.

        Of two first ticks of a target, the earlier one counts.
        """
        place = place_of(target)
        known = self._known.get(place)
        if known is not None and _whole_since(target) >= _whole_since(known):
            return False
        if known is None and len(self._known) == MAX_TARGETS:
            return False
        self._known[place] = target

        before = self._followed
        self._followed = self._not_replaced()
        firsts = [(place_of(one), _whole_since(one)) for one in self._followed]
        firsts_before = [(place_of(one), _whole_since(one)) for one in before]
        if firsts == firsts_before:
            return False
        if firsts == [*firsts_before, (place, _whole_since(target))] and not self._slowings:
            self.setup = self.setup.led_to(target)
        else:
            self._renew()
        return True

    def slow(self, slowing: Slowing) -> None:
        """Lose time along the path, with all targets; a loss that began at the same time is replaced."""
        others = [one for one in self._slowings if one.since_s != slowing.since_s]
        self._slowings = [*others, slowing]
        self._renew()

    def _renew(self) -> None:
        """Make the path anew: the targets, then the losses of time along it."""
        self.setup = self._without
        for target in self._followed:
            self.setup = self.setup.led_to(target)
        for slowing in self._slowings:
            self.setup = self.setup.with_slowing(slowing)

    def _not_replaced(self) -> list[Target]:
        """Return the targets that began before all newer ones, by place."""
        targets: list[Target] = []
        for _, target in sorted(self._known.items(), reverse=True):
            if not targets or target.first_tick <= targets[-1].first_tick:
                targets.append(target)
        return targets[::-1]

    @property
    def without_stops(self) -> TeamRun:
        """The run with the targets alone, without losses of time along its path."""
        run = self._without
        for target in self._followed:
            run = run.led_to(target)
        return run

    @property
    def newest(self) -> Place:
        """Place of the newest target; before all where there is none."""
        return max(self._known, default=(-1, 0))

    def knows(self, target: Target) -> bool:
        """Return whether a target is known, with this first tick or an earlier one."""
        known = self._known.get(place_of(target))
        return known is not None and _whole_since(known) <= _whole_since(target)

    def check(self, target: Target) -> None:
        """Refuse a target that is too far from the known path for any motion to it.

        Raises: MessageError: with distance and time.
        """
        since_s = target.first_tick * self.setup.settings.sampling_period_s
        path_I, _ = self.setup.maneuver.path(np.array([since_s]))
        distance_m = float(np.linalg.norm(target.points[0] - path_I[0]))
        in_s = target.approach_s - target.approach_ramp_s
        if distance_m > _FASTEST_MPS * in_s:
            text = f"expected a target within reach, got one {distance_m:g} m away in {in_s:g} s"
            raise MessageError("out_of_range", text)

    def carried(self, tick: int, unconfirmed: Iterable[Target] = ()) -> tuple[bytes, ...]:
        """Return what a plan of a tick carries, `Plan.targets`, with those that are not followed yet.

        A target takes the place of the path before it once it is reached.
        """
        period_s = self.setup.settings.sampling_period_s
        depends: list[Target] = []
        for target in reversed(self._followed):
            depends.append(target)
            if target.first_tick * period_s + target.approach_s <= tick * period_s:
                break
        waiting = {place_of(target): target for target in unconfirmed}
        told = [one for one in depends if one.to and place_of(one) not in waiting]
        # Braking before all had a target, and a newer one came: the newer one brakes as well.
        told = [one for one in told if one.begins < MAX_TICK]
        told += waiting.values()
        newest = sorted(told, key=place_of)[-MAX_CARRIED:]
        return tuple(encode(replace(target, incarnation=0, sequence=0)) for target in newest)
