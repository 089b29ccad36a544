"""Targets that a process knows, in the order of all agents, and the run with them."""

from bisect import bisect_left

import numpy as np
from msgspec.structs import replace

from transport.protocol.admission.carried import Place, place_of
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import MAX_CARRIED, MAX_TARGETS, Target

# No team flies faster: a target that takes the payload there at more is an error, not a motion, m/s.
_FASTEST_MPS = 100.0


class KnownTargets:
    """Targets that a process knows, and the run with them: `setup`.

    Each leads away from the path with those before it, whenever it was heard: two processes that
    know the same targets have the same path.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._without = setup
        self._known: list[Target] = []  # by place
        self._carried: dict[Place, bytes] = {}

    def add(self, target: Target) -> bool:
        """Take in a target; return whether it is a new one."""
        places = [place_of(one) for one in self._known]
        at = bisect_left(places, place_of(target))
        is_known = at < len(places) and places[at] == place_of(target)
        if is_known or len(places) == MAX_TARGETS:
            return False
        self._known.insert(at, target)
        if at == len(places):
            self.setup = self.setup.led_to(target)
            return True

        self.setup = self._without
        for one in self._known:
            self.setup = self.setup.led_to(one)
        return True

    def knows(self, target: Target) -> bool:
        """Return whether a target is known."""
        return place_of(target) in map(place_of, self._known)

    def check(self, target: Target) -> None:
        """Refuse a target that is too far from the known path for any motion to it.

        Raises: MessageError: with distance and time.
        """
        since_s = target.tick * self.setup.settings.sampling_period_s
        path_I, _ = self.setup.maneuver.path(np.array([since_s]))
        distance_m = float(np.linalg.norm(target.points[0] - path_I[0]))
        in_s = target.approach_s - target.approach_ramp_s
        if distance_m > _FASTEST_MPS * in_s:
            text = f"expected a target within reach, got one {distance_m:g} m away in {in_s:g} s"
            raise MessageError("out_of_range", text)

    def carried(self, tick: int) -> tuple[bytes, ...]:
        """Return what a plan of a tick carries: `Plan.targets`.

        A target takes the place of the path before it once it is reached.
        """
        period_s = self.setup.settings.sampling_period_s
        depends: list[Target] = []
        for target in reversed(self._known):
            depends.append(target)
            if target.tick * period_s + target.approach_s <= tick * period_s:
                break
        told = [target for target in depends if target.to][:MAX_CARRIED]
        return tuple(self._bytes(target) for target in reversed(told))

    def _bytes(self, target: Target) -> bytes:
        place = place_of(target)
        if place not in self._carried:
            self._carried[place] = encode(replace(target, incarnation=0, sequence=0))
        return self._carried[place]
