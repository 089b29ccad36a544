"""Nodes of a run, made of its setup: each role takes the part that it uses."""

from collections.abc import Sequence

from transport.coordinator.node import CoordinatorNode
from transport.coordinator.team_view import TeamView
from transport.plant.plant_run import HiddenObstacle, PlantRun
from transport.protocol.scenario.sections.limits_on_size import maneuver_ticks
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_messages import TargetTiming, scripted


def coordinator_of(
    setup: Setup,
    incarnation: int = 0,
    observers: Sequence[str] = (),
    wall_offset_ns: int = 0,
) -> CoordinatorNode:
    """Return the coordinator of a run."""
    return CoordinatorNode(setup.rules, team_view(setup), incarnation, observers, wall_offset_ns)


def plant_run(setup: Setup) -> PlantRun:
    """Return a run as its plant sees it."""
    scenario = setup.scenario
    return PlantRun(
        run=setup.run,
        section=scenario.plant,
        bodies=scenario.system,
        vehicles=scenario.vehicles,
        hidden=tuple(
            HiddenObstacle(number=number, obstacle=obstacle, seen_within_m=section.seen_within_m)
            for number, (section, obstacle) in enumerate(
                zip(scenario.obstacle, setup.obstacles, strict=True), start=1
            )
            if section.seen_within_m is not None
        ),
    )


def team_view(setup: Setup) -> TeamView:
    """Return the team of a run as its coordinator sees it."""
    scenario = setup.scenario
    radio = None
    if scenario.radio is not None:
        # Most runs start without.
        from transport.protocol.scenario.radio.team_radio import TeamRadio

        radio = TeamRadio(setup.run, scenario.radio)
    x = setup.initial_state()
    return TeamView(
        targets=TargetTiming(setup),
        scripted_targets=scripted(setup),
        contacts=setup.contacts(),
        ends_by_contact=scenario.plant.on_collision == "end",
        failed_share=scenario.agents.failed_share,
        radio=radio,
        initial_state=x,
        vehicles=scenario.vehicles if scenario.has_vehicles else None,
        lands_at=None if scenario.has_plant else maneuver_ticks(scenario),
        places_I=setup.model.sensed(x, setup.hover.u).reshape(-1, 15)[:, :3],
    )
