"""The viewer as a separate process beside the run that `transport run --view` starts."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from protocol.network.parent import PARENT_PIPE, python

_EXIT_S = 5.0


@dataclass(frozen=True, slots=True)
class ViewerBeside:
    """A viewer process beside a run.

    Attributes:
        wait_until_ready: Waits until a browser can open the viewer, or it has ended, for a limited time.
        wait_for_user: Waits until the user ends the viewer.
    """

    wait_until_ready: Callable[[], None]
    wait_for_user: Callable[[], None]


@contextmanager
def viewer_beside(folder: Path, host: str, port: int, wait_s: float) -> Iterator[ViewerBeside]:
    """Start a viewer process that shows the run in a folder as soon as it is live, and end it afterwards.

    The folder need not exist yet: the viewer waits `wait_s` seconds for it.
    """
    arguments = ["view", str(folder), "--host", host, "--port", str(port), "--wait", str(wait_s)]
    process = subprocess.Popen(
        [*python("transport"), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, PARENT_PIPE: "1"},
        start_new_session=True,  # Ctrl-C ends the run first
    )

    ready = threading.Event()

    def pass_on() -> None:
        """Write the address, which is no result of the run, to standard error."""
        for line in process.stdout or ():
            sys.stderr.write(line)
            sys.stderr.flush()
            ready.set()
        ready.set()  # it has ended

    threading.Thread(target=pass_on, name="viewer", daemon=True).start()

    def wait_until_ready() -> None:
        ready.wait(wait_s / 2.0)

    def wait_for_user() -> None:
        if process.poll() is None:
            try:
                sys.stderr.write("the viewer stays open; Ctrl-C ends it\n")
                process.wait()
            except KeyboardInterrupt:
                return

    try:
        yield ViewerBeside(wait_until_ready, wait_for_user)
    finally:
        process.terminate()
        try:
            process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_EXIT_S)  # a tracer may keep it for longer
        if process.stdin is not None:
            process.stdin.close()


def parent_ended() -> Callable[[], bool]:
    """Return a function that tells whether the parent run has ended; always False without such a parent."""
    if not os.environ.get(PARENT_PIPE):
        return lambda: False
    ended = threading.Event()

    def watch() -> None:
        while os.read(0, 1):
            pass
        ended.set()

    threading.Thread(target=watch, name="parent", daemon=True).start()
    return ended.is_set
