"""Fork server: starts the processes of a run by fork, so that imports are done once and shared.

A forked process equals `python -m transport agent ...`: it has its own session, output, title and
exit code, and is a child of the process that asked for it. Four kinds of processes take part in a start:

    caller   asks for some: arguments, environment, folder, two open files each (`ForkServer.start`)
    server   prepares, forks the next, and waits for its end            (`serve`)
    between  forks the new ones, tells their ids to the server, ends    (`_fork_each`)
    new      waits until the caller has adopted it, as the process in between has ended and the caller
             is the reaper of its orphans; then it is the command       (`_become`)

The caller's server is in one of two states, and is never started again by the same object:

    SERVING   from `ForkServer()` on Linux        processes are forked
    ABSENT    after `close`, or once the server   processes are started by Popen
              could not be started, has not answered, or has answered without a process;
              on other systems from the beginning

A program has one server at most (`fork_server`), which ends with it: a closed one is replaced by the
next call. Forked processes outlive the server.

The server of `transport run` is a fork of the command itself, made before that has threads: both need
the same imports (`fork_into_server`). A program of a user may have threads, so its server is a new
process, which imports once more.
"""

import atexit
import ctypes
import gc
import json
import os
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import psutil
import setproctitle

from transport.protocol.network.parent_and_environment import (
    ENVIRONMENT,
    FORK_SERVER,
    PARENT_PIPE,
    python,
)
from transport.protocol.network.session import is_used
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED

# Longest request, most of which is the environment. The server receives a part of a longer one and
# ends with an error: processes are then started by Popen.
_REQUEST_BYTES = 128 * 1024
_PROCESSES = 100  # of a request, at most: Linux passes 253 open files
_ID_BYTES = 16  # in an answer, for each process
_ANSWER_S = 20.0  # time for an answer: the imports take 1 s
_PR_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>
_servers: list["ForkServer"] = []  # of this process: one at most
_servers_lock = threading.Lock()  # threads may start runs at the same time


def fork_server() -> "ForkServer":
    """Return the server of this process; the first call starts it."""
    with _servers_lock:
        if not _servers:
            _servers.append(ForkServer())
        return _servers[0]


def fork_into_server(serve_requests: Callable[[socket.socket], object]) -> None:
    """Make a fork of this process its server, if it has none and can be forked.

    The fork calls `serve_requests` with the socket for requests, and ends. A process that has other
    threads, or has used the network, as a program that calls the command may have, is left without:
    `fork_server` then starts a new process.
    """
    if not _servers and threading.active_count() == 1 and not is_used():
        _servers.append(ForkServer(partial(_branched, serve_requests)))


@atexit.register
def close_fork_server() -> None:
    """End the server of this process, if there is one.

    A later call of `fork_server` starts another.
    """
    with _servers_lock:
        while _servers:
            _servers.pop().close()


@dataclass(frozen=True, slots=True)
class Start:
    """Arguments of `transport` in a new process, and the descriptors of its input and output."""

    arguments: Sequence[str]
    stdin: int
    output: int


@dataclass(frozen=True, slots=True)
class _Serving:
    """A server process that imports, or waits for requests, and the socket for them."""

    requests: socket.socket
    process: subprocess.Popen[bytes] | psutil.Process


class ForkServer:
    """Client of the server process, a new one unless `begin` says otherwise.

    While it serves, all orphaned descendants of this process become its children
    (`PR_SET_CHILD_SUBREAPER`), also those of other parts of the program.
    """

    def __init__(self, begin: Callable[[], _Serving] | None = None) -> None:
        self._turn = threading.Lock()  # the answers of the server do not name their requests
        self._server: _Serving | None = None
        if sys.platform != "linux" or not _adopt_orphans(True):
            return
        try:
            self._server = (begin or _launched)()
        except OSError:
            _adopt_orphans(False)  # the server only saves time: processes are started by Popen

    @property
    def pid(self) -> int:
        """Id of the server process, 0 without one."""
        return 0 if self._server is None else self._server.process.pid

    def start(self, starts: Sequence[Start], extra: Mapping[str, str]) -> list[psutil.Process]:
        """Start `transport` as children, whose environment is that of this process with additions.

        All at once take less time than one after the other.
        """
        environment = {**ENVIRONMENT, **os.environ, **extra}
        with self._turn:
            forked = self._fork(starts, environment)
        others = [_opened(start, environment) for start in starts[len(forked) :]]
        return [*forked, *others]

    def _fork(
        self, starts: Sequence[Start], environment: Mapping[str, str]
    ) -> list[psutil.Process]:
        """Return forked processes, fewer than asked for once the server is absent."""
        processes: list[psutil.Process] = []
        try:
            while self._server is not None and len(processes) < len(starts):
                some = starts[len(processes) :][:_PROCESSES]
                forked = _forked(self._server.requests, some, environment)
                processes += forked
                if len(forked) < len(some):
                    self.close()
        except (OSError, ValueError, psutil.Error):
            # No answer, or no current folder. Processes that the server has forked but not announced
            # end with their input.
            self.close()
        return processes

    def close(self) -> None:
        """End the server process."""
        server, self._server = self._server, None
        if server is not None:
            server.requests.close()
            with suppress(psutil.NoSuchProcess):
                server.process.kill()
            server.process.wait()
            _adopt_orphans(False)


def _opened(start: Start, environment: Mapping[str, str]) -> psutil.Process:
    """Start a process as a program of its own, which imports all that it needs."""
    return psutil.Popen(
        [*python("transport"), *start.arguments],
        stdin=start.stdin,
        stdout=start.output,
        stderr=subprocess.STDOUT,
        env=environment,
        start_new_session=True,
    )


def _launched() -> _Serving:
    """Start a server process, which begins to import.

    Raises: OSError: there is no file, no memory or no process left for it.
    """
    requests, other = _connection()
    # A stopped server is continued by the end of this process (`wake_with_its_end`), and ends as
    # its socket is closed.
    environment = {**ENVIRONMENT, **os.environ, PARENT_PIPE: "1"}
    with other:
        try:
            process = subprocess.Popen(
                [*python("transport"), FORK_SERVER, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[other.fileno()],
                env=environment,
                start_new_session=True,  # Ctrl-C is handled by this process
            )
        except OSError:
            requests.close()
            raise
    return _Serving(requests, process)


def _branched(serve_requests: Callable[[socket.socket], object]) -> _Serving:
    """Fork this process into a server process, which is like one that `_launched` starts.

    Raises: OSError: there is no file, no memory or no process left for it.
    """
    requests, other = _connection()
    with other:
        try:
            pid = os.fork()
        except OSError:
            requests.close()
            raise
        if pid == 0:
            try:
                requests.close()
                os.setsid()
                null = os.open(os.devnull, os.O_RDWR)
                for target in (0, 1, 2):
                    os.dup2(null, target)
                os.environ[PARENT_PIPE] = "1"
                serve_requests(other)
            finally:
                os._exit(0)  # nothing runs up into the command of which this process is a fork
    return _Serving(requests, psutil.Process(pid))


def _connection() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a socket for requests: that of the caller and that of the server."""
    requests, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    requests.settimeout(_ANSWER_S)
    return requests, other


def _forked(
    server: socket.socket, starts: Sequence[Start], environment: Mapping[str, str]
) -> list[psutil.Process]:
    """Let the server fork processes, and return them: fewer if one could not be forked."""
    request = {
        "arguments": [list(start.arguments) for start in starts],
        "environment": environment,
        "folder": str(Path.cwd()),
    }
    files = [descriptor for start in starts for descriptor in (start.stdin, start.output)]
    socket.send_fds(server, [json.dumps(request).encode()], files)
    pids = json.loads(server.recv(_ID_BYTES * _PROCESSES))  # an error if the server has ended
    return list(map(psutil.Process, pids))


def _adopt_orphans(adopt: bool) -> bool:
    """Make this process, or not, the new parent of its orphaned descendants; return success."""
    return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0) == 0)


def serve(
    requests: socket.socket, prepare: Callable[[list[str]], None], command: Callable[[], NoReturn]
) -> None:
    """Serve requests until the socket is closed: prepare and fork the processes of each.

    They run the command.
    """
    # Titles are written over the memory of arguments and environment, which setproctitle finds at its
    # first call: before `_become` gives the environment other memory.
    setproctitle.setproctitle(f"transport {FORK_SERVER}")
    while True:
        content, descriptors, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, 2 * _PROCESSES)
        if not content:
            return

        request = json.loads(content)
        os.chdir(request["folder"])
        for arguments in request["arguments"]:
            with suppress(Exception):  # the process reports errors of its arguments
                prepare(arguments)
        gc.freeze()  # garbage collections of forked processes leave shared memory as it is

        requests.send(json.dumps(_started(request, descriptors, command)).encode())
        for descriptor in descriptors:
            os.close(descriptor)


def _started(
    request: Mapping[str, Any], descriptors: list[int], command: Callable[[], NoReturn]
) -> list[int]:
    """Fork twice, so that the process that sent the request adopts the new ones; return their ids.

    None follows a fork that failed.
    """
    reads, writes = os.pipe()
    between = os.fork()
    if between == 0:
        _fork_each(request, descriptors, writes, command)

    os.close(writes)
    os.waitpid(between, 0)
    with os.fdopen(reads, "rb") as pipe:
        return list(map(int, pipe.read().split()))


def _fork_each(
    request: Mapping[str, Any], descriptors: list[int], writes: int, command: Callable[[], NoReturn]
) -> NoReturn:
    """Fork the new processes of a request in the one in between, write their ids to a pipe, and end."""
    id_between = os.getpid()
    for number, arguments in enumerate(request["arguments"]):
        try:
            pid = os.fork()
        except OSError:
            break  # the error must not run up through `serve` in this process
        if pid != 0:
            os.write(writes, b"%d " % pid)
            continue

        # The command lets the end of its parent continue it (`wake_with_its_end`). Begun beside the
        # process in between, it would be continued by the end of that one, although a script or a
        # user may just have stopped it.
        while os.getppid() == id_between:
            time.sleep(1e-4)
        stdin, output = descriptors[2 * number : 2 * number + 2]
        _become(arguments, request["environment"], stdin, output, command)
    os._exit(0)


def _become(
    arguments: Sequence[str],
    environment: Mapping[str, str],
    stdin: int,
    output: int,
    command: Callable[[], NoReturn],
) -> NoReturn:
    """Run the requested command in this process, and end."""
    code = 1
    try:
        os.setsid()
        for descriptor, target in ((stdin, 0), (output, 1), (output, 2)):
            os.dup2(descriptor, target)
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))

        os.environ.clear()
        os.environ.update(environment)
        sys.argv = ["transport", *arguments]
        setproctitle.setproctitle(" ".join(sys.argv))
        command()
    except KeyboardInterrupt:  # before the command handles it
        code = EXIT_INTERRUPTED
    except BaseException:  # noqa: BLE001  # no caller would report it
        traceback.print_exc()
    finally:
        os._exit(code)
