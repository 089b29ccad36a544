"""The reference of a run at its sampling instants.

It never changes: a target gives a new one.
"""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from transport.model.arrays import Array, continued, frozen
from transport.model.digests_and_shared_results import SharedResults, digest
from transport.model.path.flat_reference import FlatReference, Track
from transport.model.path.hover_reference import HoverReference as HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import PathTarget, Slowing

# Instants before a target for which a track and its gains are kept: more than estimators look back
# (`WINDOW` of agent/estimation/repeated_ticks.py).
KEPT = 128

# References with targets, which all nodes of a process follow: sampled once.
_WITH_TARGETS: SharedResults["Reference"] = SharedResults()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceChange:
    """The part of a reference from its newest target on, until the payload is at rest."""

    first: int  # first instant at which it differs from the reference before the target
    X: Array  # states from then on, (L, n); the last one is held
    track: Track | None  # with a flat reference, that at the same instants


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """Reference at instants 0..K-1, one sampling period apart; the last one is held."""

    X: Array  # states, (K, n), SI
    Y: Array = field(default_factory=lambda: np.zeros((0, 0)))  # outputs, (K, 4 N + 9), SI
    track: Track | None = None  # of a flat reference; after a target it begins at `track.first`
    change: ReferenceChange | None = None  # by the newest target

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

    It is sampled at its first use; the numbers do not depend on when that is. After a target the
    samples before it stay as they were, bit for bit.
    """

    def __init__(
        self, path: HoverReference | FlatReference, period_s: float, instants: int
    ) -> None:
        self._path = path
        self._period_s = period_s
        self._instants = instants
        self._key = digest(path.key, period_s, instants)
        # At most one of them: the samples, or the reference before the newest target, from which they
        # follow. Neither: a reference without targets that has not been sampled yet.
        self._sampled: Sampled | None = None
        self._before: Reference | None = None

    @property
    def maneuver(self) -> Maneuver:
        """The maneuver, with its targets so far."""
        return self._path.maneuver

    @property
    def is_flat(self) -> bool:
        """True if the team can fly it exactly."""
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

    def by_clock(self, ahead_s: float) -> "Reference":
        """Return the reference as it is followed by a clock that is ahead, s."""
        maneuver = dataclasses.replace(self.maneuver, ahead_s=ahead_s)
        return Reference(self._path.with_maneuver(maneuver), self._period_s, self._instants)

    def with_target(self, target: PathTarget) -> "Reference":
        """Return the reference with a further target."""
        maneuver = self.maneuver.with_target(target)
        return _WITH_TARGETS.get(digest(self._key, target), lambda: self._after(maneuver))

    def with_slowing(self, slowing: Slowing) -> "Reference":
        """Return the reference along which time is lost."""
        maneuver = self.maneuver.with_slowing(slowing)
        return _WITH_TARGETS.get(digest(self._key, slowing), lambda: self._after(maneuver))

    def _after(self, maneuver: Maneuver) -> "Reference":
        """Return the reference of the maneuver after a further change, anew."""
        reference = Reference(self._path.with_maneuver(maneuver), self._period_s, self._instants)
        reference._before = self
        return reference

    @property
    def sampled(self) -> Sampled:
        """The reference of controllers at the sampling instants."""
        # Go back to the newest reference with samples, then add one target after the other.
        newest, pending = self._newest_sampled()
        if newest._sampled is None:
            newest._sampled = newest._whole()

        samples = newest._sampled
        for later in reversed(pending):
            samples = later._after_target(samples)
            later._sampled = samples
            later._before = None  # not needed any more
        return samples

    def _newest_sampled(self) -> tuple["Reference", list["Reference"]]:
        """Return the newest reference with samples, or the first, and those after it, newest first."""
        pending: list[Reference] = []
        reference = self
        while reference._sampled is None and reference._before is not None:
            pending.append(reference)
            reference = reference._before
        return reference, pending

    def _whole(self) -> Sampled:
        """Return samples at all instants."""
        Y, X = self._path.followed(self.times_s)
        track = None
        if isinstance(self._path, FlatReference):
            track = self._path.track(self._instants, self._period_s)
        frozen(Y, X)
        return Sampled(X=X, Y=Y, track=track)

    def _after_target(self, before: Sampled) -> Sampled:
        """Return the samples after the newest target, from those before it."""
        maneuver = self.maneuver
        if maneuver.slowings:
            # Targets come before losses of time, which last for the rest of the run.
            first = max(0, round(maneuver.slowings[-1].since_s / self._period_s))
            end = self._instants
        else:
            target = maneuver.targets[-1]
            first = round(target.since_s / self._period_s)
            # The last row is held: at rest, with an instant to spare for a division that is rounded down.
            last = math.ceil(target.rests_s / self._period_s) + 1
            end = min(last + 1, self._instants)
        Y_part, X_part = self._path.followed(self.times_s[first:end])
        frozen(X_part)

        part = None
        if isinstance(self._path, FlatReference):
            part = self._path.track(end - first, self._period_s, first)
        track = part
        if part is not None and before.track is not None:
            track = continued(before.track, part, KEPT)

        change = ReferenceChange(first=first, X=X_part, track=part)
        return Sampled(
            X=_replaced(before.X, X_part, first),
            Y=_replaced(before.Y, Y_part, first),
            track=track,
            change=change,
        )


def _replaced(whole: Array, part: Array, first: int) -> Array:
    """Return a copy with a part from row `first` on, whose last row is repeated to the end."""
    rows = whole.copy()
    after = first + len(part)
    rows[first:after] = part
    rows[after:] = part[-1]
    frozen(rows)
    return rows
