"""Command line and systemd unit of each process of a deployment."""

import importlib.resources
import shlex
from collections.abc import Sequence
from pathlib import Path
from string import Template

from transport.deploy.inventory import Inventory
from transport.deploy.placements import Placement
from transport.protocol.network.parent import ENVIRONMENT
from transport.protocol.scenario.sections.vehicles_section import DEFAULT_VEHICLE_PORT
from transport.protocol.wire.key_expressions import RECORDER, ROUTER
from transport.protocol.wire.names import AGENT, COORDINATOR, VEHICLE, role_of

# Paths on a host, as install.sh makes them.
ETC = Path("/etc/transport")
PROGRAM = Path("/opt/transport/bin/transport")
TEMPLATES = importlib.resources.files("transport.deploy") / "templates"
# Roles of the processes that are restarted, as they can rejoin the run.
_RESTARTED = (AGENT, VEHICLE, ROUTER)


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
    host = placement.host
    name = placement.process
    role = role_of(name)
    flies = any(role_of(one) == VEHICLE for each in inventory.host for one in each.runs)
    is_restarted = role in _RESTARTED or (role == COORDINATOR and takes_over)
    # A coordinator whose run has ended starts no other one by itself.
    ends = "2 3 4 5 6 7 130" if role == COORDINATOR else "2 3 5 6 7 130"
    # It lands the team first, and waits for its release.
    stops_s = "infinity" if role == COORDINATOR and flies else "10"
    devices = ["PrivateDevices=yes"]
    if role == VEHICLE and (host.autopilot or "").startswith("serial:"):
        device = (host.autopilot or "").removeprefix("serial:")
        devices = [f"DeviceAllow={device} rw", "SupplementaryGroups=dialout"]
    scheduling = []
    if name in host.cpus:
        scheduling.append(f"CPUAffinity={' '.join(map(str, host.cpus[name]))}")
    if host.priority:
        scheduling += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]

    others = [f"transport-{other}.service" for other in after]
    environment = [f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()]
    template = Template((TEMPLATES / "process.service").read_text(encoding="utf-8"))
    return template.substitute(
        name=name,
        run=inventory.run,
        after=" ".join(["network-online.target", *others]),
        environment="\n".join(environment),
        command=shlex.join(command(placement, inventory, etc=etc)),
        restart="on-failure" if is_restarted else "no",
        ends=ends,
        stops_s=stops_s,
        devices="\n".join(devices),
        scheduling="\n".join(scheduling),
    )


def command(
    placement: Placement, inventory: Inventory, program: Path = PROGRAM, etc: Path = ETC
) -> list[str]:
    """Return the command line of a process.

    `program` is `transport` on its host, `etc` the folder of its scenario.
    """
    name = placement.process
    role = [name]
    if role_of(name) == AGENT:
        role = [AGENT, "--id", name.removeprefix(AGENT)]
    if role_of(name) == VEHICLE:
        uav = name.removeprefix(VEHICLE)
        usual = f"udp:127.0.0.1:{DEFAULT_VEHICLE_PORT + int(uav) - 1}"
        role = [VEHICLE, "--uav", uav, "--link", placement.host.autopilot or usual]
        role += ["--pose", placement.host.pose] if placement.host.pose else []
        role += ["--key", placement.host.key] if placement.host.key else []
        role += ["--stands"] if placement.host.stands else []
    if name == RECORDER:
        role = ["record", "--no-figures"]
    line = [str(program), *role, "--scenario", str(etc / "scenario.toml")]
    # The size of the run is checked when its folders are rendered.
    line += [] if name == ROUTER else ["--allow-large", "--run", inventory.run]
    line += [part for endpoint in placement.endpoints.listen for part in ("--listen", endpoint)]
    if placement.endpoints.mode != "client":  # otherwise the host's scenario names the router
        line += [
            part for endpoint in placement.endpoints.connect for part in ("--connect", endpoint)
        ]
    if name == COORDINATOR and inventory.hosts_of(RECORDER):
        line += ["--observer", RECORDER]
    return line
