"""Starting processes of a run by fork: imports and the model are made once, and every process begins with them.

Importing what an agent needs takes a good third of a second of processor time, and six processes of a run share two
cores with it. Here one process imports, and copies of it become the others; what they share is in memory once. It has
one thread and no network, as forking asks for. They are what `python -m transport agent ...` would be: a session, an
output, a pipe from their parent, a title and an exit code of their own.

Linux alone can do that (`prctl`); elsewhere, and when it fails, processes are started in the usual way.
"""

import atexit
import ctypes
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import IO, Any

from protocol.network.parent import ENVIRONMENT, python

# The program of the server: it imports all commands, so it is above this room.
_PROGRAM = "transport.cli.fork_server"
REQUEST_BYTES = 128 * 1024
# How long it may take to import everything, on a machine that has much else to do.
_READY_S = 60.0
_PR_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>
# Variables that importing looks at: for others than the server was started with, processes are started anew.
_AT_IMPORT = ("PAYLOAD_TRANSPORT_", "PYTHON", "HOME", "XDG_", "PATH", "LD_", "OPENBLAS_", "OMP_", "MKL_")


class Forked:
    """A process that was started by fork; like `subprocess.Popen`, as far as the harness needs it.

    Attributes:
        pid: Its id.
        stdin: The pipe it watches.
        returncode: Exit code, negative for a signal; None while it runs.

    Args:
        pid: Of a child, which nobody else waits for.
        stdin: The end of the pipe to write to.
    """

    def __init__(self, pid: int, stdin: IO[bytes]) -> None:
        self.pid, self.stdin = pid, stdin
        self.returncode: int | Any = None  # as Popen has it
        self._handle = os.pidfd_open(pid)
        self._reaping = threading.Lock()

    def poll(self) -> int | Any:
        """The exit code, or None while it runs."""
        with self._reaping:
            if self.returncode is None:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                if pid:
                    self.returncode = os.waitstatus_to_exitcode(status)
                    os.close(self._handle)
            return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end.

        Args:
            timeout: How long, s; None for ever.
        Returns: The exit code.
        Raises: subprocess.TimeoutExpired: it still runs.
        """
        code = self.poll()
        if code is not None:
            return code
        waiting = select.poll()
        waiting.register(self._handle, select.POLLIN)
        waiting.poll(None if timeout is None else max(0.0, timeout) * 1e3)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        with self._reaping:
            if self.returncode is None:
                signal.pidfd_send_signal(self._handle, number)

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)


Started = Forked | subprocess.Popen[bytes]


@cache
def fork_server() -> "ForkServer":
    """The one of this process, started when it is first asked for."""
    server = ForkServer()
    atexit.register(server.close)
    return server


class ForkServer:
    """The server, as whoever starts processes sees it. It begins to import at once; what it has started outlives it."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        if sys.platform != "linux" or not _adopts_orphans():
            return
        self._imported = _at_import(os.environ)
        own, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its:
            try:
                self._process = subprocess.Popen(
                    [*python(_PROGRAM), str(its.fileno())],
                    stdin=subprocess.DEVNULL,
                    # What is wrong with a request, the process that is asked for will say.
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[its.fileno()],
                    env={**ENVIRONMENT, **os.environ},
                    start_new_session=True,  # Ctrl-C is for who asks, not for this one
                )
            except OSError:
                own.close()
                return
        own.settimeout(_READY_S)
        self._socket = own

    def start(self, arguments: Sequence[str], output: IO[bytes], extra: Mapping[str, str]) -> Started:
        """Start `transport` with some arguments, as a child of this process.

        Args:
            arguments: Of the command.
            output: Where its standard output and error go.
            extra: Environment beside that of this process.
        """
        environment = {**ENVIRONMENT, **os.environ, **extra}
        if self._socket is not None and _at_import(os.environ) == self._imported:
            try:
                return _fork(self._socket, arguments, output, environment)
            except (OSError, ValueError):
                self.close()  # it is gone, or not well: what it was to save is time
        return subprocess.Popen(
            [*python("transport"), *arguments],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )

    def close(self) -> None:
        """End the server."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def _fork(server: socket.socket, arguments: Sequence[str], output: IO[bytes], environment: dict[str, str]) -> Forked:
    """Ask for a process.

    Raises: OSError, ValueError: there is none.
    """
    reads, writes = os.pipe()
    stdin = os.fdopen(writes, "wb")
    try:
        request = {"arguments": list(arguments), "environment": environment, "folder": str(Path.cwd())}
        socket.send_fds(server, [json.dumps(request).encode()], [reads, output.fileno()])
        return Forked(int(server.recv(64)), stdin)
    except BaseException:
        stdin.close()
        raise
    finally:
        os.close(reads)


def _at_import(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(_AT_IMPORT)}


def _adopts_orphans() -> bool:
    """Make this process the parent of processes whose own ends: those that the server starts for it."""
    try:
        os.close(os.pidfd_open(os.getpid()))  # older kernels, and some sandboxes, have none
        return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False
