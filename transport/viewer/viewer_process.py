"""The viewer as a separate process beside the run that `transport run --view` starts."""

import os
import select
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Self

from transport.flight.signals import take_interrupt
from transport.protocol.network.parent_and_environment import PARENT_PIPE, python

_EXIT_S = 5.0


class ViewerBeside:
    """A viewer process that shows the run in a folder as soon as it is live.

    The folder need not exist yet; the process waits for at most `wait_s` seconds. As a context it
    ends the process at its end.
    """

    def __init__(self, folder: Path, host: str, port: int, wait_s: float) -> None:
        arguments = [
            "view",
            str(folder),
            "--host",
            host,
            "--port",
            str(port),
            "--wait",
            str(wait_s),
        ]
        self._process = subprocess.Popen(
            [*python("transport"), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, PARENT_PIPE: "1"},
            start_new_session=True,  # Ctrl-C ends the run first
        )

    def wait_until_ready(self) -> None:
        """Wait until a browser can open the viewer, or it has ended.

        Its address goes to standard error.
        """
        if self._process.stdout is not None:
            sys.stderr.write(self._process.stdout.readline())
            sys.stderr.flush()

    def wait_for_user(self) -> None:
        """Wait until the user ends the viewer."""
        if self._process.poll() is None:
            try:
                sys.stderr.write("the viewer stays open; Ctrl-C ends it\n")
                self._process.wait()
            except KeyboardInterrupt:
                take_interrupt()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.communicate(timeout=_EXIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()


def parent_ended() -> Callable[[], bool]:
    """Return a function that tells whether the parent run has ended.

    Always False without such a parent.
    """
    if not os.environ.get(PARENT_PIPE):
        return lambda: False
    # Its end of the pipe is closed with it; it never sends anything.
    return lambda: bool(select.select([0], [], [], 0.0)[0]) and not os.read(0, 1)
