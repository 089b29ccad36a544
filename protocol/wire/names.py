"""Names of processes, as messages, keys, certificates and the command line use them."""

import re

MAX_UAVS = 256  # largest id of a UAV or an agent

COORDINATOR = "coordinator"
PLANT = "plant"
AGENT = "agent"  # role of every process called agent1, agent2, ...
RECORDER = "recorder"  # records a run and takes no other part in it
# Only reads: publishes nothing and declares no token, so no process of the run knows of it.
WATCHER = "watcher"
OPERATOR = "operator"  # a watcher that also asks for changes: links, faults, targets
ROUTER = "router"  # forwards messages where hosts do not reach each other

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
