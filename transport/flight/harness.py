"""Local harness: starts the processes of a run, watches them, and always ends them."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from protocol.network.endpoints import Endpoints
from protocol.network.parent import PARENT_PIPE, STANDBY
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_DIVERGED, EXIT_INTERRUPTED, EXIT_OVERRUN, EXIT_UNREACHABLE
from protocol.wire.names import COORDINATOR
from transport.flight.fork_server import Started, fork_server
from transport.flight.vitals import Pulse, has_died

# Exit codes of a process after the end of its run.
ORDERLY_ENDS = {0, EXIT_UNREACHABLE, EXIT_OVERRUN, EXIT_DIVERGED, EXIT_INTERRUPTED}

# Time for a process to end before it is killed, and for a killed one, s: time in which it could run.
_GRACE_S = 5.0
_POLL_S = 0.05


class HarnessError(TransportError, RuntimeError):
    """The processes of a run could not be started."""


@dataclass(slots=True)
class Child:
    """One started process: its name, handle, file with its output, and number of this start."""

    name: str
    process: Started
    log: Path
    incarnation: int = 0

    def go(self) -> bool:
        """Let a standby process begin; return whether it was running."""
        try:
            if self.process.poll() is None and self.process.stdin is not None:
                self.process.stdin.write(b"\n")
                self.process.stdin.flush()
                return True
        except BrokenPipeError:
            pass
        return False

    def last_line(self) -> str:
        """Return the last line of output that is not empty."""
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""


@dataclass(slots=True)
class Harness:
    """Processes of one run on this machine; leaving the context ends them.

    Every child watches a pipe from this process and ends if this process is killed.

    Args:
        run: Name of the run.
        scenario: Resolved scenario file.
        mesh: Endpoints by process name.
        logs: Folder for their output.
        keys: Folder of keys in place of the scenario's.

    Attributes:
        children: Processes in the order of their starts.
        notices: Sentences about processes that did not end by themselves.
    """

    run: str
    scenario: Path
    mesh: Mapping[str, Endpoints]
    logs: Path
    keys: Path | None = None
    children: list[Child] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    _spares: dict[str, Child] = field(default_factory=dict)  # standby processes by name
    _files: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> "Harness":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def start(self, observers: Sequence[str] = ()) -> None:
        """Start all processes of the mesh.

        Raises: HarnessError: the folder for their output cannot be written.
        """
        for name in self.mesh:
            self.children.append(self._start(name, observers))

    def alive(self) -> list[Child]:
        """Return the children that are running."""
        return [child for child in self.children if child.process.poll() is None]

    def ended(self) -> list[Child]:
        """Return the children that have ended."""
        return [child for child in self.children if child.process.poll() is not None]

    def child(self, name: str) -> Child | None:
        """Return the last started process of a name."""
        return next((child for child in reversed(self.children) if child.name == name), None)

    def has_ended(self, name: str) -> bool:
        """Return whether a child has ended with an exit code for the end of a run."""
        child = self.child(name)
        return child is not None and child.process.poll() in ORDERLY_ENDS

    def signal(self, name: str, number: int) -> bool:
        """Send a signal to one child; return whether it is running."""
        child = self.child(name)
        if child is None or child.process.poll() is not None:
            return False
        child.process.send_signal(number)
        return True

    def prepare(self, name: str) -> None:
        """Start a standby successor of an agent, which waits for `restart`."""
        old = self.child(name)
        self._spares[name] = self._start(name, (), 0 if old is None else old.incarnation + 1, standby=True)

    def restart(self, name: str) -> None:
        """Kill a process if it still runs, and start it again with the next incarnation."""
        old, spare = self.child(name), self._spares.pop(name, None)
        if old is not None:
            old.process.kill()
            self._wait_given([old])
        incarnation = 0 if old is None else old.incarnation + 1
        if spare is not None and spare.incarnation == incarnation and spare.go():
            self.children.append(spare)
            return
        if spare is not None:
            spare.process.kill()
            self._wait_given([spare])
        self.children.append(self._start(name, (), incarnation))

    def wait(self, timeout_s: float) -> bool:
        """Wait for all children to end; return whether they did."""
        deadline = time.monotonic() + timeout_s
        for child in self.children:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                return False
        return True

    def end(self) -> None:
        """End all running children: SIGTERM, and SIGKILL after a grace period; note those that had to be killed."""
        self.children += self._spares.values()
        self._spares.clear()
        for child in self.alive():
            child.process.terminate()
            child.process.send_signal(signal.SIGCONT)  # a stopped process ignores SIGTERM
        for child, pulse in self._wait_given(self.alive()):
            if child.process.poll() is None:
                child.process.kill()
                self.notices.append(f"{child.name} did not end: {pulse.description}; it was killed")
        for child, _ in self._wait_given(self.alive()):
            self.notices.append(f"{child.name} (process {child.process.pid}) does not end after SIGKILL")
        for child in self.children:
            if child.process.stdin is not None:
                with suppress(OSError):
                    child.process.stdin.close()
        self._files.close()

    def _wait_given(self, children: Sequence[Child]) -> list[tuple[Child, Pulse]]:
        """Give children a grace period to end, in which they could run; return those that have not ended."""
        left = [(child, Pulse(child.process.pid)) for child in children]
        while left := [found for found in left if not _has_ended(found[0])]:
            for _, pulse in left:
                pulse.look()
            if all(pulse.given_s > _GRACE_S for _, pulse in left):
                break
            with suppress(subprocess.TimeoutExpired):
                left[0][0].process.wait(_POLL_S)
        return left

    def _start(self, name: str, observers: Sequence[str], incarnation: int = 0, *, standby: bool = False) -> Child:
        log = self.logs / (f"{name}.log" if incarnation == 0 else f"{name}-{incarnation}.log")
        try:
            self.logs.mkdir(parents=True, exist_ok=True)
            output: IO[bytes] = self._files.enter_context(log.open("wb"))
        except OSError as error:
            if incarnation == 0:
                raise HarnessError(f"{log}: cannot write the output of {name} ({error.strerror})") from error
            log = Path(os.devnull)  # a process that is started again must not wait for the folder
            output = self._files.enter_context(log.open("wb"))
        extra = {PARENT_PIPE: "1", STANDBY: "1" if standby else ""}
        process = fork_server().start(self._arguments(name, observers, incarnation), output, extra)
        return Child(name, process, log, incarnation)

    def _arguments(self, name: str, observers: Sequence[str], incarnation: int) -> list[str]:
        endpoints = self.mesh[name]
        role = ["agent", "--id", name.removeprefix("agent")] if name.startswith("agent") else [name]
        options = [("--scenario", str(self.scenario)), ("--run", self.run), ("--incarnation", str(incarnation))]
        options += [] if self.keys is None else [("--set", keys_setting(self.keys))]
        options += [("--listen", endpoint) for endpoint in endpoints.listen]
        options += [("--connect", endpoint) for endpoint in endpoints.connect]
        if name == COORDINATOR:
            options += [("--observer", observer) for observer in observers]
        # The parent has checked the scenario's size.
        return [*role, "--allow-large", *(text for option in options for text in option)]


def keys_setting(folder: Path | str) -> str:
    """Return the setting of a scenario that names a folder of keys."""
    return f"network.keys={json.dumps(str(folder), ensure_ascii=False)}"  # TOML has no surrogate pairs


def _has_ended(child: Child) -> bool:
    """Return whether a child has ended, also while a tracer keeps this process from reaping it."""
    return child.process.poll() is not None or has_died(child.process.pid)


@contextmanager
def free_ports(host: str, count: int) -> Iterator[list[int]]:
    """Reserve free ports while the context is open: no other process gets one as "any port".

    A process that names the port and sets SO_REUSEADDR, as Zenoh does, can listen on it, also after a restart.

    Raises: HarnessError: the host's address is not of this machine.
    """
    with ExitStack() as stack:
        sockets = []
        for _ in range(count):
            probe = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, 0))
            except OSError as error:
                raise HarnessError(f"network.host: cannot listen on {host} ({error.strerror})") from error
            sockets.append(probe)
        ports = [probe.getsockname()[1] for probe in sockets]
        if sys.platform != "linux":
            stack.close()  # elsewhere a bound socket blocks its port
        yield ports


def check_ports(host: str, ports: Sequence[int]) -> None:
    """Check that no process listens on the ports.

    Raises: HarnessError: naming the first taken port.
    """
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise HarnessError(
                    f"network.base_port: expected free ports {ports[0]}..{ports[-1]} on {host}, "
                    f"got {port}, which is taken ({error.strerror})"
                ) from error
