"""Local harness: starts the processes of a run, watches them, and always ends them."""

import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import psutil

from transport.flight.fork_server import Start, fork_server
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.parent_and_environment import PARENT_PIPE, STANDBY
from transport.protocol.scenario.sections.lockstep_and_realtime_section import LONGEST_WAIT_S
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE, TransportError
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    PLANT,
    RECORDER,
    VEHICLE,
    role_of,
)

_TRIES = 100  # to find successive ports
_GRACE_S = 5.0  # time for processes to end before they are killed, and for killed ones


class HarnessError(TransportError, RuntimeError):
    """The processes of a run could not be started."""

    exit_code = EXIT_UNREACHABLE


@dataclass(slots=True)
class Child:
    """One started process.

    Attributes:
        stdin: Its input, whose end ends it.
        log: File with its output.
        incarnation: Number of this start.
        is_noted: Whether its end is in the log already.
    """

    name: str
    process: psutil.Process
    stdin: IO[bytes]
    log: Path
    incarnation: int = 0
    is_noted: bool = False
    _cpu_s: float = 0.0  # its processor time at the last call of `is_starting`

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal; None while the process runs."""
        return self.wait(0.0)

    @property
    def is_stopped(self) -> bool:
        """Whether the process has been stopped by SIGSTOP and not continued."""
        try:
            return self.code is None and self.process.status() == psutil.STATUS_STOPPED
        except psutil.NoSuchProcess:
            return False

    def is_starting(self, longest_s: float) -> bool:
        """Return whether the process works on its start, however slowly on a busy machine.

        It has had processor time since the last call, and at most `longest_s` in all. Each call keeps the
        time for the next one: two callers would take each other's progress.
        """
        before_s = self._cpu_s
        try:
            used = self.process.cpu_times()
        except psutil.Error:
            return False
        self._cpu_s = used.user + used.system
        is_working = before_s < self._cpu_s <= longest_s
        return self.code is None and not self.is_stopped and is_working

    @property
    def last_words(self) -> str:
        """The last line of its output that is no log event: the error with which it has ended."""
        with suppress(OSError):  # the run folder was removed
            output = self.log.read_text(encoding="utf-8", errors="replace")
            for line in reversed(output.splitlines()):
                if line.strip() and not line.startswith("{"):
                    return line.strip().removeprefix("transport: ")
        return ""

    @property
    def last_output_s(self) -> float:
        """Time of its last output, s since 1970; 0 if the file is gone."""
        try:
            return self.log.stat().st_mtime
        except OSError:
            return 0.0

    @property
    def how_it_ended(self) -> str:
        """How the process has ended: by which signal, or with which exit code."""
        code = self.code or 0
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def wait(self, timeout_s: float) -> int | None:
        """Wait for the end; return the exit code, None if the process still runs."""
        try:
            return self.process.wait(timeout_s)  # type: ignore[no-any-return]
        except psutil.TimeoutExpired:
            return None

    def signal(self, number: int) -> bool:
        """Send a signal if the process is running; return whether it is."""
        is_running = self.code is None
        if is_running:
            with suppress(psutil.NoSuchProcess):
                self.process.send_signal(number)
        return is_running

    def go(self) -> bool:
        """Let a standby process begin; return whether it was running."""
        if self.code is not None:
            return False
        try:
            self.stdin.write(b"\n")
        except BrokenPipeError:
            return False
        return True

    def close(self) -> None:
        """Close the input of the process, which ends it."""
        with suppress(OSError):
            self.stdin.close()


@dataclass(frozen=True, slots=True)
class ToStart:
    """A process to be started: `transport` with arguments, and the file for its output."""

    name: str
    arguments: Sequence[str]
    log: Path
    incarnation: int = 0


def start_children(wanted: Sequence[ToStart], *, standby: bool = False) -> list[Child]:
    """Start processes, which end with this one."""
    extra = {PARENT_PIPE: "1", STANDBY: "1" if standby else ""}
    starts = []
    inputs = []
    with ExitStack() as started, ExitStack() as failed:
        for process in wanted:
            output = started.enter_context(process.log.open("wb"))
            reads, writes = os.pipe()
            started.callback(os.close, reads)
            inputs.append(failed.enter_context(os.fdopen(writes, "wb", 0)))
            starts.append(Start(process.arguments, reads, output.fileno()))
        processes = fork_server().start(starts, extra)
        failed.pop_all()  # the inputs stay open
    return [
        Child(one.name, process, stdin, one.log, one.incarnation)
        for one, process, stdin in zip(wanted, processes, inputs, strict=True)
    ]


@dataclass(slots=True)
class Harness:
    """Processes of one run on this machine; each watches a pipe from this one and ends with it."""

    run: str  # name of the run
    scenario: Path  # resolved scenario file
    mesh: Mapping[str, Endpoints]  # endpoints by process name
    logs: Path  # folder for their output
    keys: Path | None = None  # folder of keys in place of the scenario's
    vehicle_port: int = 0  # UDP port of the link to the autopilot of UAV 1; 0 without vehicles
    stands: bool = False  # whether UAVs stand until tick 0, and vehicles arm them
    autopilot: str | None = None  # of the vehicles, in place of the scenario's
    children: list[Child] = field(default_factory=list)  # processes in the order of their starts

    def ended(self) -> list[Child]:
        """Return the children that have ended, in the order of their last outputs.

        The others follow the one that has ended the run.
        """
        ended = [child for child in self.children if child.code is not None]
        return sorted(ended, key=lambda child: child.last_output_s)

    def is_starting(self, name: str, longest_s: float) -> bool:
        """Return whether a process of this run works on its start (`Child.is_starting`)."""
        return name in self.mesh and self.child(name).is_starting(longest_s)

    def child(self, name: str) -> Child:
        """Return the last started process of a name."""
        return next(child for child in reversed(self.children) if child.name == name)

    def wait(self, timeout_s: float) -> None:
        """Wait for all children to end."""
        psutil.wait_procs([child.process for child in self.children], timeout_s)

    def end(self, say: Callable[[str], None]) -> None:
        """End all running children by SIGTERM, after a grace period by SIGKILL, and name these."""
        for child in self.children:
            child.signal(signal.SIGTERM)
            child.signal(signal.SIGCONT)  # a stopped process ignores SIGTERM
        self.wait(_GRACE_S)
        for child in self.children:
            if child.code is None:
                say(f"{child.name} did not end: {child.process.status()}; it was killed")
                child.signal(signal.SIGKILL)
        self.wait(_GRACE_S)
        for child in self.children:
            child.close()

    def start(self, names: Iterable[str], incarnation: int = 0) -> None:
        """Start processes of the mesh."""
        self.logs.mkdir(parents=True, exist_ok=True)
        ending = ".log" if incarnation == 0 else f"-{incarnation}.log"
        wanted = [
            ToStart(
                name,
                arguments_of(self, name, incarnation),
                self.logs / f"{name}{ending}",
                incarnation,
            )
            for name in names
        ]
        self.children += start_children(wanted)


def arguments_of(harness: Harness, name: str, incarnation: int) -> list[str]:
    """Return the arguments of `transport` that start a process of a run: its command, then options.

    They follow from the name of the process, which has its role and number, and from the harness.
    """
    role = role_of(name)
    if role == AGENT:
        command = [AGENT, "--id", name.removeprefix(AGENT)]
    elif role == VEHICLE:
        command = _vehicle_command(harness, int(name.removeprefix(VEHICLE)))
    elif role == COORDINATOR:
        command = [COORDINATOR, "--observer", RECORDER]  # no tick before the recorder is there
    else:
        command = [name]

    settings = []
    if role in (PLANT, VEHICLE) and harness.vehicle_port:
        settings.append(f"network.vehicle_port={harness.vehicle_port}")
    if harness.keys is not None:
        settings.append(keys_setting(harness.keys))

    options = [
        ("--scenario", str(harness.scenario)),
        ("--run", harness.run),
        ("--incarnation", str(incarnation)),
        *(("--set", setting) for setting in settings),
        # The recorder gives up processes that do not join: it knows which are on their way.
        ("--join-timeout", str(LONGEST_WAIT_S)),
        *(("--listen", endpoint) for endpoint in harness.mesh[name].listen),
        *(("--connect", endpoint) for endpoint in harness.mesh[name].connect),
    ]
    # The parent has checked the scenario's size.
    return [*command, "--allow-large", *(text for option in options for text in option)]


def _vehicle_command(harness: Harness, uav: int) -> list[str]:
    """Return the command of the process of a UAV, 1-based, with the links to its autopilot.

    UAVs have successive ports. MAVLink has one link, over UDP. Betaflight has its MSP over TCP and takes
    poses over UDP: one number serves for both, as ports of TCP and UDP are not the same ports.
    """
    place = f"127.0.0.1:{harness.vehicle_port + uav - 1}"
    links = ["--link", f"udp:{place}"]
    if harness.autopilot == "betaflight":
        links = ["--autopilot", harness.autopilot]
        links += ["--link", f"tcp:{place}", "--pose", f"udp:{place}"]
    stands = ["--stands"] if harness.stands else []
    return [VEHICLE, "--uav", str(uav), *links, *stands]


def keys_setting(folder: Path | str) -> str:
    """Return the setting of a scenario that names a folder of keys."""
    text = json.dumps(str(folder), ensure_ascii=False)  # TOML has no surrogate pairs
    return f"network.keys={text}"


@contextmanager
def reserved_ports(host: str, ports: Sequence[int]) -> Iterator[list[int]]:
    """Reserve ports, 0 for any free one, while the context is open.

    No other process gets one as "any port". A process that names the port and sets SO_REUSEADDR, as
    Zenoh does, can listen on it.

    Raises: HarnessError: a port is taken, or the host is not of this machine.
    """
    with ExitStack() as stack:
        reserved = [_reserved(stack.enter_context(socket.socket()), host, port) for port in ports]
        if sys.platform != "linux":
            stack.close()  # elsewhere a bound socket blocks its port
        yield reserved


def _reserved(probe: socket.socket, host: str, port: int) -> int:
    """Bind a socket to a port, and return it. Raises: HarnessError."""
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        probe.bind((host, port))
    except OSError as error:
        key = "host"
        if port:
            key = f"base_port: expected free ports, got {port}, which is taken"
        problem = f"cannot listen on {host} ({error.strerror})"
        raise HarnessError(f"network.{key}: {problem}") from error
    number: int = probe.getsockname()[1]
    return number


def free_udp_ports(count: int) -> int:
    """Return the first of some successive UDP ports of this host that are free at the moment.

    Raises: HarnessError: there are none.
    """
    for _ in range(_TRIES):
        with ExitStack() as stack, suppress(OSError):
            probe = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            probe.bind(("127.0.0.1", 0))
            first: int = probe.getsockname()[1]
            for port in range(first + 1, first + count):
                probe = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                probe.bind(("127.0.0.1", port))
            return first
    raise HarnessError(f"network.vehicle_port: found no {count} successive free UDP ports")
