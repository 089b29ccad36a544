"""Process of an agent."""

import time

from agent.node import AgentNode
from protocol.network.parent import stand_by
from protocol.network.process import Place, run_node
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.messages import agent_name
from protocol.wire.names import COORDINATOR, PLANT


def run(setup: Setup, place: Place, agent: int) -> int:
    """Control the UAVs of an agent, 1-based, until the run ends; see `protocol.network.process.run_node`."""
    node = AgentNode(setup, agent, place.incarnation, time.perf_counter_ns)
    node.warm_up()
    if not stand_by():
        return EXIT_UNREACHABLE
    others = [agent_name(other) for other in setup.agents if other != agent]
    return run_node(node, place, setup, [COORDINATOR, PLANT, *others])
