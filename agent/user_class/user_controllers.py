"""Controllers of the user before a run: each is started once, for its version and the size of its plans."""

from collections.abc import Iterator

from transport.agent.user_class.user_planner import OwnPlanner
from transport.protocol.scenario.radio.radio_parameters import PlanShape, is_class
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.scenario.user_class.user_errors import OwnClassError
from transport.protocol.scenario.user_class.user_import import own_class, version_of


def checked_controller(setup: TeamRun) -> str:
    """Return names and versions of the controllers after starting each once, in the order of agents.

    One that several agents have is named once, and started for the first of them.

    Raises: ScenarioError: one of them cannot be used.
    """
    for planner in _own_planners(setup):
        planner.stop()
    names = dict.fromkeys(setup.known.controllers)
    try:
        return ", ".join(f"{name} {controller_version(name)}".rstrip() for name in names)
    except OwnClassError as error:
        raise ScenarioError(setup.rules.name, "agents.controller", str(error)) from error


def controller_version(name: str) -> str:
    """Return the version of a controller, empty for those of the project.

    Raises: OwnClassError: it is not found, or its version is no text.
    """
    return version_of(own_class(name)) if is_class(name) else ""


def controller_versions(scenario: Scenario) -> str:
    """Return the versions of the controllers of a run, in the order of agents.

    Raises: OwnClassError: one is not found.
    """
    return " ".join(map(controller_version, dict.fromkeys(scenario.controllers))).strip()


def _own_planners(setup: TeamRun) -> Iterator[OwnPlanner]:
    """Yield a planner of each class of the user that is a controller of the run.

    Raises: ScenarioError: one cannot be used.
    """
    controllers = setup.known.controllers
    for name in dict.fromkeys(filter(is_class, controllers)):
        yield OwnPlanner(setup, controllers.index(name) + 1, lambda: 0)


def plan_shapes(setup: TeamRun) -> dict[str, PlanShape]:
    """Return the shapes that plans of a run have, the smallest first, by what tells them apart.

    A class of the user returns the inputs of one tick, or of more up to the horizon, with the data
    that it declares as it starts. Raises: ScenarioError: the class cannot be used.
    """
    data = []
    for planner in _own_planners(setup):
        planner.stop()
        data.append(planner.data_numbers)
    least = PlanShape.of(setup)
    if not data:
        return {"": least}
    horizon = setup.settings.horizon
    return {
        "with the inputs of one tick ": least | PlanShape(data=max(data)),
        "with those of the horizon ": least | PlanShape(inputs=horizon, data=max(data)),
    }
