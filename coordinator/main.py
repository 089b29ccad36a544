"""The coordinator as a process."""

from collections.abc import Sequence

from coordinator.node import CoordinatorNode
from protocol.network.process import Place, run_node
from protocol.scenario.setup import Setup
from protocol.wire.messages import agent_name
from protocol.wire.names import PLANT


def run(setup: Setup, place: Place, observers: Sequence[str] = ()) -> int:
    """Coordinate a run until it ends; see `CoordinatorNode` and `protocol.network.process.run_node`."""
    node = CoordinatorNode(setup, place.incarnation, observers)
    team = [PLANT, *[agent_name(agent) for agent in setup.agents]]
    return run_node(node, place, setup, [*team, *observers], node.interrupt, [*team, *observers])
