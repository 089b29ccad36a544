"""The fork server: a process that imports all roles once and forks a process of a run for each request.

`transport.flight.fork_server` starts it and sends the requests.
"""

import gc
import itertools
import json
import os
import socket
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NoReturn

import setproctitle

from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.cli.lazy import load
from transport.cli.options import read_setup
from transport.flight.fork_server import FORK_SERVER, REQUEST_BYTES


def serve(own: socket.socket, command: Callable[[], NoReturn]) -> None:
    """Start a process with the command for each request from a socket until its other end is closed."""
    setproctitle.setproctitle(f"transport {FORK_SERVER}")  # before the environment moves: titles use its memory
    for name in ("transport.cli.main", "transport.cli.processes", "agent.node", "coordinator.node", "plant.node"):
        load(name)
    while True:
        content, descriptors, _, _ = socket.recv_fds(own, REQUEST_BYTES, 2)
        if not content:
            return
        request = json.loads(content)
        os.chdir(request["folder"])
        arguments = request["arguments"]
        with suppress(Exception):  # reads the scenario into the cache; the process reports its errors
            settings = [value for option, value in itertools.pairwise(arguments) if option == "--set"]
            read_setup(arguments[arguments.index("--scenario") + 1], settings, allow_large=True).model  # noqa: B018
        gc.collect()
        gc.freeze()  # a collection after the fork would copy shared memory
        own.send(b"%d" % _started(request, descriptors, command))
        for descriptor in descriptors:
            os.close(descriptor)


def _started(request: Mapping[str, Any], descriptors: list[int], command: Callable[[], NoReturn]) -> int:
    """Fork twice, so that the process that sent the request adopts the new one; return its id."""
    reads, writes = os.pipe()
    between = os.fork()
    if between == 0:
        own, pid = os.getpid(), os.fork()
        if pid == 0:
            # Once it watches its parent, the end of this one would continue it if it were stopped by then.
            while os.getppid() == own:
                time.sleep(1e-4)
            _become(request, descriptors[0], descriptors[1], command)
        os.write(writes, b"%d" % pid)
        os._exit(0)
    os.close(writes)
    os.waitpid(between, 0)
    with os.fdopen(reads, "rb") as pipe:
        return int(pipe.read() or b"0")


def _become(request: Mapping[str, Any], stdin: int, output: int, command: Callable[[], NoReturn]) -> NoReturn:
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
