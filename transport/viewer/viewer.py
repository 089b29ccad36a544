"""The viewer: a web server that shows one run, recorded or in flight, to any number of browsers.

It reads the run's log and nothing else. A run in flight neither knows nor waits for it: what it asks of one, it asks as
the command line does.
"""

import io
import math
import socket
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from transport.flight.live import LiveRun
from transport.log.tail import LogTail
from transport.scene.scene import Scene, Scenes
from transport.viewer.clock import Clock
from transport.viewer.commands import Commands
from transport.viewer.panel import Panel
from transport.viewer.view3d import Stage

if TYPE_CHECKING:
    import viser

# How often the scene is drawn anew, and the numbers beside it, at most. A run as fast as it goes leaves no time to
# others: where no processor is idle, whoever looks on waits, unless he turns the camera, and for a while after that.
_DRAW_S, _DRAW_LIVE_S, _DRAW_FAST_S, _DRAW_FULL_S, _NUMBERS_S = 0.05, 0.1, 0.5, 60.0, 0.2
_TURNED_S = 3.0
# A paced run is drawn less often, step by step, while fewer than _BUSY processors are idle, and more often again while
# more than _FREE are; what is idle is measured for so long before.
_GAPS_S = (_DRAW_LIVE_S, 0.2, 0.5, 1.0, 2.0)
_BUSY, _FREE, _JUDGED_S = 0.25, 0.75, 2.0
# The share of a processor that drawing and sending may take while the run flies: large teams are drawn less often, and
# all are if many look.
_SHARE_LIVE = 0.1
# What is said of a run in flight.
_PACED = "in flight"
_FAST = (
    f"in flight, as fast as it goes: where no processor is idle one picture in {_DRAW_FULL_S:g} s, more while you turn "
    "the camera; clock.speed paces it"
)
# How many ports to try from the one asked for.
_PORTS = 100


class ViewerError(RuntimeError):
    """The viewer cannot be had; the text says why and what to do."""


class Viewer:
    """Shows one run.

    Args:
        scenes: Of the run.
        host: Address to listen on.
        port: The first to try.
        notice: Sentence above everything else, such as what a log lacks.
        tail: What is still to come of the log of a run in flight.
        live: Where the run is asked for things; None if it does not fly.

    Attributes:
        shown: The scene that is drawn.
        notice: The sentence above everything else.
        address: Where browsers find it.

    Raises: ViewerError: viser is not installed, or no port is free.
    """

    def __init__(
        self,
        scenes: Scenes,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        notice: str = "",
        tail: LogTail | None = None,
        live: LiveRun | None = None,
    ) -> None:
        self._scenes, self._tail = scenes, tail
        self.shown: Scene | None = None
        self._server = _server(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        acts = None if live is None else Commands(live, self._answered)
        period_s = scenes.setup.settings.sampling_period_s
        self.clock = Clock(period_s, follows=live is not None, playing=False)
        self.stage = Stage(self._server, scenes)
        self._panel = Panel(self._server, scenes, self.clock, self._show_layer, self._look, acts)
        self.notice = ""
        paced = scenes.setup.scenario.clock.speed > 0.0
        self._say(notice or ("" if live is None else _PACED if paced else _FAST), warning=bool(notice))
        self._redraw = True
        self._over = live is None
        self._paced = paced
        self._drawn_s = self._numbers_s = 0.0
        self._turned_s = -math.inf
        self._server.on_client_connect(self._met)
        self._idle = IdleProcessors()
        self._spare = Spare(IdleProcessors().count)
        self._asked_s, self._used_s = time.monotonic(), time.process_time()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def work(self) -> None:
        """Read what has come and draw what is due: to be called in turn with `rest`."""
        now_s = time.monotonic()
        if self._tail is not None:
            self._scenes.record.add(self._tail.read())
        record = self._scenes.record
        if record.last < 0:
            return
        tick = self.clock.advance(now_s - self._asked_s, record.first, record.last)
        self._asked_s = now_s
        if not self._over and record.control is not None:
            self._end(record.control.outcome, record.control.reason)
        gap_s = self._gap_s(now_s)
        self._panel.set_pace(gap_s)
        if not self._over and not self._server.get_clients():
            return  # nobody looks: whoever comes is shown the newest then
        if gap_s > _DRAW_LIVE_S and not self._redraw and now_s < self._drawn_s + gap_s:
            return
        moved = self.shown is None or record.nearest(tick) != self.shown.tick
        numbers = now_s >= self._numbers_s + _NUMBERS_S
        if not (moved or self._redraw or (numbers and self._drawn_s > self._numbers_s)):
            return
        self._redraw = False
        if moved or self.shown is None:
            self.shown = self._scenes.at(tick)
        self.stage.show(self.shown)
        self._panel.show(self.shown, numbers=numbers)
        self._drawn_s = now_s
        if numbers:
            self._numbers_s = now_s

    def rest(self) -> None:
        """Wait until something may be due."""
        before_s, self._used_s = self._used_s, time.process_time()  # what is sent is sent while this rests
        time.sleep(_DRAW_S if self._over else pause_s(self._used_s - before_s, fast=self._follows_fast))

    def show_until(self, ended: Callable[[], bool]) -> None:
        """Show the run until that is so."""
        while not ended():
            self.work()
            self.rest()

    def close(self) -> None:
        """Stop the server; browsers are told that the connection is gone."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _gap_s(self, now_s: float) -> float:
        """How long what is shown may be left as it is, s."""
        if self._over:
            return 0.0
        spare_s = self._spare.gap_s(now_s) if self._paced else 0.0
        if not self.clock.follows or now_s < self._turned_s + _TURNED_S:
            return _DRAW_LIVE_S
        if self._paced:
            return spare_s
        return _DRAW_FULL_S if self._idle.count() < 1.0 else _DRAW_LIVE_S

    @property
    def _follows_fast(self) -> bool:
        """Whether what is shown is the newest of a run as fast as it goes."""
        return self.clock.follows and not self._paced and not self._over

    def _end(self, outcome: str, reason: str) -> None:
        self._over = True
        self.clock.follow(False)
        self._panel.close_controls()
        self._say(f"the run has ended: {outcome}" + (f", {reason}" if reason else ""), warning=bool(reason))

    def _answered(self, text: str, refused: bool) -> None:
        """What came of an act, as long as the run flies: how it has ended says more."""
        if not self._over:
            self._say(text, warning=refused)

    def _say(self, text: str, *, warning: bool) -> None:
        self.notice = text
        self._panel.say(text, warning=warning)

    def _met(self, client: "viser.ClientHandle") -> None:
        """A browser has come, and is shown the newest. It tells where its camera is as it comes, too."""
        self._redraw = True
        seen = _pose(client.camera)

        @client.camera.on_update
        def turned(camera: "viser.CameraHandle") -> None:
            nonlocal seen
            before, seen = seen, _pose(camera)
            if seen != before:
                self._turned_s = time.monotonic()

    def _look(self, team: bool) -> None:
        self.stage.look_at(self.shown if team else None)

    def _show_layer(self, name: str, shown: bool) -> None:
        self.stage.show_layer(name, shown)
        self._redraw = True


def _pose(camera: "viser.CameraHandle") -> tuple[float, ...]:
    return *camera.position, *camera.wxyz


def pause_s(used_s: float, *, fast: bool) -> float:
    """How long to wait before a run in flight is drawn again, s.

    Args:
        used_s: Processor time that it took last.
        fast: Whether what is shown follows a run as fast as it goes.
    """
    return max(_DRAW_FAST_S if fast else _DRAW_LIVE_S, used_s / _SHARE_LIVE)


class Spare:
    """How often a paced run is drawn: as often as leaves it room.

    Args:
        idle: Tells how many processors have had nothing to do since it was asked last.
    """

    def __init__(self, idle: Callable[[], float]) -> None:
        self._idle = idle
        self._judged_s: float | None = None
        self._step = 0

    def gap_s(self, now_s: float) -> float:
        """The least time between two pictures at a time of the monotonic clock, s."""
        if self._judged_s is None:
            self._judged_s = now_s
        if now_s >= self._judged_s + _JUDGED_S:
            self._judged_s, idle = now_s, self._idle()
            change = 1 if idle < _BUSY else -1 if idle > _FREE else 0
            self._step = min(max(0, self._step + change), len(_GAPS_S) - 1)
        return _GAPS_S[self._step]


class IdleProcessors:
    """How many processors of this machine have nothing to do.

    Args:
        path: Where a Linux kernel counts their time.
    """

    def __init__(self, path: Path = Path("/proc/stat")) -> None:
        self._path = path
        self._before = self._read()

    def count(self) -> float:
        """The mean since it was asked last; as many as one likes where the system does not tell."""
        before, now = self._before, self._read()
        self._before = now
        if now is None or before is None:
            return math.inf
        idle, total, processors = now
        idle_before, total_before, _ = before
        return processors * (idle - idle_before) / max(1, total - total_before)

    def _read(self) -> tuple[int, int, int] | None:
        """Time idle, all time, in the kernel's ticks since it started; number of processors."""
        try:
            lines = self._path.read_text(encoding="ascii").splitlines()
            times = [int(word) for word in lines[0].split()[1:9]]  # what guests take is in user time already
        except (OSError, ValueError, IndexError):
            return None
        return times[3] + times[4], sum(times), sum(line.startswith("cpu") for line in lines) - 1


def require_viser() -> None:
    """Refuse before anything is started.

    Raises: ViewerError: viser is not installed.
    """
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise ViewerError("viser is not installed; pip install 'payload-transport[view]' brings it")


def _server(host: str, port: int) -> "viser.ViserServer":
    require_viser()
    import viser

    _check_port(host, port)
    with redirect_stdout(io.StringIO()):  # results alone go there, and it would say where it listens
        return viser.ViserServer(host=host, port=port, verbose=False)


def _check_port(host: str, port: int) -> None:
    """Refuse what cannot be listened on: the server would wait for ever. Taken ports are passed over."""
    for candidate in range(port, port + _PORTS) if port else (0,):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
            except (OSError, OverflowError) as error:
                text, number = str(error), getattr(error, "errno", None)
                if number in (98, 48):  # in use, on Linux and elsewhere
                    continue
                raise ViewerError(f"--host, --port: cannot listen on {host}:{candidate} ({text})") from error
        return
    raise ViewerError(f"--port: expected a free port from {port} on, got none in {_PORTS}")
