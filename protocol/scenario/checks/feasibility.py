"""Limits of a team along a path, and the least slowing of the path with which it keeps them."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from transport.model.arrays import Array
from transport.model.path.flatness import LEAST_TENSION, MOST_TILT, Flight, flight, slowed
from transport.model.physics.hover import Hover, hover_after_failures, with_released
from transport.model.physics.parameters import System
from transport.model.state import INPUTS, StateView
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.scenario.faults.faults_by_tick import Fault, failures

# Largest slowing that is tried, and relative accuracy of the least one.
_SLOWEST = 64.0
_ACCURACY = 1e-3

ON_GROUND_M = 1e-3  # how far a payload that takes off or lands may be from the ground

# Instants whose motion is computed at once: the memory of a long path stays that of a short one.
_AT_ONCE = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class Extreme:
    """The value of a quantity on a path that is furthest towards its bound, or beyond it."""

    quantity: str  # in words, with "at most" or "at least"
    unit: str  # with a blank before it; empty for none
    bound: float
    is_upper: bool  # whether the bound is the largest value admitted
    value: float
    uavs: tuple[int, ...]  # that have the value, 0-based: one, or two that are this far apart
    instant: int  # number of the instant of the path, from 0

    @property
    def room(self) -> float:
        """Room that is left up to the bound as a share of it; below 0 beyond the bound."""
        room = self.bound - self.value if self.is_upper else self.value - self.bound
        return room / abs(self.bound) if self.bound else room

    @property
    def names(self) -> str:
        """UAVs that have the value, counted from 1."""
        return " and ".join(f"UAV{uav + 1}" for uav in self.uavs)

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; not so by a value that is no number."""
        return self.value <= self.bound if self.is_upper else self.value >= self.bound

    def joined(self, other: "Extreme") -> "Extreme":
        """Return the further one of two extremes of a quantity, or the one that is not a number."""
        if math.isnan(self.value) or math.isnan(other.value):
            return self if math.isnan(self.value) else other
        is_further = other.value > self.value if self.is_upper else other.value < self.value
        return other if is_further else self

    def text(self, when: Callable[[int], str] = lambda _: "") -> str:
        """Return expected and got in words, with the UAVs; `when` has the words of an instant."""
        expected = f"expected {self.quantity} {self.bound:.4g}{self.unit} along the reference"
        return f"{expected}, got {self.value:.4g}{self.unit} of {self.names}{when(self.instant)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class RemainingTeam:
    """The team after scripted releases, from a tick on."""

    tick: int
    system: System
    hover: Hover
    released: frozenset[int]  # UAVs off their rods, 0-based

    @property
    def remaining(self) -> list[int]:
        """UAVs that are still on their rods, 0-based: only they have limits."""
        return [uav for uav in range(self.system.N) if uav not in self.released]


def remaining_teams(
    system: System, hover: Hover, faults: Sequence[Fault]
) -> Iterator[RemainingTeam]:
    """Yield the whole team, then the team after each scripted release, in the order of time.

    Raises: ParameterError: those remaining cannot hover.
    """
    gone: frozenset[int] = frozenset()
    yield RemainingTeam(tick=0, system=system, hover=hover, released=gone)
    for fault in failures(faults):
        if fault.do != "release":
            continue
        gone |= {fault.uav}
        yield RemainingTeam(
            tick=fault.tick,
            system=with_released(system, gone),
            hover=hover_after_failures(system, gone, gone),
            released=gone,
        )


def exceeded(
    path: Array,
    team: RemainingTeam,
    settings: ControllerSettings,
    when: Callable[[int], str] = lambda _: "",
) -> str | None:
    """Return the first limit that the team exceeds along a path, in words; None if it keeps all.

    The path is given by its jets at k instants, (7, k, 3), or (7, k, 5) with a formation. The
    instants must be dense (`path_instants`): nothing is known between them. `when` has the words of
    an instant, by its number. Source: docs/equations.md (69).
    """
    held_N = team.hover.tensions[team.remaining]
    if not held_N.min() >= LEAST_TENSION * held_N.mean():
        expected = "expected all rods of the remaining UAVs to carry the payload at hover"
        return f"{expected}, got {held_N.min():.4g} N in one"

    aside = _aside(path, team.system)
    if aside >= 1.0:
        expected = "expected a formation with UAVs less than a rod's length off their attachments"
        return f"{expected}, got {aside:.3g}"

    beyond = (extreme for extreme in extremes(path, team, settings) if not extreme.holds)
    return next((extreme.text(when) for extreme in beyond), None)


def extremes(path: Array, team: RemainingTeam, settings: ControllerSettings) -> list[Extreme]:
    """Return the extremes of all limited quantities along a path, given as in `exceeded`."""
    furthest: list[Extreme] = []
    for first in range(0, path.shape[1], _AT_ONCE):
        part = path[:, first : first + _AT_ONCE]
        flown = flight(team.system, team.hover, part, released=team.released)
        further = [
            replace(extreme, instant=first + extreme.instant)
            for extreme in _extremes(flown, team, settings)
        ]
        before = furthest or further
        furthest = [one.joined(other) for one, other in zip(before, further, strict=True)]
    return furthest


def least_slowing(path: Array, team: RemainingTeam, settings: ControllerSettings) -> float | None:
    """Return the least factor on all durations with which the limits are kept; None without one."""
    return least_factor(lambda factor: exceeded(slowed(path, factor), team, settings) is None)


def least_factor(is_kept: Callable[[float], bool]) -> float | None:
    """Return the least factor on durations with which limits are kept; None without one."""
    low = 1.0
    high = 2.0
    while not is_kept(high):
        if high >= _SLOWEST:
            return None
        low = high
        high *= 2.0

    while high > (1.0 + _ACCURACY) * low:
        middle = (low + high) / 2.0
        if is_kept(middle):
            high = middle
        else:
            low = middle
    return high


def _aside(path: Array, system: System) -> float:
    """Return the largest horizontal offset of a UAV from its attachment, over its rod length.

    Released UAVs count: (66a) has a place for them as well, without a force.
    """
    rho = np.array([uav.rho for uav in system.uavs])
    lengths_m = np.array([uav.rod_length for uav in system.uavs])
    stretch = path[0, :, None, 3:] - 1.0
    aside_m = np.linalg.norm(stretch * rho[:, : path.shape[-1] - 3], axis=-1)
    return float((aside_m / lengths_m).max())


def _extremes(
    flown: Flight, team: RemainingTeam, settings: ControllerSettings
) -> Iterator[Extreme]:
    """Yield the extremes of the quantities of the remaining UAVs, always in the same order.

    The order decides between limits that are exceeded alike. Source: docs/equations.md (69).
    """
    yield from _largest(flown, team, settings)
    yield from _smallest(flown, team, settings)
    if settings.separation is not None and len(team.remaining) > 1:
        pairs = list(combinations(team.remaining, 2))
        distances_m = _distances(flown, team)
        quantity = "a distance of UAVs of at least"
        minimum_m = settings.separation.minimum_m
        yield _furthest(quantity, " m", minimum_m, distances_m.T, pairs, is_upper=False)


def _largest(flown: Flight, team: RemainingTeam, settings: ControllerSettings) -> Iterator[Extreme]:
    """Yield the extremes with an upper bound: thrust, tilt, moments or commanded rates."""
    remaining = team.remaining
    inputs = _inputs_of_remaining(flown, team)
    Theta = StateView(flown.x).Theta[:, remaining]

    tilt_deg = math.degrees(MOST_TILT)
    if settings.tilt is not None:
        tilt_deg = min(tilt_deg, settings.tilt.limit_deg)
    largest_deg = np.degrees(np.abs(Theta)).max(axis=-1)

    turning = "a moment"
    turning_unit = " N m"
    if team.system.commands_rates:
        turning = "a commanded rate"
        turning_unit = " rad/s"

    def highest(quantity: str, unit: str, bound: float, values: Array) -> Extreme:
        uavs = [(uav,) for uav in remaining]
        return _furthest(f"{quantity} of at most", unit, bound, values, uavs, is_upper=True)

    yield highest("a thrust", " N", settings.limits.thrust_N[1], inputs[..., 0])
    yield highest("a UAV tilt", " deg", tilt_deg, largest_deg)
    for axis, bound in enumerate(settings.upper(1)[1:], start=1):
        quantity = f"{turning} about axis {axis}"
        yield highest(quantity, turning_unit, float(bound), np.abs(inputs[..., axis]))


def _smallest(
    flown: Flight, team: RemainingTeam, settings: ControllerSettings
) -> Iterator[Extreme]:
    """Yield the extremes with a lower bound: thrust, and tension of the rods."""
    remaining = team.remaining
    thrusts_N = _inputs_of_remaining(flown, team)[..., 0]
    tensions_N = flown.tensions[:, remaining]
    shares_of_hover = tensions_N / team.hover.tensions[remaining]

    def lowest(quantity: str, unit: str, bound: float, values: Array) -> Extreme:
        uavs = [(uav,) for uav in remaining]
        return _furthest(f"{quantity} of at least", unit, bound, values, uavs, is_upper=False)

    yield lowest("a thrust", " N", settings.limits.thrust_N[0], thrusts_N)
    yield lowest("a share of the rod tension at hover", "", LEAST_TENSION, shares_of_hover)
    if settings.tension is not None:
        yield lowest("a rod tension", " N", settings.tension.minimum_N, tensions_N)


def _inputs_of_remaining(flown: Flight, team: RemainingTeam) -> Array:
    """Return thrust and moments or rates of the remaining UAVs at k instants, (k, remaining, 4)."""
    return flown.u.reshape(len(flown.x), team.system.N, INPUTS)[:, team.remaining]


def _furthest(
    quantity: str,
    unit: str,
    bound: float,
    values: Array,
    of: Sequence[tuple[int, ...]],
    *,
    is_upper: bool,
) -> Extreme:
    """Return the extreme of values, (k, len(of)), of UAVs or pairs at k instants."""
    place = values.argmax() if is_upper else values.argmin()  # that of a NaN, if there is one
    instant, column = np.unravel_index(place, values.shape)
    return Extreme(
        quantity=quantity,
        unit=unit,
        bound=bound,
        is_upper=is_upper,
        value=float(values[instant, column]),
        uavs=of[int(column)],
        instant=int(instant),
    )


def _distances(flown: Flight, team: RemainingTeam) -> Array:
    """Return the distances of all pairs of remaining UAVs at every instant, (pairs, k), m."""
    rho = np.array([uav.rho for uav in team.system.uavs])
    lengths_m = np.array([uav.rod_length for uav in team.system.uavs])
    r_P = rho - lengths_m[:, None] * StateView(flown.x).e_P
    return np.array(
        [np.linalg.norm(r_P[:, i] - r_P[:, j], axis=1) for i, j in combinations(team.remaining, 2)]
    )
