"""Space of a search: which events are drawn, within which bounds, from a point of the unit cube."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from annotated_types import Interval, Len
from pydantic import AfterValidator, BeforeValidator

from transport.model.arrays import Array
from transport.model.section import NotNegative, Section
from transport.protocol.scenario.scenario_file import read_tree
from transport.protocol.scenario.sections.scenario_errors import ScenarioError, validated
from transport.protocol.scenario.sections.schema import Scenario
from transport.search.candidate import Candidate
from transport.search.kinds_of_events import (
    Death,
    DrawnSilence,
    DrawnTeam,
    Event,
    Gusts,
    Links,
    ModelError,
    SensorsOff,
    TargetEvent,
)
from transport.search.optimiser import SearchLayout


def _as_tuple(value: Any) -> Any:
    """Return a list of a file as a tuple, which a frozen section has."""
    return tuple(value) if isinstance(value, list) else value


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    """Refuse bounds of which the first is above the second."""
    if value[0] > value[1]:
        raise ValueError(f"expected smallest <= largest, got {list(value)}")
    return value


Range = Annotated[
    tuple[NotNegative, NotNegative], BeforeValidator(_as_tuple), AfterValidator(_rising)
]
Share = Annotated[float, Interval(ge=0.0, le=1.0)]
Shares = Annotated[tuple[Share, Share], BeforeValidator(_as_tuple), AfterValidator(_rising)]
Who = Literal["all", "mute", "deaf", "cut"]
_SEEDS = 1000  # of gusts and sensors
_RESOLUTION = 1e-3  # of times, seconds and other numbers: finer ones change no run
_ACTIVE = 0.5  # an event exists where its first coordinate is at least this


class SilenceBounds(Section):
    """Windows without messages."""

    count: Annotated[int, Interval(ge=1, le=8)] = 2
    """most windows"""
    start_s: Range = (1.0, 20.0)
    """begin of a window"""
    duration_s: Range = (0.5, 10.0)
    """length of a window"""
    loss: Shares = (1.0, 1.0)
    """share of the messages that are lost in it"""
    who: Annotated[tuple[Who, ...], BeforeValidator(_as_tuple), Len(1)] = get_args(Who)
    """whose messages: of all, from one agent, to one agent, between two agents and the others"""


class DeathBounds(Section):
    """Agents that are killed."""

    count: Annotated[int, Interval(ge=1, le=8)] = 1
    """most deaths"""
    at_s: Range = (1.0, 20.0)
    """time of a death"""
    back_after_s: Range = (0.5, 8.0)
    """time until the agent is started again; half of the deaths are for good"""


class LinksBounds(Section):
    """Impairments of all links for the whole run."""

    delay_s: Range = (0.0, 0.4)
    jitter_s: Range = (0.0, 0.1)
    loss: Shares = (0.0, 0.6)


class GustsBounds(Section):
    """Gusts of wind."""

    speed_mps: Range = (0.0, 1.0)
    """standard deviation of each component"""


class MassBounds(Section):
    """Errors of the model that the controllers use."""

    mass_factor: Range = (0.9, 1.15)
    """actual over known mass of the payload"""
    motor_lag_s: Range = (0.0, 0.0)
    """lag of the motors"""


class SensorsBounds(Section):
    """Noise of the sensors."""

    factor: Range = (0.0, 1.0)
    """multiple of the scenario's standard deviations"""


class TargetsBounds(Section):
    """Targets of the payload during the run."""

    count: Annotated[int, Interval(ge=1, le=8)] = 1
    """most targets"""
    at_s: Range = (1.0, 10.0)
    """time of a target"""
    distance_m: Range = (0.5, 2.0)
    """distance of a target from the start of the maneuver"""


class TeamBounds(Section):
    """Vehicles and payload drawn at random (`protocol.scenario.teams.drawn_team`)."""

    seeds: Annotated[int, Interval(ge=1)] = 1000
    """teams to choose from"""


class Bounds(Section):
    """Bounds of all kinds of events, as a TOML file has them."""

    silence: SilenceBounds = SilenceBounds()
    deaths: DeathBounds = DeathBounds()
    links: LinksBounds = LinksBounds()
    gusts: GustsBounds = GustsBounds()
    mass: MassBounds = MassBounds()
    sensors: SensorsBounds = SensorsBounds()
    targets: TargetsBounds = TargetsBounds()
    team: TeamBounds = TeamBounds()


KINDS = tuple(Bounds.model_fields)


def read_bounds(file: Path | None, duration_s: float, kinds: Sequence[str] = KINDS) -> Bounds:
    """Return the bounds in a file, or the defaults; times that it does not give fit the run.

    Raises: ScenarioError: the file cannot be read, a value is invalid, or bounds have no effect: of
        events that are not drawn, or that begin after the run.
    """
    tree = {} if file is None else read_tree(file)
    source = str(file or "bounds")
    bounds = validated(Bounds, tree, source, Path())
    _check_effect(bounds, kinds, duration_s, source)

    last_s = 0.8 * duration_s
    first_s = min(1.0, last_s)
    fitting = {
        "silence": {"start_s": (first_s, last_s)},
        "deaths": {"at_s": (first_s, last_s)},
        "targets": {"at_s": (first_s, max(first_s, 0.4 * duration_s))},
    }
    changed = {}
    for kind, ranges in fitting.items():
        section = getattr(bounds, kind)
        left = {key: value for key, value in ranges.items() if key not in section.model_fields_set}
        changed[kind] = section.model_copy(update=left)
    return bounds.model_copy(update=changed)


def _check_effect(bounds: Bounds, kinds: Sequence[str], duration_s: float, source: str) -> None:
    """Refuse bounds of events that are not drawn, or that begin after the run."""
    for kind in bounds.model_fields_set:
        if kind not in kinds:
            raise ScenarioError(source, kind, f"expected bounds of --over {','.join(kinds)} only")

        section = getattr(bounds, kind)
        for key in section.model_fields_set & {"start_s", "at_s"}:
            begins_s = list(getattr(section, key))
            if begins_s[0] >= duration_s:
                problem = f"expected times in the run of {duration_s:g} s, got {begins_s}"
                raise ScenarioError(source, f"{kind}.{key}", problem)


# Whether 1 is worse than 0 in a coordinate.
_SEVERE, _MILD = True, False


@dataclass(frozen=True, slots=True)
class Slot:
    """Room for one event: its coordinates in the unit cube, and the event at a point of them."""

    coordinates: Mapping[str, bool]  # by name, in their order: whether 1 is worse than 0
    event: Callable[..., Event | None]  # at the coordinates, each by its name

    @property
    def dimension(self) -> int:
        """Return the number of coordinates."""
        return len(self.coordinates)


class Space:
    """The unit cube over the slots of some kinds of events."""

    def __init__(self, kinds: Sequence[str], bounds: Bounds, scenario: Scenario) -> None:
        wrong = [kind for kind in kinds if kind not in KINDS]
        if wrong or not kinds:
            expected = f"expected some of {', '.join(KINDS)}"
            raise ScenarioError("--over", "", f"{expected}, got {wrong[0] if wrong else 'none'}")

        agents = len(scenario.owned)
        slots: list[Slot] = []

        for kind in kinds:
            slots += _SLOTS[kind](getattr(bounds, kind), agents)
        self._slots = tuple(slots)
        ends = np.cumsum([0, *(slot.dimension for slot in slots)]).tolist()
        self.layout = SearchLayout(
            events=tuple(slice(begin, end) for begin, end in itertools.pairwise(ends)),
            severe=np.array([severe for slot in slots for severe in slot.coordinates.values()]),
        )
        corners = (np.full(self.dimension, end) for end in (0.0, 1.0))
        if not any(self.candidate(corner).events for corner in corners):
            problem = f"expected bounds that allow an event of {', '.join(kinds)}, got none"
            raise ScenarioError("bounds", "", problem)

    def candidate(self, point: Array) -> Candidate:
        """Return the candidate at a point of the unit cube, (dimension,)."""
        events = []
        for slot, part in zip(self._slots, self.layout.events, strict=True):
            events.append(slot.event(**dict(zip(slot.coordinates, point[part], strict=True))))
        return Candidate(_with_one_seed([event for event in events if event is not None]))

    @property
    def dimension(self) -> int:
        """Return the number of coordinates of the unit cube."""
        return self.layout.dimension


def _with_one_seed(events: Sequence[Event]) -> tuple[Event, ...]:
    """Return events of which the sensors take the seed of the gusts: a run has one."""
    has_gusts = any(isinstance(event, Gusts) for event in events)
    return tuple(
        replace(event, seed=None) if has_gusts and isinstance(event, SensorsOff) else event
        for event in events
    )


def _between(bounds: Range, share: float) -> float:
    """Return the number at a share of an interval, on the grid of the search."""
    low, high = bounds
    value = low + float(np.clip(share, 0.0, 1.0)) * (high - low)
    return round(round(value / _RESOLUTION) * _RESOLUTION, 6)


def _choice(count: int, share: float) -> int:
    """Return one of `count` numbers from 0 on."""
    return min(int(np.clip(share, 0.0, 1.0) * count), count - 1)


def _silences(bounds: SilenceBounds, agents: int) -> list[Slot]:
    def event(  # noqa: PLR0913  # one for each coordinate
        *,
        active: float,
        start: float,
        duration: float,
        loss: float,
        kind: float,
        agent: float,
        other: float,
    ) -> DrawnSilence | None:
        if active < _ACTIVE:
            return None
        who = bounds.who[_choice(len(bounds.who), kind)]
        first = 1 + _choice(agents, agent)
        second = 1 + (first + _choice(agents - 1, other)) % agents
        named = {"mute": f" {first}", "deaf": f" {first}", "cut": f" {first} {second}"}

        return DrawnSilence(
            start_s=_between(bounds.start_s, start),
            duration_s=_between(bounds.duration_s, duration),
            who=who + named.get(who, ""),
            loss=_between(bounds.loss, loss),
        )

    return [
        Slot(
            {
                "active": _SEVERE,
                "start": _MILD,
                "duration": _SEVERE,
                "loss": _SEVERE,
                "kind": _MILD,
                "agent": _MILD,
                "other": _MILD,
            },
            event,
        )
    ] * bounds.count


def _deaths(bounds: DeathBounds, agents: int) -> list[Slot]:
    def event(
        *, active: float, at: float, agent: float, returns: float, back: float
    ) -> Death | None:
        if active < _ACTIVE:
            return None
        return Death(
            agent=1 + _choice(agents, agent),
            at_s=_between(bounds.at_s, at),
            back_after_s=_between(bounds.back_after_s, back) if returns > _ACTIVE else None,
        )

    return [
        Slot(
            {"active": _SEVERE, "at": _MILD, "agent": _MILD, "returns": _MILD, "back": _MILD}, event
        )
    ] * bounds.count


def _links(bounds: LinksBounds, _: int) -> list[Slot]:
    def event(*, delay: float, jitter: float, loss: float) -> Links | None:
        links = Links(
            delay_s=_between(bounds.delay_s, delay),
            jitter_s=_between(bounds.jitter_s, jitter),
            loss=_between(bounds.loss, loss),
        )
        return links if any([links.delay_s, links.jitter_s, links.loss]) else None

    return [Slot({"delay": _SEVERE, "jitter": _SEVERE, "loss": _SEVERE}, event)]


def _gusts(bounds: GustsBounds, _: int) -> list[Slot]:
    def event(*, speed: float, seed: float) -> Gusts | None:
        speed_mps = _between(bounds.speed_mps, speed)
        return Gusts(speed_mps=speed_mps, seed=_choice(_SEEDS, seed)) if speed_mps else None

    return [Slot({"speed": _SEVERE, "seed": _MILD}, event)]


def _mass(bounds: MassBounds, _: int) -> list[Slot]:
    def event(*, mass: float, lag: float) -> ModelError | None:
        error = ModelError(
            mass_factor=_between(bounds.mass_factor, mass),
            motor_lag_s=_between(bounds.motor_lag_s, lag),
        )
        return error if error != ModelError() else None

    return [Slot({"mass": _MILD, "lag": _SEVERE}, event)]


def _sensors(bounds: SensorsBounds, _: int) -> list[Slot]:
    def event(*, factor: float, seed: float) -> SensorsOff:
        return SensorsOff(factor=_between(bounds.factor, factor), seed=_choice(_SEEDS, seed))

    return [Slot({"factor": _SEVERE, "seed": _MILD}, event)]


def _targets(bounds: TargetsBounds, _: int) -> list[Slot]:
    def event(
        *, active: float, at: float, distance: float, azimuth: float, elevation: float
    ) -> TargetEvent | None:
        if active < _ACTIVE:
            return None
        away_m = _between(bounds.distance_m, distance)
        angle = 2.0 * np.pi * azimuth
        up = elevation - 0.5
        level = np.sqrt(1.0 - up**2)
        offset_I = away_m * np.array([level * np.cos(angle), level * np.sin(angle), -up])
        x, y, z = (round(float(value), 3) for value in offset_I)

        return TargetEvent(at_s=_between(bounds.at_s, at), offset_m=(x, y, z))

    return [
        Slot(
            {
                "active": _SEVERE,
                "at": _MILD,
                "distance": _MILD,
                "azimuth": _MILD,
                "elevation": _MILD,
            },
            event,
        )
    ] * bounds.count


def _team(bounds: TeamBounds, _: int) -> list[Slot]:
    def event(*, seed: float) -> DrawnTeam | None:
        return DrawnTeam(seed=_choice(bounds.seeds, seed))

    return [Slot({"seed": _MILD}, event)]


_SLOTS: dict[str, Callable[[Any, int], list[Slot]]] = {
    "silence": _silences,
    "deaths": _deaths,
    "links": _links,
    "gusts": _gusts,
    "mass": _mass,
    "sensors": _sensors,
    "targets": _targets,
    "team": _team,
}
