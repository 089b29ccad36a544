"""Local harness: starts the processes of a run, watches them, and always ends them."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import psutil

from protocol.network.endpoints import Endpoints
from protocol.network.parent import PARENT_PIPE, STANDBY
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_DIVERGED, EXIT_INTERRUPTED, EXIT_OVERRUN, EXIT_UNREACHABLE
from protocol.wire.names import COORDINATOR
from transport.flight.fork_server import fork_server, state_of

# Exit codes of a process after the end of its run.
ORDERLY_ENDS = {0, EXIT_UNREACHABLE, EXIT_OVERRUN, EXIT_DIVERGED, EXIT_INTERRUPTED}

# Time for processes to end before they are killed, and for killed ones, s.
_GRACE_S = 5.0
_POLL_S = 0.005


class HarnessError(TransportError, RuntimeError):
    """The processes of a run could not be started."""

    exit_code = EXIT_UNREACHABLE


@dataclass(slots=True)
class Child:
    """One started process: its name, handle, input that ends it, file with its output, and number of this start."""

    name: str
    process: psutil.Process
    stdin: IO[bytes]
    log: Path
    incarnation: int = 0
    _code: int | None = None

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal; None while the process runs."""
        if self._code is None and isinstance(self.process, psutil.Popen):
            self._code = self.process.poll()
        elif self._code is None:
            pid, status = os.waitpid(self.process.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    @property
    def state(self) -> str:
        """State in words, such as "stopped by a signal"."""
        return state_of(self.process)

    def wait(self, timeout_s: float) -> int | None:
        """Wait for the end; return the exit code, None if the process still runs."""
        until_s = time.monotonic() + timeout_s
        while self.code is None and time.monotonic() < until_s:
            time.sleep(_POLL_S)
        return self.code

    def signal(self, number: int) -> bool:
        """Send a signal; return whether the process is running."""
        if self.code is not None:
            return False
        with suppress(psutil.NoSuchProcess):
            self.process.send_signal(number)
        return True

    def go(self) -> bool:
        """Let a standby process begin; return whether it was running."""
        with suppress(BrokenPipeError):
            if self.code is None:
                self.stdin.write(b"\n")
                return True
        return False

    def close(self) -> None:
        """Close the input of the process, which ends it."""
        with suppress(OSError):
            self.stdin.close()

    def last_line(self) -> str:
        """Return the last line of output that is not empty."""
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""


def start_child(
    name: str, arguments: Sequence[str], log: Path, incarnation: int = 0, *, standby: bool = False
) -> Child:
    """Start `transport` with arguments and a file for its output; it ends when this process does.

    Raises: OSError: the file cannot be written.
    """
    with log.open("wb") as output:
        reads, writes = os.pipe()
        stdin = os.fdopen(writes, "wb", 0)
        try:
            extra = {PARENT_PIPE: "1", STANDBY: "1" if standby else ""}
            return Child(name, fork_server().start(arguments, reads, output, extra), stdin, log, incarnation)
        except BaseException:
            stdin.close()
            raise
        finally:
            os.close(reads)


@dataclass(slots=True)
class Harness:
    """Processes of one run on this machine; leaving the context ends them.

    Every child watches a pipe from this process and ends if this process is killed.
    """

    run: str  # name of the run
    scenario: Path  # resolved scenario file
    mesh: Mapping[str, Endpoints]  # endpoints by process name
    logs: Path  # folder for their output
    keys: Path | None = None  # folder of keys in place of the scenario's
    children: list[Child] = field(default_factory=list)  # processes in the order of their starts
    notices: list[str] = field(default_factory=list)  # sentences about processes that did not end by themselves
    _spares: dict[str, Child] = field(default_factory=dict)  # standby processes by name

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
        return [child for child in self.children if child.code is None]

    def ended(self) -> list[Child]:
        """Return the children that have ended."""
        return [child for child in self.children if child.code is not None]

    def child(self, name: str) -> Child | None:
        """Return the last started process of a name."""
        return next((child for child in reversed(self.children) if child.name == name), None)

    def has_ended(self, name: str) -> bool:
        """Return whether a child has ended with an exit code for the end of a run."""
        child = self.child(name)
        return child is not None and child.code in ORDERLY_ENDS

    def signal(self, name: str, number: int) -> bool:
        """Send a signal to one child; return whether it is running."""
        child = self.child(name)
        return child is not None and child.signal(number)

    def prepare(self, name: str) -> None:
        """Start a standby successor of an agent, which waits for `restart`."""
        old = self.child(name)
        self._spares[name] = self._start(name, (), 0 if old is None else old.incarnation + 1, standby=True)

    def restart(self, name: str) -> None:
        """Kill a process if it still runs, and start it again with the next incarnation."""
        old, spare = self.child(name), self._spares.pop(name, None)
        incarnation = 0 if old is None else old.incarnation + 1
        for child in (old, spare if spare is not None and spare.incarnation != incarnation else None):
            if child is not None and child.signal(signal.SIGKILL):
                child.wait(_GRACE_S)
        is_ready = spare is not None and spare.go()
        self.children.append(spare if spare is not None and is_ready else self._start(name, (), incarnation))

    def wait(self, timeout_s: float) -> bool:
        """Wait for all children to end; return whether they did."""
        until_s = time.monotonic() + timeout_s
        return all(child.wait(max(0.0, until_s - time.monotonic())) is not None for child in self.children)

    def end(self) -> None:
        """End all running children: SIGTERM, and SIGKILL after a grace period; note those that had to be killed."""
        self.children += self._spares.values()
        self._spares.clear()
        for child in self.alive():
            child.signal(signal.SIGTERM)
            child.signal(signal.SIGCONT)  # a stopped process ignores SIGTERM
        self.wait(_GRACE_S)
        for child in self.alive():
            self.notices.append(f"{child.name} did not end: {child.state}; it was killed")
            child.signal(signal.SIGKILL)
        self.wait(_GRACE_S)
        for child in self.children:
            child.close()

    def _start(self, name: str, observers: Sequence[str], incarnation: int = 0, *, standby: bool = False) -> Child:
        arguments = self._arguments(name, observers, incarnation)
        log = self.logs / (f"{name}.log" if incarnation == 0 else f"{name}-{incarnation}.log")
        try:
            self.logs.mkdir(parents=True, exist_ok=True)
            return start_child(name, arguments, log, incarnation, standby=standby)
        except OSError as error:
            raise HarnessError(f"{log}: cannot write the output of {name} ({error.strerror})") from error

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
