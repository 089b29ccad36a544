"""Fork server: starts the processes of a run by fork, so that imports are done once and their memory is shared.

The imports of an agent take more than 0.3 s of processor time. The server has one thread and no network, as fork
requires. A forked process equals `python -m transport agent ...`: it has its own session, output, pipe from its
parent, title and exit code. On systems other than Linux (`prctl`), and after errors, processes are started by Popen.
"""

import atexit
import ctypes
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import IO, Any

from protocol.network.parent import ENVIRONMENT, PARENT_PIPE, python
from transport.flight.vitals import Pulse, has_died, kill_leftovers

# Program of the server; it imports all commands, so it cannot be imported here.
_PROGRAM = "transport.cli.fork_server"
FORK_SERVER_TITLE = "transport fork-server"
REQUEST_BYTES = 128 * 1024
# A server is given up when it has been stopped for this long, has not run although it could, or has used so much
# processor time for one request, s: the imports take 1 s.
_STOPPED_S, _IDLE_S, _USED_S = 2.0, 10.0, 30.0
_LOOK_S = 0.1
# Time for a killed process to end, s.
_KILLED_S, _KILLED_POLL_S = 5.0, 0.01
_PR_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>
# Variables that affect imports: if they have changed since the start of the server, it is not used.
_AT_IMPORT = ("PAYLOAD_TRANSPORT_", "PYTHON", "HOME", "XDG_", "PATH", "LD_", "OPENBLAS_", "OMP_", "MKL_")


class Forked:
    """A forked process, with those parts of the interface of `subprocess.Popen` that the harness needs.

    Attributes:
        pid: Process id of a child that no other code waits for.
        stdin: Writing end of the pipe that the process watches.
        returncode: Exit code, negative for a signal; None while the process runs.
    """

    def __init__(self, pid: int, stdin: IO[bytes]) -> None:
        self.pid, self.stdin = pid, stdin
        self.returncode: int | Any = None  # as Popen has it
        self._handle = os.pidfd_open(pid)
        self._reaping = threading.Lock()

    def poll(self) -> int | Any:
        """Return the exit code, or None while the process runs."""
        with self._reaping:
            if self.returncode is None:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                if pid:
                    self.returncode = os.waitstatus_to_exitcode(status)
                    os.close(self._handle)
            return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process, s, or without limit for None; return its exit code.

        Raises: subprocess.TimeoutExpired: the process still runs.
        """
        code = self.poll()
        if code is not None:
            return code
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        waiting = select.poll()
        waiting.register(self._handle, select.POLLIN)
        while (left_s := deadline - time.monotonic()) > 0.0:
            has_ended = waiting.poll(None if left_s == math.inf else left_s * 1e3)
            code = self.poll()
            if code is not None:
                return code
            if has_ended:
                time.sleep(min(left_s, _LOOK_S))  # its tracer has not let go of it
        raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        with self._reaping:
            if self.returncode is None:
                signal.pidfd_send_signal(self._handle, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


_SERVERS: set[int] = set()  # process ids of all servers that this process has started

Started = Forked | subprocess.Popen[bytes]


# Threads take turns: the answers of a server do not name their requests, and all threads share one server.
_TURN = threading.RLock()


def fork_server() -> "ForkServer":
    """Return the server of this process; the first call starts it."""
    with _TURN:
        return _only_server()


@cache
def _only_server() -> "ForkServer":
    server = ForkServer()
    atexit.register(server.close)
    return server


def close_fork_server() -> None:
    """End the server of this process, if there is one; a later call of `fork_server` starts another."""
    with _TURN:
        if not _only_server.cache_info().currsize:
            return
        server = _only_server()
        atexit.unregister(server.close)
        _only_server.cache_clear()
        server.close()
        if sys.platform == "linux":
            _adopt_orphans(False)


class ForkServer:
    """Client of the server process, which starts to import at once; forked processes outlive the server."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        if sys.platform != "linux" or not _adopt_orphans(True):
            return
        self._imported = _at_import(os.environ)
        own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            try:
                self._process = subprocess.Popen(
                    [*python(_PROGRAM), str(other.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[other.fileno()],
                    env={**ENVIRONMENT, **os.environ, PARENT_PIPE: "1"},  # a stopped server notices its parent's end
                    start_new_session=True,  # Ctrl-C is handled by this process
                )
            except OSError:
                own.close()
                return
        self._socket = own
        _SERVERS.add(self._process.pid)

    def start(self, arguments: Sequence[str], output: IO[bytes], extra: Mapping[str, str]) -> Started:
        """Start `transport` as a child with an output file and additions to the environment of this process."""
        environment = {**ENVIRONMENT, **os.environ, **extra}
        with _TURN:
            server = self._process
            if self._socket is not None and server is not None and _at_import(os.environ) == self._imported:
                try:
                    return _fork(self._socket, server.pid, arguments, output, environment)
                except (OSError, ValueError):
                    self.close()  # the server only saves time: go on without it
                    _end_half_started(arguments)
        return subprocess.Popen(
            [*python("transport"), *arguments],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )

    def close(self) -> None:
        """End the server process."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            deadline = time.monotonic() + _KILLED_S
            while self._process.poll() is None and not has_died(self._process.pid) and time.monotonic() < deadline:
                time.sleep(_KILLED_POLL_S)
            self._process.poll()  # it may have died since the last one


def _fork(
    server: socket.socket, pid: int, arguments: Sequence[str], output: IO[bytes], environment: dict[str, str]
) -> Forked:
    """Request a process from the server, a process itself.

    Raises: OSError, ValueError: no process was started, or the server does not answer.
    """
    reads, writes = os.pipe()
    stdin = os.fdopen(writes, "wb")
    try:
        request = {"arguments": list(arguments), "environment": environment, "folder": str(Path.cwd())}
        socket.send_fds(server, [json.dumps(request).encode()], [reads, output.fileno()])
        _await_answer(server, Pulse(pid))
        return Forked(int(server.recv(64)), stdin)
    except BaseException:
        stdin.close()
        raise
    finally:
        os.close(reads)


def _await_answer(server: socket.socket, pulse: Pulse) -> None:
    """Wait until the server answers or ends, for as long as it works.

    Raises: TimeoutError: it is stopped or does not work.
    """
    used_before_s: float | None = None
    while not select.select([server], [], [], _LOOK_S)[0]:
        pulse.look()
        used_before_s = pulse.ran_s if used_before_s is None else used_before_s
        if pulse.stopped_s > _STOPPED_S or pulse.idle_s > _IDLE_S or pulse.ran_s - used_before_s > _USED_S:
            raise TimeoutError(f"the fork server does not answer: it is {pulse.description}")


def _end_half_started(arguments: Sequence[str]) -> None:
    """End a process that a server forked but did not announce before it was killed: it would take the name and port."""
    titles = frozenset({FORK_SERVER_TITLE, " ".join(["transport", *arguments])})
    deadline = time.monotonic() + _KILLED_S
    while kill_leftovers(os.getpid(), titles, frozenset(_SERVERS)) and time.monotonic() < deadline:
        time.sleep(_KILLED_POLL_S)


def _at_import(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(_AT_IMPORT)}


def _adopt_orphans(adopt: bool) -> bool:
    """Make this process, or not, the new parent of orphaned descendants, such as forked processes; return success."""
    try:
        os.close(os.pidfd_open(os.getpid()))  # missing in older kernels and some sandboxes
        return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False
