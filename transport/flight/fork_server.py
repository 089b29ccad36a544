"""Fork server: starts the processes of a run by fork, so that imports are done once and shared.

A forked process equals `python -m transport agent ...`: it has its own session, output, title and
exit code, and is a child of the process that asked for it. Four processes take part in its start:

    caller   asks: arguments, environment, folder, two open files       (`ForkServer.start`)
    server   prepares, forks the next, and waits for its end            (`serve`)
    between  forks the new process, tells its id to the server, ends    (`_started`)
    new      waits until the caller has adopted it, as the process in between has ended and the caller
             is the reaper of its orphans; then it is the command       (`_become`)

The caller's server is in one of two states, and is never started again by the same object:

    SERVING   from `ForkServer()` on Linux        processes are forked
    ABSENT    after `close`, or once the server   processes are started by Popen
              could not be started, has not answered, or has answered without a process;
              on other systems from the beginning

A program has one server at most (`fork_server`), which ends with it: a closed one is replaced by the
next call. Forked processes outlive the server.
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
from pathlib import Path
from typing import IO, Any, NoReturn

import psutil
import setproctitle

from transport.protocol.network.parent import ENVIRONMENT, FORK_SERVER, PARENT_PIPE, python
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED

# Longest request, most of which is the environment. The server receives a part of a longer one and
# ends with an error: processes are then started by Popen.
_REQUEST_BYTES = 128 * 1024
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


@atexit.register
def close_fork_server() -> None:
    """End the server of this process, if there is one.

    A later call of `fork_server` starts another.
    """
    with _servers_lock:
        while _servers:
            _servers.pop().close()


@dataclass(frozen=True, slots=True)
class _Serving:
    """A server process that imports, or waits for requests, and the socket for them."""

    requests: socket.socket
    process: subprocess.Popen[bytes]


class ForkServer:
    """Client of the server process, which starts to import at once.

    While it serves, all orphaned descendants of this process become its children
    (`PR_SET_CHILD_SUBREAPER`), also those of other parts of the program.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()  # the answers of the server do not name their requests
        self._server: _Serving | None = None
        if sys.platform != "linux" or not _adopt_orphans(True):
            return
        try:
            self._server = _launched()
        except OSError:
            _adopt_orphans(False)  # the server only saves time: processes are started by Popen

    @property
    def pid(self) -> int:
        """Id of the server process, 0 without one."""
        return 0 if self._server is None else self._server.process.pid

    def start(
        self, arguments: Sequence[str], stdin: int, output: IO[bytes], extra: Mapping[str, str]
    ) -> psutil.Process:
        """Start `transport` as a child with two open files.

        Its environment is that of this process with some additions.
        """
        environment = {**ENVIRONMENT, **os.environ, **extra}
        with self._turn:
            try:
                if self._server is not None:
                    files = [stdin, output.fileno()]
                    return _forked(self._server.requests, arguments, environment, files)
            except (OSError, ValueError, psutil.Error):
                # Without an answer, or a current folder, the process is started anew. One that the
                # server has forked but not announced ends with its input.
                self.close()

        return psutil.Popen(
            [*python("transport"), *arguments],
            stdin=stdin,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )

    def close(self) -> None:
        """End the server process."""
        server, self._server = self._server, None
        if server is not None:
            server.requests.close()
            server.process.kill()
            server.process.wait()
            _adopt_orphans(False)


def _launched() -> _Serving:
    """Start a server process.

    Raises: OSError: there is no file, no memory or no process left for it.
    """
    requests, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    requests.settimeout(_ANSWER_S)
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


def _forked(
    server: socket.socket,
    arguments: Sequence[str],
    environment: Mapping[str, str],
    files: Sequence[int],
) -> psutil.Process:
    """Let the server fork a process with open files, and return it."""
    request = {
        "arguments": list(arguments),
        "environment": environment,
        "folder": str(Path.cwd()),
    }
    socket.send_fds(server, [json.dumps(request).encode()], files)
    pid = int(server.recv(64))
    return psutil.Process(pid)  # an error for the id 0 of a fork that has failed


def _adopt_orphans(adopt: bool) -> bool:
    """Make this process, or not, the new parent of its orphaned descendants; return success."""
    return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0) == 0)


def serve(
    requests: socket.socket, prepare: Callable[[list[str]], None], command: Callable[[], NoReturn]
) -> None:
    """Serve requests until the socket is closed: prepare and fork a process for each.

    The process runs the command.
    """
    # Titles are written over the memory of arguments and environment, which setproctitle finds at its
    # first call: before `_become` gives the environment other memory.
    setproctitle.setproctitle(f"transport {FORK_SERVER}")
    while True:
        content, descriptors, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, 2)
        if not content:
            return

        request = json.loads(content)
        os.chdir(request["folder"])
        with suppress(Exception):  # the process reports errors of its arguments
            prepare(request["arguments"])
        gc.collect()
        gc.freeze()  # a collection after the fork would copy shared memory

        requests.send(b"%d" % _started(request, descriptors, command))
        for descriptor in descriptors:
            os.close(descriptor)


def _started(
    request: Mapping[str, Any], descriptors: list[int], command: Callable[[], NoReturn]
) -> int:
    """Fork twice, so that the process that sent the request adopts the new one; return its id.

    The id is 0, which no process has, if the second fork fails.
    """
    reads, writes = os.pipe()
    between = os.fork()
    if between == 0:
        id_between = os.getpid()
        try:
            pid = os.fork()
        except OSError:
            os._exit(1)  # the error must not run up through `serve` in this process
        if pid == 0:
            # The command lets the end of its parent continue it (`wake_with_its_end`). Begun beside
            # the process in between, it would be continued by the end of that one, although a
            # script or a user may just have stopped it.
            while os.getppid() == id_between:
                time.sleep(1e-4)
            _become(request, descriptors[0], descriptors[1], command)
        os.write(writes, b"%d" % pid)
        os._exit(0)

    os.close(writes)
    os.waitpid(between, 0)
    with os.fdopen(reads, "rb") as pipe:
        answer = pipe.read()
    return int(answer) if answer else 0


def _become(
    request: Mapping[str, Any], stdin: int, output: int, command: Callable[[], NoReturn]
) -> NoReturn:
    """Run the requested command in this process, and end."""
    code = 1
    try:
        os.setsid()
        for descriptor, target in ((stdin, 0), (output, 1), (output, 2)):
            os.dup2(descriptor, target)
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))

        os.environ.clear()
        os.environ.update(request["environment"])
        sys.argv = ["transport", *request["arguments"]]
        setproctitle.setproctitle(" ".join(sys.argv))
        command()
    except KeyboardInterrupt:  # before the command handles it
        code = EXIT_INTERRUPTED
    except BaseException:  # noqa: BLE001  # no caller would report it
        traceback.print_exc()
    finally:
        os._exit(code)
