"""Algorithms of the arena: those of the project, and classes of the user that enter it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from transport.experiments.cases import ExperimentError
from transport.model.section import Section
from transport.protocol.scenario.sections.scenario_errors import (
    ScenarioError,
    dotted_key,
    validated,
)
from transport.protocol.scenario.user_class.user_errors import OwnClassError, errors_of
from transport.protocol.scenario.user_class.user_import import own_class, version_of
from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO

# Keys of the controller that an entry may not set, as they make the task the same for all algorithms.
# All others are the algorithm's own: how it predicts, estimates, solves and exchanges plans, and how
# far ahead. What these cost is measured, as processor time and bytes.
_OF_TASK = (
    *("weights", "cost"),  # the measured cost
    *("limits", "inputs", "rate_time_constant_s"),  # what the vehicles can do
    *("separation", "tilt", "tension", "constraint"),  # what a plan has to keep to
    "sampling_period_s",  # how often an agent may act
)
_CONTROLLER = "controller."

# Reference of all costs: one agent for all UAVs, the paper's program.
REFERENCE = "centralized"

_CLOSED_LOOP = (
    "controller.received_plans=by_age",
    "controller.prediction=closed_loop",
    "controller.linearisation=along",
    "controller.fail_safe=follow",
    "controller.terminal=riccati",
    "controller.preview=true",
)


class Entry(Section):
    """Attribute `arena` of a class that enters the arena, a dictionary."""

    tuned: str = "not stated"
    """for which task and network its parameters were chosen"""
    settings: list[str] = []  # noqa: RUF012  # pydantic copies it
    """keys of `[controller]` that it needs, as for `--set`"""
    centralized: bool = False
    """whether one object controls all UAVs, on a perfect network"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Algorithm:
    """An algorithm of the arena."""

    name: str
    settings: tuple[str, ...] = ()
    tuned: str
    version: str = ""  # of a class of the user
    centralized: bool = False

    def settings_for(self, uavs: int) -> tuple[str, ...]:
        """Return its settings for a team of some size."""
        if not self.centralized:
            return self.settings
        return (*self.settings, f"agents.owned=[{list(range(1, uavs + 1))}]")


BUILT_IN: Mapping[str, Algorithm] = {
    one.name: one
    for one in (
        Algorithm(
            name=REFERENCE,
            centralized=True,
            tuned="weights, limits and horizon of all tasks were chosen with it and `paper`, on "
            "`maneuver`",
        ),
        Algorithm(
            name="centralized_lq",
            settings=_CLOSED_LOOP,
            centralized=True,
            tuned="nothing: the cost-to-go follows from the weights",
        ),
        Algorithm(name="paper", tuned="as `centralized`; the algorithm is as published"),
        Algorithm(
            name="resilient",
            settings=(*_CLOSED_LOOP, "controller.relaxation=0.5"),
            tuned="the relaxation, on the paper's maneuver on late networks with other weights, "
            "those of the scenario resilient",
        ),
        Algorithm(
            name="alone",
            settings=(*_CLOSED_LOOP, "agents.controller=alone"),
            tuned="gains by hand, in gusts and after deaths, for teams of 3 to 8 UAVs",
        ),
    )
}


def entered(name: str) -> Algorithm:
    """Return the algorithm of a class "package.module:Class", which may have an attribute `arena`.

    Raises: ExperimentError: it is not found, or its entry is refused.
    """
    try:
        found = own_class(name)
        version = version_of(found)
        with errors_of("its attribute arena"):
            given = getattr(found, "arena", {})
    except OwnClassError as error:
        raise ExperimentError(f"--controller {name}: {error}", EXIT_SCENARIO) from error

    entry = _entry_of(name, given)
    return Algorithm(
        name=name,
        settings=(f"agents.controller={name}", *entry.settings),
        tuned=entry.tuned,
        version=version,
        centralized=entry.centralized,
    )


def _entry_of(name: str, given: Any) -> Entry:
    """Return the entry of a class. Raises: ExperimentError: it is refused."""
    try:
        entry = validated(Entry, given, f"--controller {name}: arena")
    except ScenarioError as error:
        raise ExperimentError(str(error), EXIT_SCENARIO) from error

    for setting in entry.settings:
        key = dotted_key(setting)
        part = key.removeprefix(_CONTROLLER).partition(".")[0]
        if not key.startswith(_CONTROLLER) or part in _OF_TASK:
            expected = "expected keys of [controller] that are not the task's"
            raise ExperimentError(
                f"--controller {name}: arena.settings: {expected}, got {key}", EXIT_SCENARIO
            )
    return entry


def algorithms_of(controllers: Sequence[str]) -> dict[str, Algorithm]:
    """Return the algorithms of the project, then classes of the user, by name."""
    return {**BUILT_IN, **{name: entered(name) for name in controllers}}
