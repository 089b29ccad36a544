"""Names of processes, as messages, keys, certificates and the command line use them."""

import re

# Largest id of a UAV or an agent.
MAX_UAVS = 256

COORDINATOR = "coordinator"
PLANT = "plant"
# Role of every process called agent1, agent2, ...
AGENT = "agent"
# Records a run and takes no other part in it.
RECORDER = "recorder"
# Only reads: publishes nothing and declares no token, so no process of the run knows of it.
WATCHER = "watcher"
# A watcher that also asks for changes: links, faults.
OPERATOR = "operator"
# Forwards messages where hosts do not reach each other.
ROUTER = "router"

_NAME = re.compile(rf"{COORDINATOR}|{PLANT}|{RECORDER}|{AGENT}[1-9][0-9]{{0,2}}")


def agent_name(agent: int) -> str:
    """Return the process name of an agent, such as "agent2"."""
    return f"{AGENT}{agent}"


def is_name(value: object) -> bool:
    """Return whether a value is the name of a process that sends messages."""
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def role_of(name: str) -> str:
    """Return the role of a process: its name, or `AGENT` for every agent."""
    return AGENT if name.startswith(AGENT) else name
