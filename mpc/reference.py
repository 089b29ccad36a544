"""The reference of a run at its sampling instants, as a value: with a target it is another one."""

import math
from dataclasses import dataclass, field

import numpy as np

from transport.model.arrays import Array, continued, frozen
from transport.model.flat import FlatReference, Track
from transport.model.identity import digest
from transport.model.maneuver import Maneuver, Target
from transport.model.maneuver import Reference as HoverReference
from transport.mpc.shared import SharedResults

# Instants before a target for which the law before it is kept: more than estimators look back.
KEPT = 128

# References with targets, which all nodes of a process follow: sampled once.
_WITH_TARGETS: SharedResults["Reference"] = SharedResults()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Change:
    """Part of a reference that its newest target has changed: until it is at rest."""

    first: int  # instant from which on it is another one than before
    X: Array  # states from then on, (L, n); the last one is held
    track: Track | None  # with a flat reference, that at the same instants


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """Reference at instants 0..K-1, one sampling period apart; the last one is held."""

    X: Array  # states, (K, n), SI
    Y: Array = field(default_factory=lambda: np.zeros((0, 0)))  # outputs, (K, 4 N + 9), SI
    track: Track | None = None  # states and inputs of a flat reference
    change: Change | None = None  # by the newest target

    @property
    def key(self) -> bytes:
        """Digest of the numbers that control laws follow from."""
        track = self.track
        by_track = () if track is None else (track.X, track.U, track.X_middle, track.paths)
        first = 0 if track is None else track.first
        since = None if self.change is None else self.change.first
        return digest(self.X, *by_track, first, since)


class Reference:
    """Reference of a maneuver: outputs and states at any time, and sampled for controllers.

    It is sampled when that is first needed, with the same numbers whenever that is. After a target
    the samples before it stay as they were, bit for bit.
    """

    def __init__(
        self, path: HoverReference | FlatReference, period_s: float, instants: int
    ) -> None:
        self._path = path
        self._period_s = period_s
        self._instants = instants
        self._key = digest(path.key, period_s, instants)
        # Either the samples, or the reference before the newest target, from which they follow.
        self._sampled: Sampled | None = None
        self._before: Reference | None = None

    @property
    def maneuver(self) -> Maneuver:
        """The maneuver, with its targets so far."""
        return self._path.maneuver

    @property
    def is_flat(self) -> bool:
        """Whether the team can fly it exactly."""
        return isinstance(self._path, FlatReference)

    @property
    def times_s(self) -> Array:
        """All instants, (K,), s."""
        return self._period_s * np.arange(self._instants, dtype=np.float64)

    def outputs(self, t_s: Array) -> Array:
        """Return y_ref at times t_s, (k,), s: (k, 4 N + 9), SI. Source: equations.md (14), (20)."""
        return self._path.outputs(t_s)

    def states(self, t_s: Array) -> Array:
        """Return x_ref at times t_s, (k,), s: (k, 12 + 12 N), SI."""
        return self._path.states(t_s)

    def with_target(self, target: Target) -> "Reference":
        """Return the reference with a further target."""
        return _WITH_TARGETS.get(digest(self._key, target), lambda: self._leading_to(target))

    def _leading_to(self, target: Target) -> "Reference":
        """Return the reference with a further target, anew."""
        path = self._path.with_maneuver(self.maneuver.with_target(target))
        reference = Reference(path, self._period_s, self._instants)
        reference._before = self
        return reference

    @property
    def sampled(self) -> Sampled:
        """What controllers follow at the sampling instants."""
        # From the newest reference that has samples, one target after the other.
        pending: list[Reference] = []
        reference = self
        while reference._sampled is None and reference._before is not None:
            pending.append(reference)
            reference = reference._before
        if reference._sampled is None:
            reference._sampled = reference._whole()

        samples = reference._sampled
        for later in reversed(pending):
            samples = later._changed(samples)
            later._sampled = samples
            later._before = None
        return samples

    def _whole(self) -> Sampled:
        """Return samples at all instants."""
        Y, X = self._path.followed(self.times_s)
        track = None
        if isinstance(self._path, FlatReference):
            track = self._path.track(self._instants, self._period_s)
        frozen(Y, X)
        return Sampled(X=X, Y=Y, track=track)

    def _changed(self, before: Sampled) -> Sampled:
        """Return the samples after the newest target, from those before it."""
        target = self.maneuver.targets[-1]
        first = round(target.since_s / self._period_s)
        at_rest = min(math.ceil(target.ends_s / self._period_s) + 2, self._instants)
        Y_part, X_part = self._path.followed(self.times_s[first:at_rest])
        frozen(X_part)

        part = None
        if isinstance(self._path, FlatReference):
            part = self._path.track(at_rest - first, self._period_s, first)
        track = part
        if part is not None and before.track is not None:
            track = continued(before.track, part, KEPT)

        change = Change(first=first, X=X_part, track=part)
        return Sampled(
            X=_replaced(before.X, X_part, first),
            Y=_replaced(before.Y, Y_part, first),
            track=track,
            change=change,
        )


def _replaced(whole: Array, part: Array, first: int) -> Array:
    """Return rows with others from `first` on; those behind are like the last of them."""
    rows = whole.copy()
    after = first + len(part)
    rows[first:after] = part
    rows[after:] = part[-1]
    frozen(rows)
    return rows
