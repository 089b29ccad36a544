"""`transport view`, and the viewer beside `transport run --view`."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.answers import fail
from transport.cli.operate import RUNS

if TYPE_CHECKING:
    from transport.viewer.viewer import Viewer


_LOG = "run.mcap"
_POLL_S = 0.1
_LEAVE_S = 5.0
# A run in flight gets the processor first; but whoever presses a button is not to wait for it to end.
_NICE = 10

HostOption = Annotated[
    str,
    typer.Option("--host", help="Address to listen on. Whoever can reach it sees the run, and can act on a live one."),
]
PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="Port, or the next one that is free.")]


def view(
    folder: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="Run folder; by default the newest below runs/.")
    ] = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    wait: Annotated[
        float, typer.Option("--wait", min=0.0, help="Seconds to wait for the run, if it is yet to be started.")
    ] = 0.0,
) -> None:
    """Show a run in the browser, recorded or in flight.

    Payload, rods, UAVs with attitude and thrust, flown and predicted paths, links by the age of plans and by loss.
    A run in flight can be acted on: links, killed and restarted agents. Ctrl-C ends the viewer, not the run.

    Example: transport view runs/20260102-101500-paper
    """
    from protocol.scenario.file import ScenarioError
    from transport.log.run_log import LogError
    from transport.viewer.viewer import ViewerError

    folder = _newest() if folder is None else folder
    try:
        _await(folder, wait)
        # Where to look is the only result; viser would add to it that it has stopped.
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
    """A viewer in a process of its own, which shows the run in a folder as soon as it flies.

    Args:
        folder: Run folder, yet to be made.
        host: Address it listens on.
        port: The first it tries.
        wait_s: How long it waits for the run.
    Yields: What waits until a person ends it.
    """
    from protocol.network.parent import PARENT_PIPE, python
    from transport.viewer.viewer import ViewerError, require_viser

    try:
        require_viser()
    except ViewerError as error:
        fail(str(error), EXIT_USAGE)
    arguments = ["view", str(folder), "--host", host, "--port", str(port), "--wait", str(wait_s)]
    process = subprocess.Popen(
        [*python("transport"), *arguments],
        stdin=subprocess.PIPE,
        stdout=2,  # where to look is no result of a run
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


def viewer_of(folder: Path, host: str, port: int) -> "Viewer":
    """The viewer of the run in a folder, in flight or recorded.

    Args:
        folder: Run folder.
        host: Address to listen on.
        port: The first to try; 0 for any.
    Raises: ViewerError, LogError: it cannot listen, or there is nothing to show; ScenarioError: the folder's scenario
        cannot be read.
    """
    from transport.flight import live
    from transport.log.run_folder import open_run, setup_of
    from transport.log.tail import LogTail
    from transport.scene.record import KINDS, LATER, Record
    from transport.scene.scene import Scenes
    from transport.viewer.viewer import Viewer

    flying = live.read(folder)
    if flying is not None:
        _stand_back()
        setup = setup_of(folder)
        tail = LogTail(folder / _LOG, KINDS, LATER)
        return Viewer(Scenes(setup, Record(setup)), host=host, port=port, tail=tail, live=flying)
    run = open_run(folder)
    scenes = Scenes.of(run.setup, run.log)
    if run.log.cut:
        typer.echo(f"warning: {run.log.cut}", err=True)
    return Viewer(scenes, host=host, port=port, notice=run.log.cut)


def _await(folder: Path, patience_s: float) -> None:
    """Wait until a run flies that is yet to be started."""
    from transport.flight import live

    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline and not (live.read(folder) and (folder / _LOG).exists()):
        time.sleep(_POLL_S)


def _stand_back() -> None:
    """Leave the processors to the run."""
    os.nice(_NICE)
    if os.getsid(0) == os.getpid():
        # Linux may share processors among sessions first; then only that of the session counts (sched(7)).
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")


def _newest() -> Path:
    """The run started last of those below runs/."""
    logs = sorted(RUNS.glob(f"*/{_LOG}"), key=lambda path: path.stat().st_mtime)
    if not logs:
        fail(f"expected a run folder, got none, and there is none below {RUNS}/", EXIT_USAGE)
    return logs[-1].parent


def _parent_is_gone() -> Callable[[], bool]:
    """Whether the process this one was started to stand beside has ended; never for one started by a person."""
    from protocol.network.parent import PARENT_PIPE

    if not os.environ.get(PARENT_PIPE):
        return lambda: False
    gone = threading.Event()

    def watch() -> None:
        while os.read(0, 1):
            pass
        gone.set()

    threading.Thread(target=watch, name="parent", daemon=True).start()
    return gone.is_set
