r"""A laboratory of several hosts on one machine.

Network namespaces on a switch, with cables that can be cut.

    python -m tests.support.lab --set clock.mode=realtime --set clock.speed=1 \
        --cut agent2:8:1 --out lab

Each process of the run, recorder included, has its own host and runs from the folders that
`transport deploy render` writes. The lab is in its own network, process and mount namespace: when
its first process ends, for any reason, the kernel ends all other processes in it and removes the
network.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from transport.deploy.folders import render
from transport.deploy.inventory import DeployError, Host, Inventory
from transport.deploy.placements import Placement, placements
from transport.deploy.units import command
from transport.protocol.network.mesh import process_names
from transport.protocol.network.parent_and_environment import ENVIRONMENT, python
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_INTERRUPTED,
    EXIT_SCENARIO,
    EXIT_USAGE,
)
from transport.protocol.wire.key_expressions import RECORDER

EXIT_UNAVAILABLE, EXIT_TIMEOUT = 69, 70

# Set in the environment of the process inside the namespaces.
_INSIDE = "PAYLOAD_TRANSPORT_LAB"
_TOOLS = ("unshare", "nsenter", "ip")
_NAMESPACES = ("--net", "--pid", "--fork", "--kill-child", "--mount-proc")
_SWITCH = "switch"
_POLL_S = 0.02


class LabError(RuntimeError):
    """The lab cannot be built or used."""


@dataclass(frozen=True, slots=True)
class Cut:
    """A cut of a host's cable.

    Attributes:
        host: Name of the host.
        at_s: Time since the first tick, s.
        for_s: Duration, s; None for good.
    """

    host: str
    at_s: float
    for_s: float | None

    @staticmethod
    def of(text: str) -> "Cut":
        """Return the cut of `HOST:AT` or `HOST:AT:FOR`.

        Raises: argparse.ArgumentTypeError: the text is neither.
        """
        try:
            host, at_s, for_s = [*text.split(":"), ""][:3] if text.count(":") < 3 else []
            return Cut(host, float(at_s), float(for_s) if for_s else None)
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f"expected HOST:AT or HOST:AT:FOR in seconds, got {text!r}"
            ) from error


class Lab:
    """Hosts on a switch, in the namespaces of this process; they end with it.

    Args:
        hosts: Addresses by name, all of one /24 network.
    """

    def __init__(self, hosts: Mapping[str, str]) -> None:
        self._hosts: dict[str, subprocess.Popen[bytes]] = {}
        _ip("link", "add", _SWITCH, "type", "bridge")
        _ip("link", "set", _SWITCH, "up")
        for number, (name, address) in enumerate(hosts.items()):
            # The holder keeps the host's namespace until the lab ends.
            command = ["unshare", "--net", "sh", "-c", "echo there; exec sleep infinity"]
            holder = subprocess.Popen(command, stdout=subprocess.PIPE)
            if holder.stdout is None or not holder.stdout.readline():
                raise LabError(f"host {name}: no network namespace")
            self._hosts[name] = holder
            cable = self._cable(name)
            _ip(
                "link",
                "add",
                cable,
                "type",
                "veth",
                "peer",
                "name",
                f"eth{number}",
                "netns",
                str(holder.pid),
            )
            _ip("link", "set", cable, "master", _SWITCH, "up")
            for arguments in (
                ("addr", "add", f"{address}/24", "dev", f"eth{number}"),
                ("link", "set", f"eth{number}", "up"),
                ("link", "set", "lo", "up"),
            ):
                subprocess.run([*self._at(name), "ip", *arguments], check=True)

    def start(
        self, host: str, command: Sequence[str], log: Path, cwd: Path
    ) -> subprocess.Popen[bytes]:
        """Start a command on a host, in a folder, with its output in a file."""
        with log.open("wb") as output:
            return subprocess.Popen(
                [*self._at(host), *command],
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **ENVIRONMENT},
            )

    def connect(self, host: str, *, on: bool) -> None:
        """Connect a host's cable to the switch, or cut it."""
        _ip("link", "set", self._cable(host), "up" if on else "down")

    def _cable(self, host: str) -> str:
        return f"port{list(self._hosts).index(host)}"

    def _at(self, host: str) -> list[str]:
        return ["nsenter", f"--net=/proc/{self._hosts[host].pid}/ns/net", "--"]


def unavailable() -> str:
    """Return the reason why this machine cannot have a lab, empty if it can."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"no {missing[0]} (util-linux, iproute2)"
    if find_spec("cryptography") is None:
        return "no package cryptography (pip install 'payload-transport[deploy]')"
    tried = subprocess.run(
        [*_enter(), "ip", "link", "add", "x", "type", "bridge"], capture_output=True, check=False
    )
    error = tried.stderr.decode(errors="replace").strip()
    return "" if tried.returncode == 0 else f"no namespaces here: {error or tried.returncode}"


def one_host_each(processes: Sequence[str], run: str) -> Inventory:
    """Return an inventory with a separate host for each process and the recorder."""
    hosts = [
        Host(name=name, address=f"10.99.0.{number}", runs=[name])
        for number, name in enumerate([*processes, RECORDER], start=1)
    ]
    return Inventory(run=run, host=hosts)


def simulate(setup: Setup, out: Path, cuts: Sequence[Cut], timeout_s: float) -> dict[str, object]:
    """Build the lab, deploy and run; to be called inside the namespaces.

    Args:
        setup: The run.
        out: Folder to create: keys, a folder for each host, logs, and the recorded run in `run`.
        cuts: Cuts of cables.
        timeout_s: Time allowed from the first tick on, s.
    Returns: Exit codes by process (None for those that had to be ended), and the changes of cables.
    Raises: LabError: the lab cannot be built, or the run does not begin.
    """
    # Not at the top: `unavailable` says what it needs.
    from transport.deploy.certificates import LOOPBACK, OTHERS, make_certificates

    processes = process_names(setup.scenario)
    inventory = one_host_each(processes, setup.scenario.name)
    addresses = {host.name: [*LOOPBACK, host.address] for host in inventory.host}
    make_certificates(out / "keys", {**dict.fromkeys(OTHERS, LOOPBACK), **addresses}, days=1)
    render(setup, inventory, out / "keys", out / "hosts", in_place=True)
    lab = Lab({host.name: host.address for host in inventory.host})
    (out / "logs").mkdir()
    running = {}
    with ExitStack() as stack:
        for placement in placements(inventory, processes, "tls"):
            started = lab.start(
                placement.host.name,
                _command(placement, inventory, out),
                out / "logs" / f"{placement.process}.log",
                out,
            )
            stack.callback(started.kill)
            running[placement.process] = started
        begun_s = _wait_for_start(out / "logs" / "coordinator.log", running)
        made = _apply(lab, cuts, begun_s, running, timeout_s)
        exits = {name: started.poll() for name, started in running.items()}
    return {"exits": exits, "cuts": made, "took_s": round(time.monotonic() - begun_s, 3)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = _options().parse_args(arguments)
    if not os.environ.get(_INSIDE):
        reason = unavailable()
        if reason:
            sys.stderr.write(f"lab: {reason}\n")
            return EXIT_UNAVAILABLE
        command = [
            *_enter(),
            sys.executable,
            "-m",
            "tests.support.lab",
            *(sys.argv[1:] if arguments is None else arguments),
        ]
        os.execvpe(command[0], command, {**os.environ, _INSIDE: "1"})  # noqa: S606
    for number in (signal.SIGINT, signal.SIGTERM):  # also when started in the background
        signal.signal(number, signal.default_int_handler)
    out: Path = options.out
    try:
        path = find_scenario(options.scenario)
        setup = Setup.of(read_scenario(path, options.settings), str(path))
        if out.exists():
            raise LabError(f"--out: expected a folder that does not exist yet, got {out}")
        known = [*process_names(setup.scenario), RECORDER]
        for cut in options.cut:
            if cut.host not in known:
                raise LabError(f"--cut: expected a host of {', '.join(known)}, got {cut.host!r}")
        found = simulate(setup, out.resolve(), options.cut, options.timeout)
    except ScenarioError as error:
        sys.stderr.write(f"lab: {error.blaming(options.settings)}\n")
        return EXIT_SCENARIO
    except (LabError, DeployError, subprocess.CalledProcessError) as error:
        sys.stderr.write(f"lab: {error}\n")
        return EXIT_USAGE
    except KeyboardInterrupt:
        sys.stderr.write("lab: interrupted\n")
        return EXIT_INTERRUPTED
    text = json.dumps(found, indent=1)
    (out / "lab.json").write_text(text + "\n", encoding="utf-8")
    sys.stdout.write(text + "\n")
    exits = found["exits"]
    return EXIT_TIMEOUT if isinstance(exits, dict) and None in exits.values() else 0


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.lab", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--scenario", default="resilient", help="scenario file or name")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--cut", type=Cut.of, action="append", default=[], metavar="HOST:AT[:FOR]", help="seconds"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    parser.add_argument(
        "--timeout", type=float, default=120.0, help="seconds from the first tick on"
    )
    return parser


def _enter() -> list[str]:
    """Return the command that enters new namespaces, as root in them only."""
    return ["unshare", *(() if os.geteuid() == 0 else ("--map-root-user",)), *_NAMESPACES]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def _command(placement: Placement, inventory: Inventory, out: Path) -> list[str]:
    """Return the command of a rendered unit, with this environment in place of /opt."""
    _, *rest = command(placement, inventory, etc=out / "hosts" / placement.host.name)
    return [
        *python("transport"),
        *rest,
        *(["--out", "run"] if placement.process == RECORDER else []),
    ]


def _wait_for_start(log: Path, running: Mapping[str, subprocess.Popen[bytes]]) -> float:
    """Wait until the coordinator has met all processes and return the steady-clock time, s.

    Raises: LabError: a process ends before that.
    """
    while '"joined"' not in log.read_text(encoding="utf-8", errors="replace"):
        for name, started in running.items():
            if started.poll() is not None:
                raise LabError(
                    f"{name} ended with exit code {started.returncode} before the run began, see {log.parent}"
                )
        time.sleep(_POLL_S)
    return time.monotonic()


def _apply(
    lab: Lab,
    cuts: Sequence[Cut],
    begun_s: float,
    running: Mapping[str, subprocess.Popen[bytes]],
    timeout_s: float,
) -> list[dict[str, object]]:
    """Cut and mend cables until all processes have ended or the time is over.

    Return the changes with their times.
    """
    due = [(cut.at_s, "cut", cut.host) for cut in cuts]
    due += [(cut.at_s + cut.for_s, "mend", cut.host) for cut in cuts if cut.for_s is not None]
    due.sort(reverse=True)
    made: list[dict[str, object]] = []
    while any(started.poll() is None for started in running.values()):
        now_s = time.monotonic() - begun_s
        if now_s > timeout_s:
            return made
        if due and now_s >= due[-1][0]:
            _, change, host = due.pop()
            lab.connect(host, on=change == "mend")
            made.append({"at_s": round(now_s, 3), "did": change, "host": host})
        time.sleep(_POLL_S)
    return made


if __name__ == "__main__":
    sys.exit(main())
