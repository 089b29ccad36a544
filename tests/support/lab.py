"""A lab of several hosts on one machine: network namespaces on a switch, cables that are cut and mended.

    python -m deploy.lab --scenario resilient --set clock.mode=realtime --set clock.speed=1 --cut agent2:8:1 --out lab

Every process of the run has a host of its own, so has the recorder, and all run from the folders that `transport deploy
render` writes. The whole lab is a network, process and mount namespace of its own: when its first process ends, of
Ctrl-C or however, the kernel ends all that is left in it and takes the network back. Nothing has to be cleaned up.
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
from pathlib import Path
from types import FrameType

from deploy.hosts import Host, Inventory, Posting, postings
from deploy.keys import LOOPBACK, OTHERS, KeysError, make_certificates
from deploy.render import RenderError, command, render
from protocol.network.parent import ENVIRONMENT, python
from protocol.network.process import process_names
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_SCENARIO, EXIT_USAGE
from protocol.wire.keys import RECORDER

EXIT_UNAVAILABLE, EXIT_TIMEOUT = 69, 70

# In the environment of the process that is already inside.
_INSIDE = "PAYLOAD_TRANSPORT_LAB"
_TOOLS = ("unshare", "nsenter", "ip")
_WORLD = ("--net", "--pid", "--fork", "--kill-child", "--mount-proc")
_SWITCH = "switch"
_POLL_S = 0.02


class LabError(RuntimeError):
    """The lab cannot be built or used."""


@dataclass(frozen=True, slots=True)
class Cut:
    """A cable that is taken out.

    Attributes:
        host: Whose.
        at_s: When, of the flight.
        for_s: For how long, or None for good.
    """

    host: str
    at_s: float
    for_s: float | None

    @staticmethod
    def of(text: str) -> "Cut":
        """From `HOST:AT` or `HOST:AT:FOR`.

        Raises: argparse.ArgumentTypeError: it is neither.
        """
        try:
            host, at_s, for_s = [*text.split(":"), ""][:3] if text.count(":") < 3 else []
            return Cut(host, float(at_s), float(for_s) if for_s else None)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"expected HOST:AT or HOST:AT:FOR in seconds, got {text!r}") from error


class Lab:
    """Hosts on a switch, within the namespaces of this process; they end with it.

    Args:
        hosts: Addresses by name, all of one /24 network.
    """

    def __init__(self, hosts: Mapping[str, str]) -> None:
        self._hosts: dict[str, subprocess.Popen[bytes]] = {}
        _ip("link", "add", _SWITCH, "type", "bridge")
        _ip("link", "set", _SWITCH, "up")
        for number, (name, address) in enumerate(hosts.items()):
            # It holds the host's namespace until the lab ends.
            held = ["unshare", "--net", "sh", "-c", "echo there; exec sleep infinity"]
            holder = subprocess.Popen(held, stdout=subprocess.PIPE)
            if holder.stdout is None or not holder.stdout.readline():
                raise LabError(f"host {name}: no network namespace")
            self._hosts[name] = holder
            cable = self._cable(name)
            _ip("link", "add", cable, "type", "veth", "peer", "name", f"eth{number}", "netns", str(holder.pid))
            _ip("link", "set", cable, "master", _SWITCH, "up")
            for words in (
                ("addr", "add", f"{address}/24", "dev", f"eth{number}"),
                ("link", "set", f"eth{number}", "up"),
                ("link", "set", "lo", "up"),
            ):
                subprocess.run([*self._at(name), "ip", *words], check=True)

    def start(self, host: str, words: Sequence[str], log: Path, cwd: Path) -> subprocess.Popen[bytes]:
        """Start a command on a host.

        Args:
            host: Its name.
            words: The command.
            log: File for what it writes.
            cwd: Folder it works in.
        """
        with log.open("wb") as output:
            return subprocess.Popen(
                [*self._at(host), *words],
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **ENVIRONMENT},
            )

    def cut(self, host: str) -> None:
        """Take out a host's cable, at the switch."""
        _ip("link", "set", self._cable(host), "down")

    def mend(self, host: str) -> None:
        """Put it back."""
        _ip("link", "set", self._cable(host), "up")

    def _cable(self, host: str) -> str:
        return f"port{list(self._hosts).index(host)}"

    def _at(self, host: str) -> list[str]:
        return ["nsenter", f"--net=/proc/{self._hosts[host].pid}/ns/net", "--"]


def unavailable() -> str:
    """Why there can be no lab on this machine, or nothing."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"no {missing[0]} (util-linux, iproute2)"
    tried = subprocess.run([*_world(), "ip", "link", "add", "x", "type", "bridge"], capture_output=True, check=False)
    words = tried.stderr.decode(errors="replace").strip()
    return "" if tried.returncode == 0 else f"no namespaces here: {words or tried.returncode}"


def one_host_each(processes: Sequence[str], run: str) -> Inventory:
    """An inventory in which every process has a host of its own, and so has the recorder."""
    hosts = [
        Host(name=name, address=f"10.99.0.{number}", runs=[name])
        for number, name in enumerate([*processes, RECORDER], start=1)
    ]
    return Inventory(run=run, host=hosts)


def simulate(setup: Setup, out: Path, cuts: Sequence[Cut], timeout_s: float) -> dict[str, object]:
    """Build the lab, deploy, fly; this process has to be inside already.

    Args:
        setup: The run.
        out: Folder to create: keys, a folder for each host, logs, and what was recorded in `run`.
        cuts: What is done to cables.
        timeout_s: How long the whole may take from the first tick on.
    Returns: Exit codes by process (None of what had to be ended), and the cuts that were made.
    Raises: LabError: the lab cannot be built, or nobody flies in it.
    """
    processes = process_names(setup.scenario)
    inventory = one_host_each(processes, setup.scenario.name)
    addresses = {host.name: [*LOOPBACK, host.address] for host in inventory.host}
    make_certificates(out / "keys", {**dict.fromkeys(OTHERS, LOOPBACK), **addresses}, days=1)
    render(setup, inventory, out / "keys", out / "hosts", in_place=True)
    lab = Lab({host.name: host.address for host in inventory.host})
    (out / "logs").mkdir()
    with ExitStack() as stack:
        running = {}
        for posting in postings(inventory, processes, "tls"):
            words = _words(posting, inventory, out)
            started = lab.start(posting.host.name, words, out / "logs" / f"{posting.process}.log", out)
            stack.callback(started.kill)
            running[posting.process] = started
        begun_s = _wait_for_flight(out / "logs" / "coordinator.log", running)
        made = _work(lab, cuts, begun_s, running, timeout_s)
        exits = {name: started.poll() for name, started in running.items()}
    return {"exits": exits, "cuts": made, "took_s": round(time.monotonic() - begun_s, 3)}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    asked = _options().parse_args(arguments)
    if not os.environ.get(_INSIDE):
        reason = unavailable()
        if reason:
            sys.stderr.write(f"lab: {reason}\n")
            return EXIT_UNAVAILABLE
        own = list(sys.argv[1:] if arguments is None else arguments)
        words = [*_world(), *python("deploy.lab"), *own]
        os.execvpe(words[0], words, {**os.environ, _INSIDE: "1"})  # noqa: S606
    signal.signal(signal.SIGTERM, _interrupted)
    out: Path = asked.out
    try:
        path = find_scenario(asked.scenario)
        setup = Setup.of(read_scenario(path, asked.settings), str(path))
        if out.exists():
            raise LabError(f"--out: expected a folder that does not exist yet, got {out}")
        known = [*process_names(setup.scenario), RECORDER]
        strange = [cut.host for cut in asked.cut if cut.host not in known]
        if strange:
            raise LabError(f"--cut: expected a host of {', '.join(known)}, got {strange[0]!r}")
        found = simulate(setup, out.resolve(), asked.cut, asked.timeout)
    except ScenarioError as error:
        sys.stderr.write(f"lab: {error.blaming(asked.settings)}\n")
        return EXIT_SCENARIO
    except (LabError, KeysError, RenderError, subprocess.CalledProcessError) as error:
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
    parser = argparse.ArgumentParser(prog="python -m deploy.lab", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenario", default="resilient", help="scenario file or name")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--cut", type=Cut.of, action="append", default=[], metavar="HOST:AT[:FOR]", help="seconds")
    parser.add_argument("--out", type=Path, required=True, help="folder to create")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds from the first tick on")
    return parser


def _world() -> list[str]:
    """The command that begins a lab; who is not root is root in it alone."""
    return ["unshare", *(() if os.geteuid() == 0 else ("--map-root-user",)), *_WORLD]


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)  # noqa: S607


def _words(posting: Posting, inventory: Inventory, out: Path) -> list[str]:
    """The command of a rendered unit, from this environment instead of /opt."""
    _, *rest = command(posting, inventory, etc=out / "hosts" / posting.host.name)
    return [*python("transport"), *rest, *(["--out", "run"] if posting.process == RECORDER else [])]


def _wait_for_flight(log: Path, running: Mapping[str, subprocess.Popen[bytes]]) -> float:
    """Steady-clock time at which the coordinator has seen everybody, s.

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


def _work(
    lab: Lab,
    cuts: Sequence[Cut],
    begun_s: float,
    running: Mapping[str, subprocess.Popen[bytes]],
    timeout_s: float,
) -> list[dict[str, object]]:
    """Do what is due, until everybody has ended or the time is over; what was done, with its time of the flight."""
    due = [(cut.at_s, "cut", cut.host) for cut in cuts]
    due += [(cut.at_s + cut.for_s, "mend", cut.host) for cut in cuts if cut.for_s is not None]
    due.sort(reverse=True)
    made: list[dict[str, object]] = []
    while any(started.poll() is None for started in running.values()):
        now_s = time.monotonic() - begun_s
        if now_s > timeout_s:
            return made
        if due and now_s >= due[-1][0]:
            _, what, host = due.pop()
            (lab.cut if what == "cut" else lab.mend)(host)
            made.append({"at_s": round(now_s, 3), "did": what, "host": host})
        time.sleep(_POLL_S)
    return made


def _interrupted(_: int, __: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
