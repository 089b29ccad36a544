"""Command line and systemd unit of each process of a deployment."""

import importlib.resources
import shlex
from collections.abc import Sequence
from pathlib import Path
from string import Template

from transport.deploy.inventory import Host, Inventory
from transport.deploy.placements import Placement
from transport.protocol.network.parent_and_environment import ENVIRONMENT
from transport.protocol.scenario.sections.vehicles_section import DEFAULT_VEHICLE_PORT
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.key_expressions import RECORDER, ROUTER
from transport.protocol.wire.names import AGENT, COORDINATOR, VEHICLE, role_of

# Paths on a host, as install.sh makes them.
ETC = Path("/etc/transport")
PROGRAM = Path("/opt/transport/bin/transport")
TEMPLATES = importlib.resources.files("transport.deploy") / "templates"
# Roles of the processes that are restarted, as they can rejoin the run.
_RESTARTED = (AGENT, VEHICLE, ROUTER)
# Ends of a process after which it is not started again: its run has ended, or its options are refused.
_FINAL_CODES = (
    codes.EXIT_USAGE,
    codes.EXIT_SCENARIO,
    codes.EXIT_OVERRUN,
    codes.EXIT_DIVERGED,
    codes.EXIT_FAILED,
    codes.EXIT_COLLIDED,
    codes.EXIT_INTERRUPTED,
)
_STOP_S = "10"  # time for a process to end
_SERIAL = "serial:"  # beginning of the link to an autopilot at a device of the host


def unit(
    placement: Placement,
    inventory: Inventory,
    after: Sequence[str],
    etc: Path = ETC,
    *,
    takes_over: bool = False,
) -> str:
    """Return the systemd unit of a process.

    The process starts after the processes `after` of its host, and is stopped before them. `etc`
    is the folder of its scenario. With `takes_over` a coordinator that crashed is started again.
    """
    others = [f"transport-{other}.service" for other in after]
    environment = [f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()]
    template = Template((TEMPLATES / "process.service").read_text(encoding="utf-8"))
    return template.substitute(
        name=placement.process,
        run=inventory.run,
        after=" ".join(["network-online.target", *others]),
        environment="\n".join(environment),
        command=shlex.join(command(placement, inventory, etc=etc)),
        **_ends(role_of(placement.process), inventory, takes_over=takes_over),
        devices="\n".join(_devices(placement)),
        scheduling="\n".join(_scheduling(placement)),
    )


def _ends(role: str, inventory: Inventory, *, takes_over: bool) -> dict[str, str]:
    """Return whether systemd restarts a process of a role, after which exit codes not, and its time to stop."""
    is_coordinator = role == COORDINATOR
    is_restarted = role in _RESTARTED or (is_coordinator and takes_over)
    final = set(_FINAL_CODES)
    stop_s = _STOP_S
    if is_coordinator:
        # With its peers its run is gone: it starts no other one by itself. An agent rejoins a run that goes on.
        final.add(codes.EXIT_UNREACHABLE)
    if is_coordinator and _has_vehicles(inventory):
        stop_s = "infinity"  # it lands the team first, and waits for its release
    return {
        "restart": "on-failure" if is_restarted else "no",
        "ends": " ".join(map(str, sorted(final))),
        "stops_s": stop_s,
    }


def _has_vehicles(inventory: Inventory) -> bool:
    """Return whether a process of the deployment flies a UAV."""
    return any(role_of(name) == VEHICLE for host in inventory.host for name in host.runs)


def _devices(placement: Placement) -> list[str]:
    """Return the lines about devices of the host: none but that of a vehicle's autopilot."""
    link = placement.host.autopilot or ""
    if role_of(placement.process) != VEHICLE or not link.startswith(_SERIAL):
        return ["PrivateDevices=yes"]
    return [f"DeviceAllow={link.removeprefix(_SERIAL)} rw", "SupplementaryGroups=dialout"]


def _scheduling(placement: Placement) -> list[str]:
    """Return the lines about processors and priority, as far as the inventory gives them."""
    host = placement.host
    lines = []
    if placement.process in host.cpus:
        lines.append(f"CPUAffinity={' '.join(map(str, host.cpus[placement.process]))}")
    if host.priority:
        lines += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]
    return lines


def command(
    placement: Placement, inventory: Inventory, program: Path = PROGRAM, etc: Path = ETC
) -> list[str]:
    """Return the command line of a process.

    `program` is `transport` on its host, `etc` the folder of its scenario.
    """
    name = placement.process
    endpoints = placement.endpoints
    line = [str(program), *_role_command(placement), "--scenario", str(etc / "scenario.toml")]
    if name != ROUTER:
        # The size of the run is checked when its folders are rendered.
        line += ["--allow-large", "--run", inventory.run]
    for endpoint in endpoints.listen:
        line += ["--listen", endpoint]
    if endpoints.mode != "client":  # otherwise the host's scenario names the router
        for endpoint in endpoints.connect:
            line += ["--connect", endpoint]
    if name == COORDINATOR and inventory.hosts_of(RECORDER):
        line += ["--observer", RECORDER]
    return line


def _role_command(placement: Placement) -> list[str]:
    """Return the command of `transport` for a process, with the options of its role."""
    name = placement.process
    role = role_of(name)
    if role == AGENT:
        return [AGENT, "--id", name.removeprefix(AGENT)]
    if role == VEHICLE:
        return _vehicle_command(placement.host, int(name.removeprefix(VEHICLE)))
    if role == RECORDER:
        return ["record", "--no-figures"]
    return [name]


def _vehicle_command(host: Host, uav: int) -> list[str]:
    """Return the command of the process of a UAV, 1-based, with the links to its autopilot."""
    usual = f"udp:127.0.0.1:{DEFAULT_VEHICLE_PORT + uav - 1}"
    line = [VEHICLE, "--uav", str(uav), "--link", host.autopilot or usual]
    for option, value in (("--pose", host.pose), ("--key", host.key)):
        if value:
            line += [option, value]
    return [*line, "--stands"] if host.stands else line
