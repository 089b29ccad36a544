"""The fork server's program: imports every role once and forks a process for each request.

`transport.flight.fork_server` starts it and sends the requests.
"""

import contextlib
import gc
import importlib
import json
import os
import socket
import sys
import traceback
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import setproctitle

from protocol.network.parent import wake_with_its_end
from transport.cli.answers import read_setup
from transport.cli.program import main
from transport.flight.fork_server import REQUEST_BYTES


def serve(own: socket.socket) -> None:
    """Start processes as they are asked for, until nobody can ask any more.

    Args:
        own: Where requests come in.
    """
    wake_with_its_end()
    setproctitle.setproctitle("transport fork-server")  # also finds the room for titles, before the environment moves
    _import_all()
    while True:
        content, descriptors, _, _ = socket.recv_fds(own, REQUEST_BYTES, 2)
        if not content:
            return
        request = json.loads(content)
        os.chdir(request["folder"])
        _read_scenario(request["arguments"])
        gc.collect()
        gc.freeze()  # what is collected later would no longer be shared
        own.send(b"%d" % _started(request, *descriptors))
        for descriptor in descriptors:
            os.close(descriptor)


def _import_all() -> None:
    """What processes of a run need, down to what their first steps would import."""
    for name in ("agent.main", "coordinator.main", "plant.main", "transport.cli.main"):
        importlib.import_module(name)


def _read_scenario(arguments: Sequence[str]) -> None:
    """Read the scenario a process is to have, so that it need not; what is wrong with it is for that process to say."""
    with contextlib.suppress(Exception):
        read_setup(arguments[list(arguments).index("--scenario") + 1], None).model  # noqa: B018


def _started(request: Mapping[str, Any], stdin: int, output: int) -> int:
    """Fork twice: whoever has lost its parent becomes a child of the next process above that adopts such ones."""
    reads, writes = os.pipe()
    between = os.fork()
    if between == 0:
        try:
            pid = os.fork()
            if pid == 0:
                _become(request, stdin, output)
            os.write(writes, b"%d" % pid)
        finally:
            os._exit(0)
    os.close(writes)
    os.waitpid(between, 0)
    with os.fdopen(reads, "rb") as pipe:
        return int(pipe.read() or b"0")


def _become(request: Mapping[str, Any], stdin: int, output: int) -> NoReturn:
    """Be the command that was asked for, from its beginning to its end."""
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
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:  # before the command could do anything about it
        code = 130
    except BaseException:  # noqa: BLE001  # nothing above this would say it
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
