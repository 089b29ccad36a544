"""Numbers of the flight in a summary: cost, tracking, distances, cables and targets."""

import math
from itertools import zip_longest
from typing import Any

import numpy as np

from transport.analysis.distances_and_violations import limits_reached
from transport.analysis.events import TIME_DIGITS
from transport.analysis.numbers_for_json import finite, largest
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.path.target_and_stop import PathTarget
from transport.model.state import R0
from transport.protocol.admission.targets_in_plans import carried_by
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages

# Time after which a target counts as reached or missed, s.
SETTLED_S = 2.0
# Tolerance of times, s: a tick times the sampling period has rounding errors.
_ROUNDING_S = 1e-9
# End of the run in which the swing is measured, s: longer than the 3.6 s period of a pendulum of
# 3.2 m, and shorter than the last hover of the paper's maneuver, 5 s.
SWING_S = 4.0
# Tolerance of a number of periods: a time over the sampling period has rounding errors.
_ROUNDING = 1e-6


def cost_and_tracking(setup: Setup, series: Series) -> dict[str, Any]:
    """Return cost, attitude, tracking errors, distances and violations, as JSON data."""
    # The first phase, or what a target in it leaves of it, lets the formation settle about its hover,
    # as in the paper's section V.
    _, _, first_ends_s = setup.maneuver.stages()[0]
    settled = series.times_s >= first_ends_s
    swing_m = swing_of(setup, series)

    return {
        "cost": {
            "mean": finite(series.cost.mean()) if len(series.cost) else None,
            "max": largest(series.cost),
            "max_after_hover": largest(series.cost[settled]),
        },
        "attitude_max_deg": largest(series.attitude_max_deg),
        "uav_tracking": _tracking(series.uav_errors_I[series.on_rods]),
        "payload_tracking": {
            **_tracking(series.payload_error_I),
            "swing_m": None if swing_m is None else finite(swing_m),
        },
        "separation_min_m": finite(series.separation_m.min(initial=np.inf)),
        "clearance_min_m": _clearance(setup, series),
        "constraint_violation_max": largest(series.violation),
        "constraint_violation": _worst_limit(series),
        "limits_reached": [
            {"uav": uav + 1, "limit": limit, "share": share}
            for (uav, limit), share in limits_reached(setup, series.ticks, series.u).items()
        ],
        "local_error_max": largest(series.local_error),
    }


def swing_of(setup: Setup, series: Series) -> float | None:
    """Return the largest payload position error in the last `SWING_S` of a run, m.

    None without a recorded tick.
    """
    if not len(series.ticks):
        return None
    periods = math.ceil(SWING_S / setup.settings.sampling_period_s - _ROUNDING)
    at_end = series.ticks > series.ticks[-1] - periods
    return float(series.payload_error_norm_m[at_end].max())


def _worst_limit(series: Series) -> dict[str, Any] | None:
    """Return which limit is exceeded most, and when; None if all hold."""
    if not series.violation.any():
        return None
    name = max(series.violations, key=lambda name: series.violations[name].max())
    row = int(series.violations[name].argmax())
    return {"limit": name, "at_s": round(float(series.times_s[row]), TIME_DIGITS)}


def _clearance(setup: Setup, series: Series) -> dict[str, float | None] | None:
    """Return the smallest distances from obstacles, m; None without obstacles."""
    if not setup.obstacles:
        return None
    uav_m, rod_m, payload_m = series.clearance_m.min(axis=0, initial=np.inf)
    return {"uav": finite(uav_m), "rod": finite(rod_m), "payload": finite(payload_m)}


def _tracking(errors_I: Array) -> dict[str, float | None]:
    """Return RMS and maximum of the lengths of position errors, (..., 3), m."""
    errors_m = np.linalg.norm(errors_I, axis=-1).ravel()
    if not len(errors_m):
        return {"rms_m": None, "max_m": None}
    rms_m = np.sqrt(np.mean(errors_m**2))
    return {"rms_m": finite(rms_m), "max_m": largest(errors_m)}


def cables(setup: Setup, log: RunLog) -> dict[str, Any] | None:
    """Return the least tension of the cables, and how often and how long they were slack.

    None without cables.
    """
    tensions_by_tick = {
        actual.tick: actual.tensions
        for actual in log.of(messages.ActualInputs)
        if len(actual.tensions)
    }
    if not tensions_by_tick:
        return None

    tensions_N = np.array([tensions_by_tick[tick] for tick in sorted(tensions_by_tick)])
    slack_ticks = _slack_ticks(tensions_N)
    return {
        "tension_min_N": finite(tensions_N.min()),
        "slack": len(slack_ticks),
        "slack_longest_s": float(slack_ticks.max(initial=0)) * setup.settings.sampling_period_s,
        "slack_at_end": int((tensions_N[-1] <= 0.0).sum()),
    }


def _slack_ticks(tensions_N: Array) -> Array:
    """Return the length of each slack of a cable, ticks, from tensions, (T, cables), N."""
    taut = np.zeros_like(tensions_N[:1])
    slack = np.vstack([taut, tensions_N <= 0.0, taut])
    changes = np.diff(slack, axis=0)  # +1 at the first tick of a slack, -1 behind its last
    lengths = []
    for change in changes.T:
        begins = np.flatnonzero(change > 0.0)
        ends = np.flatnonzero(change < 0.0)
        lengths.append(ends - begins)
    return np.concatenate(lengths)


def targets(setup: Setup, series: Series, log: RunLog) -> list[dict[str, Any]]:
    """Return the targets, when all agents knew them, and how close the payload came, as JSON data.

    The distance is judged `SETTLED_S` after the reference had reached the last point, or sooner where
    the next target or the end of the run comes before.
    """
    paths = setup.maneuver.targets
    last_s = series.times_s.max(initial=-np.inf)
    known_s = _known_after_s(setup, log)
    rows = []
    number = 0  # of targets that were told; those of agents have none
    for path, following in zip_longest(paths, paths[1:]):
        number += not path.brakes
        next_s = np.inf if following is None else following.since_s
        judged_s = min(path.ends_s + SETTLED_S, last_s, next_s)
        rows.append(
            {
                "t_s": round(path.since_s, TIME_DIGITS),
                "arrives_s": round(path.ends_s, TIME_DIGITS),
                "position_m": path.end_I.tolist(),
                "error_m": _distance_m(series, path, judged_s),
                "known_s": None if path.brakes else known_s.get(number),
            }
        )
    return rows


def _known_after_s(setup: Setup, log: RunLog) -> dict[int, float]:
    """Return by number of a target the time until all agents on the last roster had it in their plans, s."""
    roster = max(log.of(messages.Roster), key=lambda one: one.version, default=None)
    first_ticks: dict[int, dict[int, int]] = {}  # by number and agent
    for plan in log.of(messages.Plan):
        for target in carried_by(plan):
            first_ticks.setdefault(target.number, {}).setdefault(plan.agent, plan.tick)

    known_s = {}
    for target in log.of(messages.Target):
        had = first_ticks.get(target.number, {})
        if not target.to:
            known_s[target.number] = 0.0
        elif roster is not None and had.keys() >= set(roster.agents):
            ticks = max(had[agent] for agent in roster.agents) - target.tick
            known_s[target.number] = round(ticks * setup.settings.sampling_period_s, TIME_DIGITS)
    return known_s


def _distance_m(series: Series, path: PathTarget, judged_s: float) -> float | None:
    """Return the payload's distance from the end of a path at a time, m; None before it ends."""
    if judged_s < path.ends_s - _ROUNDING_S:
        return None
    row = np.searchsorted(series.times_s, judged_s - _ROUNDING_S)
    return float(np.linalg.norm(series.x[row, R0] - path.end_I))
