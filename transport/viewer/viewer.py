"""The viewer: a web server that shows one run, recorded or live, to any number of browsers.

It only reads the run's log; a live run neither knows of it nor waits for it. Commands to a live run are the requests of
the command line.
"""

import asyncio
import io
import os
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any, Self

from transport.flight.live import Commands, LiveRun
from transport.flight.live import read as read_live_run
from transport.log.run_folder import open_run, setup_of
from transport.log.run_log import LogTail
from transport.scene.drawing import Drawing
from transport.scene.history import KINDS, RunHistory
from transport.scene.scene import Scene, SceneBuilder
from transport.viewer import html
from transport.viewer.panel import Panel, Playback
from transport.viewer.server import Guard, start_server
from transport.viewer.view3d import View3D

LOG = "run.mcap"
# Shortest time between two frames, s: of a recorded or paced run, and of a live run without pacing, which needs the
# processors itself.
_FRAME_S, _FRAME_UNPACED_S = 0.1, 0.5
# A page shows a frame before it gets the next, so that it is never behind by more than one; one that has shown none for
# this long, such as that of a hidden tab, is no longer waited for, s.
_PATIENCE_S = 2.0
# Priority of the viewer of a live run: the run gets the processors first, but requests are still sent in time.
_NICE = 10


class Viewer:
    """Viewer of one run.

    Args:
        builder: Scenes of the run.
        host: Address to listen on.
        port: First port to try; 0 for any.
        notice: Sentence to show on top of the panel, such as what a log lacks.
        tail: Log of a live run, read as it grows.
        live: The live run to send requests to; None for a recorded run.

    Attributes:
        shown: The scene in the current frame.
        notice: The sentence on top of the panel.
        address: URL for browsers; that of a live run, which a page can change, has a secret path.
        other_port: Sentence that the port is another than the requested one; empty if it is not.

    Raises: ViewerError: viser is not installed, or no port is free.
    """

    def __init__(
        self,
        builder: SceneBuilder,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        notice: str = "",
        tail: LogTail | None = None,
        live: LiveRun | None = None,
    ) -> None:
        self._builder, self._tail = builder, tail
        self.shown: Scene | None = None
        self._server, self._guard, self.address = start_server(host, port, secret=live is not None)
        self._pages: dict[int, _Page] = {}
        self._frame = 0
        got = self._server.get_port()
        self.other_port = "" if port in (0, got) else f"port {port} is taken; the viewer listens on port {got}"
        self.playback = Playback(builder.setup.settings.sampling_period_s, follows=live is not None)
        self.view3d = View3D(self._server, Drawing(builder))
        self.view3d.follow(live is not None)
        commands = None if live is None else Commands(live, self._show_result)
        self._panel = Panel(self._server, builder, self.playback, self._show_layer, self._look, self._follow, commands)
        self._paced = builder.setup.scenario.clock.speed > 0.0
        self._is_over = live is None
        self.notice = ""
        running = "live" if self._paced else f"live, without pacing: a frame every {_FRAME_UNPACED_S:g} s"
        self._set_notice(notice or ("" if live is None else running), warning=bool(notice))
        self._redraw = True
        self._server.on_client_connect(self._add_page)
        self._server.on_client_disconnect(self._remove_page)
        self._updated_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self) -> None:
        """Read the new part of the log and send a frame if there is anything new to show."""
        now_s = time.monotonic()
        history = self._builder.history
        if self._tail is not None:
            history.add(self._tail.read())
        if history.last < 0:
            return
        tick = self.playback.advance(now_s - self._updated_s, history.first, history.last)
        self._updated_s = now_s
        if not self._is_over and history.control is not None:
            self._end(history.control.outcome, history.control.reason)
        if not self._is_over and not self.clients():
            return  # a browser that connects gets the newest frame
        self._panel.show_playback()
        if any(page.is_busy(now_s) for page in list(self._pages.values())):
            return
        if self._redraw or self.shown is None or history.nearest(tick) != self.shown.tick:
            self._redraw = False
            self.shown = self._builder.at(tick)
            self._send(self.shown)

    def show_until(self, ended: Callable[[], bool]) -> None:
        """Show the run until `ended()`."""
        while not ended():
            self.update()
            time.sleep(_FRAME_S if self._is_over or self._paced else _FRAME_UNPACED_S)

    def clients(self) -> list[Any]:
        """Return the connected browsers, as viser knows them."""
        return list(self._server.get_clients().values())

    def close(self) -> None:
        """Stop the server and disconnect the browsers."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _send(self, scene: Scene) -> None:
        """Send one frame as a whole.

        viser sends updates from its event loop. Queued in that loop, inside an atomic block, they cannot be cut in two.
        """

        async def send() -> None:
            with self._server.atomic():
                self.view3d.show(scene)
                self._panel.show(scene)
            self._frame += 1
            for page in list(self._pages.values()):
                page.send(self._frame)

        asyncio.run_coroutine_threadsafe(send(), self._server.get_event_loop()).result()

    def _end(self, outcome: str, reason: str) -> None:
        self._is_over = True
        self.playback.follow(False)
        self._panel.close_controls()
        self._set_notice(f"the run has ended: {outcome}" + (f", {reason}" if reason else ""), warning=bool(reason))

    def _show_result(self, text: str, refused: bool) -> None:
        """Show the result of a request, unless the run has ended, which matters more."""
        if not self._is_over:
            self._set_notice(text, warning=refused)

    def _set_notice(self, text: str, *, warning: bool) -> None:
        self.notice = text
        self._panel.set_notice(text, warning=warning)

    def _add_page(self, client: Any) -> None:
        self._guard.shown[client.client_id] = self._frame
        self._pages[client.client_id] = _Page(client, self._guard, self._frame)
        self._redraw = True

    def _remove_page(self, client: Any) -> None:
        self._pages.pop(client.client_id, None)
        self._guard.shown.pop(client.client_id, None)

    def _look(self, team: bool) -> None:
        self.view3d.look_at(self.shown if team else None)

    def _follow(self, wanted: bool) -> None:
        self.view3d.follow(wanted, self.shown)

    def _show_layer(self, name: str, shown: bool) -> None:
        self.view3d.show_layer(name, shown)
        self._redraw = True


class _Page:
    """One page: its newest frames sent and shown."""

    def __init__(self, client: Any, guard: Guard, frame: int) -> None:
        self._number, self._guard = client.client_id, guard
        self._sent = self._shown = frame
        self._progress_s = time.monotonic()
        self._receipt = client.gui.add_html("")

    def send(self, frame: int) -> None:
        """Ask the page to tell when it shows a frame."""
        if self._sent == self._shown:
            self._progress_s = time.monotonic()
        self._sent = frame
        self._receipt.content = html.receipt(self._guard.receipt(self._number, frame))

    def is_busy(self, now_s: float) -> bool:
        """Return whether the page still draws a frame, and has shown one lately."""
        shown = self._guard.shown.get(self._number, self._sent)
        if shown > self._shown:
            self._shown, self._progress_s = shown, now_s
        return self._shown < self._sent and now_s - self._progress_s < _PATIENCE_S


def open_viewer(folder: Path, host: str, port: int) -> Viewer:
    """Return the viewer of the run in a folder, live or recorded, that listens on the first free port from `port` on.

    Raises: ViewerError, LogError: it cannot listen, or there is nothing to show; ScenarioError: the folder's scenario
        cannot be read.
    """
    running = read_live_run(folder)
    if running is not None:
        _lower_priority()
        setup = setup_of(folder)
        tail = LogTail(folder / LOG, KINDS, setup)
        return Viewer(SceneBuilder(setup, RunHistory(setup)), host=host, port=port, tail=tail, live=running)
    run = open_run(folder)
    builder = SceneBuilder.of(run.setup, run.log)
    if run.log.cut:
        sys.stderr.write(f"warning: {run.log.cut}\n")
    return Viewer(builder, host=host, port=port, notice=run.log.cut)


def _lower_priority() -> None:
    """Let the processes of the run have the processors first."""
    os.nice(_NICE)
    if os.getsid(0) == os.getpid():
        # Linux may share processors among sessions first; then only the session's priority counts (sched(7)).
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")
