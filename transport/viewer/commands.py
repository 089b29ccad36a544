"""`transport view`, and the viewer beside `transport run --view`."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from protocol.setup import Setup
    from transport.viewer.record import Record
    from transport.viewer.viewer import Viewer

_RUNS = Path("runs")
_LOG = "run.mcap"
_POLL_S = 0.1
_LEAVE_S = 5.0
# A run in flight gets the processor first.
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
    foxglove: Annotated[
        Path | None,
        typer.Option("--foxglove", metavar="FILE", help="Write a log with a 3D scene for Foxglove instead."),
    ] = None,
) -> None:
    """Show a run in the browser, recorded or in flight.

    Payload, rods, UAVs with attitude and thrust, flown and predicted paths, links by the age of plans and by loss.
    A run in flight can be acted on: links, killed and restarted agents. Ctrl-C ends the viewer, not the run.

    Example: transport view runs/20260102-101500-paper
    """
    from transport import live
    from transport.log import LogError
    from transport.viewer.viewer import ViewerError

    folder = _newest() if folder is None else folder
    deadline = time.monotonic() + wait
    while wait and not (live.read(folder) and (folder / _LOG).exists()) and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    try:
        if foxglove is not None:
            _export(folder, foxglove)
            return
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
        _fail(str(error), 2)


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
    from protocol.parent import PARENT_PIPE
    from transport.viewer.viewer import ViewerError, require_viser

    try:
        require_viser()
    except ViewerError as error:
        _fail(str(error), 2)
    arguments = ["view", str(folder), "--host", host, "--port", str(port), "--wait", str(wait_s)]
    process = subprocess.Popen(
        [sys.executable, "-m", "transport", *arguments],
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
    Raises: ViewerError, LogError: it cannot listen, or there is nothing to show. typer.Exit: no such folder.
    """
    from transport import live
    from transport.log_tail import LogTail
    from transport.viewer.record import Record
    from transport.viewer.scene import Scenes
    from transport.viewer.viewer import Viewer

    setup = _setup(folder)
    record = Record(setup)
    flying = live.read(folder)
    if flying is not None:
        os.nice(_NICE)
        tail = LogTail(folder / _LOG)
        return Viewer(Scenes(setup, record), host=host, port=port, tail=tail, live=flying)
    return Viewer(Scenes(setup, record), host=host, port=port, notice=_read(folder, record))


def _read(folder: Path, record: "Record") -> str:
    """Read a log that is complete, or as much as there is of it; what it lacks in a sentence."""
    from transport.gaps import missing
    from transport.log import LogError, read_log

    log = read_log(folder / _LOG)
    record.add(entry.message for entry in log.messages)
    if record.last < 0:
        raise LogError(f"{folder / _LOG}: expected the states of a flight, got none that can be read")
    lacking = "; ".join(filter(None, (log.cut, missing(log))))
    if lacking:
        typer.echo(f"transport: {folder / _LOG}: {lacking}", err=True)
    return lacking


def _export(folder: Path, out: Path) -> None:
    from transport.foxglove import write_foxglove
    from transport.viewer.record import Record
    from transport.viewer.scene import Scenes

    if out.exists():
        _fail(f"--foxglove: expected a file that does not exist yet, got {out}", 2)
    setup = _setup(folder)
    record = Record(setup)
    _read(folder, record)
    try:
        ticks = write_foxglove(Scenes(setup, record), folder / _LOG, out)
    except OSError as error:
        _fail(f"--foxglove: cannot write {out} ({error.strerror})", 2)
    typer.echo(f'{out}: {ticks} ticks for Foxglove; its 3D panel shows them in frame "map"', err=True)


def _setup(folder: Path) -> "Setup":
    from protocol.scenario_file import ScenarioError, read_scenario
    from protocol.setup import Setup

    path = folder / "scenario.toml"
    if not path.exists():
        _fail(f"expected a run folder with scenario.toml and {_LOG}, got {folder}", 2)
    try:
        return Setup.of(read_scenario(path), str(path))
    except ScenarioError as error:
        _fail(str(error), 3)


def _newest() -> Path:
    """The run started last of those below runs/."""
    logs = sorted(_RUNS.glob(f"*/{_LOG}"), key=lambda path: path.stat().st_mtime)
    if not logs:
        _fail(f"expected a run folder, got none, and there is none below {_RUNS}/", 2)
    return logs[-1].parent


def _parent_is_gone() -> Callable[[], bool]:
    """Whether the process this one was started to stand beside has ended; never for one started by a person."""
    from protocol.parent import PARENT_PIPE

    if not os.environ.get(PARENT_PIPE):
        return lambda: False
    gone = threading.Event()

    def watch() -> None:
        while os.read(0, 1):
            pass
        gone.set()

    threading.Thread(target=watch, name="parent", daemon=True).start()
    return gone.is_set


def _fail(text: str, code: int) -> NoReturn:
    typer.echo(f"transport: {text}", err=True)
    raise typer.Exit(code)
