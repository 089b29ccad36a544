"""Targets given during a run.

Messages of the coordinator, which decides the timing once, and a new reference each.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import combinations
from operator import itemgetter
from typing import Any, Protocol, Self

import numpy as np

from transport.model.arrays import Array
from transport.model.curves import ORDERS, Curve
from transport.model.flat import LEAST_TENSION, MOST_TILT, flight, slowed
from transport.model.hover import Hover
from transport.model.maneuver import Maneuver, Target
from transport.model.parameters import System, resting_height
from transport.model.state import INPUTS, StateView
from transport.mpc.settings import ControllerSettings
from transport.protocol.scenario.errors import RequestError
from transport.protocol.scenario.schema import Scenario, TargetSection
from transport.protocol.wire import messages
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.names import COORDINATOR
from transport.protocol.wire.node import Outbox


class Run(Protocol):
    """What the planning of a target needs of a run: a `protocol.scenario.setup.Setup`."""

    @property
    def scenario(self) -> Scenario:
        """The scenario."""

    @property
    def system(self) -> System:
        """The bodies."""

    @property
    def hover(self) -> Hover:
        """The equilibrium."""

    @property
    def settings(self) -> ControllerSettings:
        """Limits and sampling period."""

    @property
    def maneuver(self) -> Maneuver:
        """The path, with the targets so far."""

    @property
    def ticks(self) -> int:
        """Sampling instants of the run."""

    def with_target(self, target: Target) -> Self:
        """Return the run with a further target."""

    def after(self, targets: Iterable[messages.Target]) -> Self:
        """Return the run with the targets of messages that follow its own."""

    def blocked(self, times_s: Array) -> tuple[int, str] | None:
        """Return the first obstacle that the reference comes too near to."""


_SLOWEST, _ACCURACY = 64.0, 1e-3  # largest slowing tried, and relative accuracy of the one found
# Largest speed where none is given, m/s; time of speeding up that is tried first, s; its factors,
# largest one.
SPEED_MPS, _RAMP_S, _LONGER, _LONGEST = 1.0, 2.0, 1.25, 64.0
MOST = 1000  # targets of one run: a process that joins receives all of them
ON_GROUND_M = 1e-3  # how far a payload that takes off or lands may be from the ground
_SLACK = 1e-9


def exceeded(
    path: Array,
    system: System,
    hover: Hover,
    settings: ControllerSettings,
    released: Collection[int] = (),
) -> str | None:
    """Return the first limit that the team exceeds along a path, given by its jets, (7, k, 3).

    None if it keeps all.

    UAVs, 0-based, were released before it. Source: docs/equations.md (69).
    """
    left = [uav for uav in range(system.N) if uav not in released]
    held = hover.tensions[left]
    if not held.min() >= LEAST_TENSION * held.mean():
        return f"expected all rods of the UAVs left to carry the payload at hover, got {held.min():.4g} N in one"
    rho, lengths = (
        np.array([uav.rho for uav in system.uavs]),
        np.array([uav.rod_length for uav in system.uavs]),
    )
    aside = (
        np.linalg.norm((path[0, :, None, 3:] - 1.0) * rho[:, : path.shape[-1] - 3], axis=-1)
        / lengths
    )
    if aside.max() >= 1.0:
        return f"expected a formation with UAVs less than a rod's length off their attachments, got {aside.max():.3g}"
    flown, limits = flight(system, hover, path, released=released), settings.limits
    view, inputs = StateView(flown.x), flown.u.reshape(len(flown.x), system.N, INPUTS)[:, left]
    pulled = (flown.tensions / hover.tensions)[:, left]
    tilt_deg = min(math.degrees(MOST_TILT), settings.tilt.limit_deg if settings.tilt else math.inf)
    places = rho - lengths[:, None] * view.e_P
    apart = [
        np.linalg.norm(places[:, i] - places[:, j], axis=1).min() for i, j in combinations(left, 2)
    ]
    what, unit = ("a commanded rate", " rad/s") if system.commands_rates else ("a moment", " N m")
    largest = zip(settings.upper(1)[1:], np.abs(inputs[..., 1:]).max(axis=(0, 1)), strict=True)
    # Sign of the side on which a limit is kept, what it is on, its unit, the limit, and what is
    # furthest there.
    found: list[tuple[float, str, str, float, float]] = [
        (1.0, "a thrust of at most", " N", limits.thrust_N[1], inputs[..., 0].max()),
        (
            1.0,
            "a UAV tilt of at most",
            " deg",
            tilt_deg,
            math.degrees(np.abs(view.Theta[:, left]).max()),
        ),
        *(
            (1.0, f"{what} about axis {axis} of at most", unit, *both)
            for axis, both in enumerate(largest, start=1)
        ),
        (-1.0, "a thrust of at least", " N", limits.thrust_N[0], inputs[..., 0].min()),
        (-1.0, "a share of the rod tension at hover of at least", "", LEAST_TENSION, pulled.min()),
    ]
    if settings.tension is not None:
        found.append(
            (
                -1.0,
                "a rod tension of at least",
                " N",
                settings.tension.minimum_N,
                flown.tensions.min(),
            )
        )
    if settings.separation is not None and apart:
        found.append(
            (
                -1.0,
                "a distance of UAVs of at least",
                " m",
                settings.separation.minimum_m,
                min(apart),
            )
        )
    for sign, what, unit, limit, got in found:
        if not sign * got <= sign * limit:
            return f"expected {what} {limit:.4g}{unit} along the reference, got {got:.4g}{unit}"
    return None


def least_slowing(
    path: Array,
    system: System,
    hover: Hover,
    settings: ControllerSettings,
    released: Collection[int] = (),
) -> float | None:
    """Return the least factor on all durations with which the team keeps all limits.

    None if none does.
    """

    def fits(factor: float) -> bool:
        return exceeded(slowed(path, factor), system, hover, settings, released) is None

    low, high = 1.0, 2.0
    while not fits(high):
        if high >= _SLOWEST:
            return None
        low, high = high, 2.0 * high
    while high > (1.0 + _ACCURACY) * low:
        middle = (low + high) / 2.0
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def target_of(message: messages.Target, period_s: float) -> Target:
    """Return the target in a message. Raises: MessageError: its numbers make no curve."""
    first, further = message.points[0], message.points[1:] - message.points[0]
    approach = Curve(
        kind=None,
        duration_s=message.approach_s,
        ramp_s=message.approach_ramp_s,
        size_I=(1.0, 0.0, 0.0),
    )
    times_s = message.times[1:].tolist() if message.times.any() else None
    way = _spline(further, message.way_s, message.way_ramp_s, times_s) if len(further) else None
    return Target(since_s=message.tick * period_s, point_I=first, approach=approach, way=way)


def check_target(setup: Run, message: messages.Target) -> None:
    """Raise MessageError for a target that is neither the next one of a run nor one that is repeated."""
    last = len(setup.maneuver.targets)
    if message.number > last + 1:
        raise MessageError("future", f"target {message.number} after {last}")


def target_in_words(message: messages.Target) -> str:
    """Return a target in words."""
    x, y, z = message.points[0].tolist()
    return f"target ({x:g}, {y:g}, {z:g}) m"


def scripted(setup: Run) -> list[tuple[int, TargetSection]]:
    """Return the targets of a scenario with their ticks, in the order of time."""
    period_s, sections = setup.settings.sampling_period_s, setup.scenario.maneuver.target
    return sorted([(math.ceil(s.at_s / period_s - _SLACK), s) for s in sections], key=itemgetter(0))


def check_scripted(setup: Run) -> None:
    """Check that the targets of a scenario can be flown one after the other.

    Raises: RequestError: one cannot.
    """
    out = Outbox(COORDINATOR, 0)
    for number, (tick, section) in enumerate(scripted(setup), start=1):
        target = planned(setup, section, tick)
        setup = setup.after([out.stamp(messages.Target, number=number, **target)])


def planned(setup: Run, section: TargetSection, tick: int) -> dict[str, Any]:
    """Return the numbers of the message for a target from a tick on.

    Raises: RequestError: it cannot be flown.
    """
    points, period_s = np.array(section.points_m), setup.settings.sampling_period_s
    since_s = tick * period_s
    _check_places(setup, points, since_s)
    approach = _approach(setup, points[0], since_s, section.speed_mps or SPEED_MPS)
    way, times = None, np.zeros(len(points))
    if len(points) > 1:
        way = _way(setup, points[1:] - points[0], section)
        if way.times_s is not None:
            times[1:] = way.times_s
        _check_places(
            setup, points[0] + way.path(_instants(way.duration_s, period_s), 1)[0], since_s
        )
    ends_s, last_s = (
        since_s + approach.duration_s + (way.duration_s if way else 0.0),
        (setup.ticks - 1) * period_s,
    )
    if ends_s > last_s:
        expected = f"expected a target before the end of the run at t = {last_s:.2f} s"
        raise RequestError(f"{expected}, got {ends_s:.2f} s")
    if setup.scenario.obstacle:
        target = Target(since_s=since_s, point_I=points[0], approach=approach, way=way)
        led = setup.with_target(target)
        if blocked := led.blocked(np.arange(since_s, ends_s + period_s, period_s)):
            raise RequestError(f"points_m: {blocked[1]}")
    return {
        "tick": tick,
        "points": points,
        "times": times,
        "approach_s": approach.duration_s,
        "approach_ramp_s": approach.ramp_s,
        "way_s": way.duration_s if way else 0.0,
        "way_ramp_s": way.ramp_s if way else 0.0,
    }


def _check_places(setup: Run, points: Array, since_s: float) -> None:
    """Check that points are above the ground (without one z = 0, or as low as it has been), and the payload flies."""
    ground_m = setup.scenario.plant.ground_m
    flown = setup.maneuver.path(np.array([0.0, since_s]))[0]
    lowest_m = (
        max(0.0, *flown[:, 2]) if ground_m is None else resting_height(setup.system, ground_m)
    )
    if points[:, 2].max() > lowest_m + _SLACK:
        raise RequestError(
            f"points_m: expected z (down) of at most {lowest_m:g} m, got {points[:, 2].max():g}"
        )
    phase = setup.maneuver.phase_at(since_s)
    if ground_m is not None and (
        phase.kind in ("take_off", "land") or flown[1, 2] > lowest_m - ON_GROUND_M
    ):
        raise RequestError(
            f"expected a payload in flight, got phase {phase.name!r} at t = {since_s:.2f} s"
        )


def _approach(setup: Run, point_I: Array, since_s: float, speed_mps: float) -> Curve:
    """Return the approach of a target: the fastest of those tried that keeps the limits."""
    maneuver, flat = setup.maneuver, setup.scenario.maneuver.reference == "flat"
    here_I, end_I = maneuver.path(np.array([since_s, maneuver.duration_s]))[0]
    distance_m = max(np.linalg.norm(point_I - place) for place in (here_I, end_I))
    ramp_s, wrong = _RAMP_S, None
    while ramp_s <= _RAMP_S * _LONGEST:
        duration_s = max(float(distance_m) / speed_mps + ramp_s, 2.0 * ramp_s)
        straight = Curve(kind=None, duration_s=duration_s, ramp_s=ramp_s, size_I=(1.0, 0.0, 0.0))
        times_s = _instants(duration_s, setup.settings.sampling_period_s)
        if flat:
            target = Target(since_s=since_s, point_I=point_I, approach=straight)
            path = maneuver.with_target(target).jets(since_s + times_s)
        else:  # the reference of the controllers has no accelerations; those from rest are the target's own
            path = straight.covered(times_s, ORDERS)[..., None] * (point_I - here_I)
        wrong = exceeded(path, setup.system, setup.hover, setup.settings)
        if wrong is None:
            return straight
        ramp_s *= _LONGER
    raise RequestError(f"points_m: {wrong}")


def _way(setup: Run, further: Array, section: TargetSection) -> Curve:
    """Return the curve through way points relative to the target."""
    if section.times_s is not None:
        times_s = [time_s - section.times_s[0] for time_s in section.times_s[1:]]
        way = _spline(further, times_s[-1], min(_RAMP_S, times_s[-1] / 2.0), times_s)
    else:
        length_m = _spline(further, 2.0 * _RAMP_S, _RAMP_S, None).fastest()
        duration_s = max(length_m / (section.speed_mps or SPEED_MPS) + _RAMP_S, 2.0 * _RAMP_S)
        way = _spline(further, duration_s, _RAMP_S, None)
    period_s = setup.settings.sampling_period_s
    path = way.path(_instants(way.duration_s, period_s))
    wrong = exceeded(path, setup.system, setup.hover, setup.settings)
    if wrong is None:
        return way
    factor = least_slowing(path, setup.system, setup.hover, setup.settings)
    if factor is None:
        raise RequestError(f"points_m: {wrong}")
    if section.times_s is not None or section.speed_mps is not None:
        key = "speed_mps" if section.times_s is None else "times_s"
        raise RequestError(f"{key}: {wrong}; feasible in {factor:.3f} times the time")
    return replace(way, duration_s=factor * way.duration_s, ramp_s=factor * way.ramp_s)


def _spline(further: Array, duration_s: float, ramp_s: float, times_s: list[float] | None) -> Curve:
    return Curve(
        kind="spline",
        duration_s=duration_s,
        ramp_s=ramp_s,
        points_I=further.tolist(),
        times_s=times_s,
    )


def _instants(duration_s: float, period_s: float) -> Array:
    return np.linspace(0.0, duration_s, max(2, math.ceil(duration_s / period_s)) + 1)
