"""The coordinator as a process."""

from collections.abc import Sequence

from coordinator.node import CoordinatorNode
from protocol.network.process import Place, run_node
from protocol.scenario.setup import Setup
from protocol.wire.messages import agent_name


def run(setup: Setup, place: Place, observers: Sequence[str] = ()) -> int:
    """Coordinate a run until it ends.

    Args:
        setup: The run.
        place: Place of this process in the run.
        observers: Processes besides plant and agents that must be ready before the first tick.
    Returns: Exit code.
    Raises: BusError: see `protocol.network.process.run_node`.
    """
    node = CoordinatorNode(setup, place.incarnation, observers)
    team = ["plant", *[agent_name(agent) for agent in setup.agents]]
    return run_node(node, place, setup, [*team, *observers], node.interrupt, [*team, *observers])
