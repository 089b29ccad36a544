"""The command `transport view`, and the viewer beside `transport run --view`."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from protocol.network.parent import PARENT_PIPE, python
from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.options import RUNS, HostOption, PortOption
from transport.cli.output import exit_on, fail
from transport.flight import live
from transport.log.run_folder import open_run, setup_of
from transport.log.run_log import LogError
from transport.log.tail import LogTail
from transport.scene.record import KINDS, LATER, Record
from transport.scene.scene import Scenes
from transport.viewer.viewer import Viewer, ViewerError, require_viser

_LOG = "run.mcap"
_POLL_S = 0.1
_LEAVE_S = 5.0
# Niceness of the viewer: the run gets the processor first, but the viewer still answers.
_NICE = 10


def view(
    folder: Annotated[Path | None, Argument(metavar="RUN", help="Run folder; by default the newest in runs/.")] = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    wait: Annotated[float, Option("--wait", min=0.0, help="Seconds to wait for the run to start.")] = 0.0,
) -> None:
    """Show a recorded or active run in the browser.

    Payload, rods, UAVs with attitude and thrust, flown and predicted paths, links by plan age and by packet loss. In
    an active run, links can be impaired and agents killed and restarted. Ctrl-C ends the viewer, not the run.

    Example: transport view runs/20260102-101500-paper
    """
    folder = _newest() if folder is None else folder
    try:
        _await(folder, wait)
        # The address is the only result on standard output; viser prints there too.
        result = sys.stdout
        with redirect_stdout(sys.stderr), viewer_of(folder, host, port) as viewer:
            typer.echo(viewer.address, file=result)
            result.flush()
            typer.echo(f"showing {folder}; Ctrl-C ends it", err=True)
            viewer.show_until(_parent_is_gone())
    except KeyboardInterrupt:
        return
    except (LogError, ViewerError) as error:
        fail(str(error), EXIT_USAGE)
    except ScenarioError as error:
        fail(str(error), EXIT_SCENARIO)


@contextmanager
def viewer_beside(folder: Path, host: str, port: int, wait_s: float) -> Iterator[Callable[[], None]]:
    """Start a viewer in a separate process, which shows the run in a folder as soon as it is active.

    Args:
        folder: Run folder, which need not exist yet.
        host: Address to listen on.
        port: First port to try.
        wait_s: Time to wait for the run, s.
    Yields: A function that waits until the user ends the viewer.
    """
    with exit_on(ViewerError, code=EXIT_USAGE):
        require_viser()
    arguments = ["view", str(folder), "--host", host, "--port", str(port), "--wait", str(wait_s)]
    process = subprocess.Popen(
        [*python("transport"), *arguments],
        stdin=subprocess.PIPE,
        stdout=2,  # the address is no result of the run
        env={**os.environ, PARENT_PIPE: "1"},
        start_new_session=True,  # Ctrl-C ends the run first
    )

    def linger() -> None:
        if process.poll() is None:
            try:
                typer.echo("the viewer stays open; Ctrl-C ends it", err=True)
                process.wait()
            except KeyboardInterrupt:
                return

    try:
        yield linger
    finally:
        process.terminate()
        try:
            process.wait(_LEAVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()


def viewer_of(folder: Path, host: str, port: int) -> Viewer:
    """Return the viewer of an active or recorded run.

    Args:
        folder: Run folder.
        host: Address to listen on.
        port: First port to try; 0 for any.
    Raises: ViewerError, LogError: it cannot listen, or there is nothing to show; ScenarioError: the folder's scenario
        cannot be read.
    """
    active = live.read(folder)
    if active is not None:
        _stand_back()
        setup = setup_of(folder)
        tail = LogTail(folder / _LOG, KINDS, LATER)
        return Viewer(Scenes(setup, Record(setup)), host=host, port=port, tail=tail, live=active)
    run = open_run(folder)
    scenes = Scenes.of(run.setup, run.log)
    if run.log.cut:
        typer.echo(f"warning: {run.log.cut}", err=True)
    return Viewer(scenes, host=host, port=port, notice=run.log.cut)


def _await(folder: Path, patience_s: float) -> None:
    """Wait until the run in a folder is active."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline and not (live.read(folder) and (folder / _LOG).exists()):
        time.sleep(_POLL_S)


def _stand_back() -> None:
    """Lower the priority of this process below that of the run."""
    os.nice(_NICE)
    if os.getsid(0) == os.getpid():
        # With autogroups Linux weighs sessions, and only the niceness of the session counts (sched(7)).
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")


def _newest() -> Path:
    """Return the folder in runs/ whose log was written last."""
    logs = sorted(RUNS.glob(f"*/{_LOG}"), key=lambda path: path.stat().st_mtime)
    if not logs:
        fail(f"expected a run folder, got none, and there is none in {RUNS}/", EXIT_USAGE)
    return logs[-1].parent


def _parent_is_gone() -> Callable[[], bool]:
    """Return a function that tells whether `transport run --view` has ended; always False without one."""
    if not os.environ.get(PARENT_PIPE):
        return lambda: False
    gone = threading.Event()

    def watch() -> None:
        while os.read(0, 1):
            pass
        gone.set()

    threading.Thread(target=watch, name="parent", daemon=True).start()
    return gone.is_set
