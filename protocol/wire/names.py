"""Names of processes, as messages, keys, certificates and the command line use them."""

import re
from collections.abc import Collection

MAX_UAVS = 256  # largest id of a UAV or an agent

COORDINATOR = "coordinator"
PLANT = "plant"
AGENT = "agent"  # role of every process called agent1, agent2, ...
VEHICLE = "vehicle"  # role of every process called vehicle1, ..., of UAV 1, ...
RECORDER = "recorder"  # records a run and takes no other part in it
# Only reads: publishes nothing and declares no token, so no process of the run knows of it.
WATCHER = "watcher"
OPERATOR = "operator"  # a watcher that also asks for changes: links, faults, targets
ROUTER = "router"  # forwards messages where hosts do not reach each other

_NAME = re.compile(rf"{COORDINATOR}|{PLANT}|{RECORDER}|({AGENT}|{VEHICLE})[1-9][0-9]{{0,2}}")


def agent_name(agent: int) -> str:
    """Return the process name of an agent, such as "agent2"."""
    return f"{AGENT}{agent}"


def agent_names(agents: Collection[int]) -> str:
    """Return the process names of agents as text, ascending."""
    return ", ".join(agent_name(agent) for agent in sorted(agents))


def vehicle_name(uav: int) -> str:
    """Return the process name of a UAV, 1-based, such as "vehicle2"."""
    return f"{VEHICLE}{uav}"


def is_name(value: object) -> bool:
    """Return whether a value is the name of a process that sends messages."""
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def role_of(name: str) -> str:
    """Return the role of a process: its name, or `AGENT` for every agent, `VEHICLE` for every UAV."""
    return next((role for role in (AGENT, VEHICLE) if name.startswith(role)), name)
