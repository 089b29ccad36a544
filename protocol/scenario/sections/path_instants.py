"""Instants at which limits and obstacles are checked along a path: dense on every piece of it.

Pieces end where the motion changes its formula: at ramps, way points, and changes of the formation.
The number of instants depends on the pieces alone, neither on the sampling period nor on durations.
"""

import math
from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from transport.model.arrays import Array, ascending
from transport.model.path.curves import Curve
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import HANDOVER, Phase

# Intervals of a piece, on which positions are polynomials of degree 7 to 13 in time: an extreme
# between two instants exceeds theirs by less than 0.3 %.
_PER_PIECE = 64

# Intervals of a lap of a circle or eight, one or two periods of a coordinate, and of all laps.
_PER_LAP = 128
_MOST_OF_LAPS = 100_003

# A smoothed table has a knot every 0.25 s, and at least 14 pieces, with 8 intervals each.
_TABLE_INTERVAL_S = 0.25 / 8.0
_LEAST_OF_TABLE = 14 * 8


class WayPointError(ValueError):
    """Way points that no spline passes; the text says which, what was expected and what came."""


def curve_instants(curve: Curve) -> Array:
    """Return the instants of a curve, s since its start, rising, from 0 to its duration."""
    if len(curve.table):
        intervals = max(math.ceil(curve.duration_s / _TABLE_INTERVAL_S), _LEAST_OF_TABLE)
        return np.linspace(0.0, curve.duration_s, intervals + 1)

    ends_s = [0.0, curve.ramp_s, curve.duration_s - curve.ramp_s, curve.duration_s]
    if curve.kind is None:
        return _divided(ends_s)

    if curve.kind == "spline":
        return _divided([*ends_s, *_way_point_times(curve, ends_s)])

    intervals = min(math.ceil(_PER_LAP * curve.laps), _MOST_OF_LAPS)
    turning_s = _times_of(curve, np.linspace(0.0, 1.0, intervals + 1), ends_s)
    return ascending(_divided(ends_s), turning_s)


def check_way_points(curve: Curve) -> None:
    """Check that a spline passes its way points one after the other, each away from the one before.

    Raises: WayPointError: two are the same, or too close in space or time for float64.
    """
    times_s = curve.times_s
    if times_s is not None and any(b <= a for a, b in pairwise(times_s)):
        return  # refused by its own check

    shares = np.array([0.0, *_way_point_shares(curve)])
    same = np.flatnonzero(np.diff(shares) <= 0.0)
    if len(same):
        number = int(same[0]) + 1
        before = f"way point {number - 1}" if number > 1 else "the start"
        raise WayPointError(
            f"points_m: expected each way point away from the one before in place and time, "
            f"got way point {number} at {before}"
        )


def maneuver_instants(maneuver: Maneuver) -> Array:
    """Return the instants of a whole maneuver with its targets, s since its start, rising."""
    parts_s = [np.zeros(1)]

    begin_s = 0.0
    for phase in maneuver.phases:
        parts_s.append(begin_s + _phase_instants(phase))
        begin_s += phase.duration_s

    for target in maneuver.targets:
        parts_s.append(target.since_s + curve_instants(target.approach))
        if target.way is not None:
            parts_s.append(target.leaves_s + curve_instants(target.way))

    return ascending(*parts_s)


def _phase_instants(phase: Phase) -> Array:
    """Return the instants of a phase, s since its start, rising."""
    duration_s = phase.duration_s
    handover_s = HANDOVER * duration_s
    parts_s = [_divided([0.0, handover_s, duration_s / 2.0, duration_s - handover_s, duration_s])]

    if isinstance(phase.way, Curve):
        parts_s.append(curve_instants(phase.way))
    elif phase.way is not None:
        parts_s.append(phase.way[:, 0])  # a table: at constant speed between rows

    if phase.formation is not None:
        changes_s = duration_s * np.array([0.0, *phase.formation[:, 0]])
        middles_s = (changes_s[1:] + changes_s[:-1]) / 2.0
        parts_s.append(_divided([*changes_s, *middles_s]))

    return ascending(*parts_s)


def _way_point_times(curve: Curve, ends_s: Iterable[float]) -> Iterable[float]:
    """Return the times of the way points of a spline, s since its start."""
    if curve.times_s is not None:
        return curve.times_s
    times_s: list[float] = _times_of(curve, _way_point_shares(curve), ends_s).tolist()
    return times_s


def _way_point_shares(curve: Curve) -> Array:
    """Return the shares s of the way points of a spline after its start, (k,)."""
    if curve.times_s is not None:
        return np.asarray(curve.covered(np.asarray(curve.times_s, dtype=np.float64), 1)[0])

    # s is proportional to the distance between way points, the first of which is the start.
    points = np.vstack([np.zeros(3), np.asarray(curve.points_I, dtype=np.float64)])
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length_m = lengths_m.sum()
    return np.asarray(np.cumsum(lengths_m) / length_m if length_m else np.zeros(len(lengths_m)))


def _times_of(curve: Curve, shares: Array, ends_s: Iterable[float]) -> Array:
    """Return the times at which a curve has covered shares of its shape, by interpolation, s."""
    dense_s = _divided(ends_s)
    covered = curve.covered(dense_s, 1)[0]
    return np.asarray(np.interp(shares, covered, dense_s))


def _divided(ends_s: Iterable[float]) -> Array:
    """Return the ends of pieces, in any order, and equal intervals between them, s, rising."""
    ends = ascending(np.fromiter(ends_s, dtype=np.float64))
    lengths = np.diff(ends)
    inside = ends[:-1, None] + lengths[:, None] * (np.arange(_PER_PIECE) / _PER_PIECE)
    return np.append(inside.ravel(), ends[-1])
