"""The viewer: a web server that shows one run, recorded or live, to any number of browsers.

It only reads the run's log; a live run neither knows of it nor waits for it. Commands to a live run
are the requests of the command line.
"""

import asyncio
import io
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any, Self

from transport.flight.active_runs import Commands, LiveRun
from transport.flight.active_runs import read as read_live_run
from transport.log.run_folder import open_run, setup_of
from transport.log.run_log import LogTail
from transport.scene.drawn_paths_links_and_thrust import Drawing
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.viewer.panel_controls import Panel
from transport.viewer.playback import Playback
from transport.viewer.server import Page, start_server
from transport.viewer.view3d import View3D

LOG = "run.mcap"
_LIVE = "live"  # notice of an active run
# Shortest time between frames, s; a run without pacing needs the processors itself.
_FRAME_S = 0.1
_FRAME_UNPACED_S = 0.5
# A page shows a frame before it gets the next, so that it is never behind by more than one. One that
# has shown none for this long, such as that of a hidden tab, does not keep other pages waiting, s. Where
# all pages are so slow, the frames between are dropped: this time doubles with each frame that is not
# shown, up to the longest.
_PATIENCE_S = 2.0
_LONGEST_PATIENCE_S = 30.0
# Time for which the result of a request is shown on top of the panel, s.
_RESULT_S = 30.0
# Priority of the viewer of a live run: the run gets the processors first, but requests are still
# sent in time.
_NICE = 10


class Viewer:
    """Viewer of one run, on the first free port from `port` on, or on any for 0.

    Its URL for browsers is `address`. A live run has a log that is read as it grows, and takes
    requests. A notice, such as the name of a missing part of a log, is on top of the panel.

    Raises: ViewerError: viser is not installed, or no port is free.
    """

    def __init__(
        self, builder: SceneBuilder, *, host: str = "127.0.0.1", port: int = 8080, notice: str = "",
        tail: LogTail | None = None, live: LiveRun | None = None,
    ) -> None:  # fmt: skip
        self._builder = builder
        self._tail = tail
        self._is_over = live is None
        self._paced = builder.setup.scenario.clock.speed > 0.0
        self._frame = 0  # number of the newest frame

        name = builder.setup.scenario.name
        title = f"{name}, active run" if live is not None else f"{name}, recorded run"
        self._server, self._guard, self.address = start_server(host, port, title)
        self.playback = Playback(builder.setup.settings.sampling_period_s, follows=live is not None)
        self.view3d = View3D(self._server, Drawing(builder), builder, follows=live is not None)
        commands = None if live is None else Commands(live, self._show_result)
        self._panel = Panel(self._server, builder, self.playback, self.view3d, commands)
        self._result_ends_s = math.inf
        self._set_notice(notice or ("" if live is None else _LIVE), warning=bool(notice))

        self._server.on_client_connect(self._add_page)
        self._server.on_client_disconnect(self._remove_page)
        self._updated_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def shown(self) -> Scene | None:
        """The scene in the current frame."""
        return self.view3d.shown

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
        self._notice_end()
        pages = list(self._guard.receipts.pages.values())
        if not self._is_over and not pages:
            return  # a page that connects gets the newest frame
        self._panel.show_playback()

        self._end_result(now_s)
        if not may_send(pages, now_s):
            return
        is_first = self.shown is None or any(not page.sent for page in pages)
        if is_first or self.shown is None or history.nearest(tick) != self.shown.tick:
            asyncio.run_coroutine_threadsafe(
                self._send(self._builder.at(tick)), self._server.get_event_loop()
            ).result()

    def _notice_end(self) -> None:
        """Close the controls of an active run once its end has been read."""
        control = self._builder.history.control
        if self._is_over or control is None:
            return
        self._is_over = True
        self.playback.follow(False)
        self._panel.close_controls()
        reason = f", {control.reason}" if control.reason else ""
        self._set_notice(f"the run has ended: {control.outcome}{reason}", warning=bool(reason))

    def show_until(self, ended: Callable[[], bool]) -> None:
        """Show the run until `ended()`."""
        while not ended():
            self.update()
            time.sleep(_FRAME_S if self._is_over or self._paced else _FRAME_UNPACED_S)

    def close(self) -> None:
        """Stop the server and disconnect the browsers."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    async def _send(self, scene: Scene) -> None:
        """Send one frame as a whole, and ask the pages to tell when they show it.

        viser sends updates from its event loop. Queued in that loop, inside an atomic block, they
        cannot be cut in two.
        """
        with self._server.atomic():
            self.view3d.show(scene)
            self._panel.show(scene, self._behind_s())
        self._frame += 1
        for number, page in list(self._guard.receipts.pages.items()):
            if not page.sent:
                self.view3d.place_camera(page.client)
            page.send(self._frame, time.monotonic())
            source = f"{self._guard.path}/shown/{number}/{self._frame}"  # of an invisible image
            page.receipt.content = f'<img src="{source}" alt="" style="display:none">'

    def _behind_s(self) -> float | None:
        """Return how long ago the newest tick of an active run was recorded that pages show, s.

        It is the age of the newest entry of the log and the time that the slowest page takes for a
        frame. None for a recorded run, and where another tick than the newest is shown.
        """
        if self._is_over or self._tail is None or not self.playback.follows:
            return None
        pages = self._guard.receipts.pages.values()
        log_s = time.time() - self._tail.newest_ns / 1e9
        return max(0.0, log_s) + max((page.lag_s for page in pages), default=0.0)

    def _show_result(self, text: str, refused: bool) -> None:
        """Show the result of a request for a time, unless the run has ended, which matters more."""
        if not self._is_over:
            self._set_notice(text, warning=refused)
            self._result_ends_s = time.monotonic() + _RESULT_S

    def _end_result(self, now_s: float) -> None:
        """Replace the result of a request whose time is over."""
        if now_s >= self._result_ends_s and not self._is_over:
            self._result_ends_s = math.inf
            self._set_notice(_LIVE, warning=False)

    def _set_notice(self, text: str, *, warning: bool) -> None:
        self.notice = text
        self._panel.set_notice(text, warning=warning)

    def _add_page(self, client: Any) -> None:
        self._guard.receipts.pages[client.client_id] = Page(client, client.gui.add_html(""))

    def _remove_page(self, client: Any) -> None:
        self._guard.receipts.pages.pop(client.client_id, None)


def may_send(pages: Sequence[Page], now_s: float) -> bool:
    """Return whether a frame may be sent: pages show the newest one, or are not waited for any more.

    One slow page does not keep the others waiting for longer than `_PATIENCE_S`. If all are slow, they
    get fewer frames, so that none waits in their queues.
    """
    slow = [page for page in pages if page.unshown_since_s is not None]
    are_all = len(slow) == len(pages)  # no page shows the newest frame
    return not any(_is_awaited(page, now_s, are_all=are_all) for page in slow)


def _is_awaited(page: Page, now_s: float, *, are_all: bool) -> bool:
    """Return whether a page that does not show its newest frame is still waited for.

    Beside pages that show theirs, one that has missed a frame before is not: it would hold them up each time.
    """
    if page.unshown_since_s is None or (page.unshown > 1 and not are_all):
        return False
    patience_s = _PATIENCE_S
    if are_all:
        patience_s = min(_PATIENCE_S * 2.0 ** (page.unshown - 1), _LONGEST_PATIENCE_S)
    return now_s - page.unshown_since_s < patience_s


def open_viewer(folder: Path, host: str, port: int) -> Viewer:
    """Return the viewer of the run in a folder, live or recorded.

    Raises: ViewerError, LogError, ScenarioError.
    """
    running = read_live_run(folder)
    if running is not None:
        os.nice(_NICE)
        if os.getsid(0) == os.getpid():
            # Linux may share processors among sessions first; then only the session's priority
            # counts (sched(7)).
            with suppress(OSError):
                Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")
        setup = setup_of(folder)
        tail = LogTail(folder / LOG, setup)
        return Viewer(
            SceneBuilder(setup, RunHistory(setup)), host=host, port=port, tail=tail, live=running
        )
    run = open_run(folder)
    builder = SceneBuilder.of(run.setup, run.log)
    if run.log.cut:
        sys.stderr.write(f"warning: {run.log.cut}\n")
    return Viewer(builder, host=host, port=port, notice=run.log.cut)
