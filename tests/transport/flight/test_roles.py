"""Roles made of values: an agent, a plant and a coordinator of a run that no scenario describes."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from transport.agent.node import AgentNode
from transport.coordinator.node import CoordinatorNode
from transport.coordinator.team_view import TeamView
from transport.model.linear.linearisation import Model
from transport.model.path.hover_reference import HoverReference as HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import hover
from transport.model.physics.parameters import Payload, System, Uav
from transport.mpc.reference import Reference
from transport.plant.node import PlantNode
from transport.plant.plant_run import PlantRun
from transport.protocol.scenario.sections.link_sections import LinksSection
from transport.protocol.scenario.sections.lockstep_and_realtime_section import ClockSection
from transport.protocol.scenario.sections.plant_sections import PlantSection
from transport.protocol.scenario.sections.schema import (
    ControllerSection,
    PayloadSection,
    SystemSection,
    UavSection,
)
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.setup.collisions import Contacts
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.scenario.setup.team_run import Knowledge, SensorSheet, TeamOnPath, TeamRun
from transport.protocol.wire.messages import Message, PlantState, Presence, Target
from transport.protocol.wire.names import PLANT
from transport.protocol.wire.node_interface import Node, RunShape

TICKS = 4
PERIOD_S = 0.05
MASS_KG = 1.0
INERTIA = [0.02, 0.02, 0.03]
CORNERS_M = ((0.5, 0.0, 0.0), (-0.25, 0.4, 0.0), (-0.25, -0.4, 0.0))
ROD_M = 2.0
STILL = 1e-6  # largest deviation from hover: the equilibrium's and the solver's rounding


class NoTargets:
    """Timing of targets in a run that has none."""

    def fields(self, wanted: Any, tick: int) -> dict[str, Any]:
        """Return nothing, never."""
        raise AssertionError(wanted, tick)

    def follow(self, target: Target) -> None:
        """Follow nothing, never."""
        raise AssertionError(target)


def run_of_three() -> TeamRun:
    """Return three UAVs that hover with a payload for a few ticks, each with an agent of its own."""
    uavs = [
        Uav(mass=MASS_KG, inertia=INERTIA, rho=corner, rod_length=ROD_M) for corner in CORNERS_M
    ]
    system = System(payload=Payload(mass=1.5, inertia=[0.1, 0.1, 0.2]), uavs=uavs)
    at_rest = hover(system)
    settings = ControllerSection(sampling_period_s=PERIOD_S, horizon=5)
    phase = Phase(name="hover", duration_s=TICKS * PERIOD_S, displacement_I=np.zeros(3))
    path = HoverReference(system, at_rest, Maneuver(start_I=np.zeros(3), phases=[phase]))
    shape = RunShape(
        owned={agent: (agent,) for agent in (1, 2, 3)},
        limits={agent: (settings.lower(1), settings.upper(1)) for agent in (1, 2, 3)},
        uavs=3,
        ticks=TICKS,
        period_s=PERIOD_S,
        delay=0,
        negotiation_iterations=1,
        vehicle_sensors=False,
        relayed=True,
    )
    sensors = SensorSheet(vehicle=False, noise=np.zeros(5), bias=np.zeros(5), ages=(0,) * 5)
    return TeamRun(
        rules=RunRules(
            name="three", digest="", shape=shape, seed=0, clock=ClockSection(), links=LinksSection()
        ),
        team=TeamOnPath(
            system=system,
            hover=at_rest,
            model=Model(system),
            reference=Reference(path, PERIOD_S, TICKS + settings.horizon + 2),
        ),
        known=Knowledge(settings=settings, sensors=sensors, controllers=("mpc",) * 3),
    )


def coordinator(run: TeamRun) -> CoordinatorNode:
    """Return its coordinator."""
    contacts = Contacts(run.positions_I, [0.0] * 3, (), PERIOD_S)
    view = TeamView(
        targets=NoTargets(),
        contacts=contacts,
        failed_share=0.0,
        initial_state=run.initial_state(),
    )
    return CoordinatorNode(run.rules, view)


def plant(run: TeamRun) -> PlantNode:
    """Return its plant, whose bodies are as the controllers assume them."""
    bodies = SystemSection(
        payload=PayloadSection(mass_kg=1.5, inertia_kgm2=[0.1, 0.1, 0.2]),
        uav=[
            UavSection(
                id=number, mass_kg=MASS_KG, inertia_kgm2=INERTIA, rho_m=corner, rod_length_m=ROD_M
            )
            for number, corner in enumerate(CORNERS_M, start=1)
        ],
    )
    return PlantNode(
        PlantRun(run=run, section=PlantSection(), bodies=bodies, vehicles=VehiclesSection())
    )


def conducted(nodes: Mapping[str, Node]) -> list[Message]:
    """Deliver all messages to all other nodes until none is left; return them in order."""
    sent: list[Message] = []
    waiting: deque[Message] = deque()
    for name in nodes:
        if name != "coordinator":
            waiting += nodes["coordinator"].receive(Presence(name, 0, alive=True), 0)
    while waiting:
        message = waiting.popleft()
        sent.append(message)
        for name, node in nodes.items():
            if name != message.sender and name in receivers(message, nodes):
                waiting += node.receive(message, 0)
    return sent


def receivers(message: Message, nodes: Mapping[str, Node]) -> set[str]:
    """Return the nodes that subscribe to a message."""
    addressed = getattr(message, "agent", None) if message.kind == "measurement" else None
    return {f"agent{addressed}"} if addressed is not None else set(nodes)


@pytest.mark.parametrize("make", [coordinator, plant, lambda run: AgentNode(run, 2)])
def test_a_role_is_made_of_values(make: Callable[[TeamRun], Node]) -> None:
    """Each role takes the parts of a run that it uses, and no scenario."""
    node = make(run_of_three())
    assert node.finished is None


def test_roles_of_values_conduct_a_run() -> None:
    """Three agents, a plant and a coordinator hold the team at hover until the run is completed."""
    run = run_of_three()
    agents: list[Node] = [AgentNode(run, agent) for agent in run.rules.agents]
    team: list[Node] = [coordinator(run), plant(run), *agents]
    nodes = {node.name: node for node in team}
    sent = conducted(nodes)
    states = [message for message in sent if isinstance(message, PlantState)]
    assert [state.tick for state in states] == list(range(TICKS))
    np.testing.assert_allclose(states[-1].x, run.initial_state(), atol=STILL)
    assert [node.finished.outcome for node in nodes.values() if node.finished] == ["completed"] * 5
    assert nodes[PLANT].finished is not None
