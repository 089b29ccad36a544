"""Process of the plant."""

from plant.node import PlantNode
from protocol.network.process import Place, run_node
from protocol.scenario.setup import Setup
from protocol.wire.messages import agent_name
from protocol.wire.names import COORDINATOR


def run(setup: Setup, place: Place) -> int:
    """Simulate the plant until the run ends; see `protocol.network.process.run_node`."""
    node = PlantNode(setup, place.incarnation)
    node.engine.warm_up(setup)
    return run_node(node, place, setup, [COORDINATOR, *[agent_name(agent) for agent in setup.agents]])
