"""What being watched costs: a flight as fast as it goes, by turns with nobody, with the viewer, with three browsers."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle, pairwise
from pathlib import Path
from threading import Event, Thread

import numpy as np

from benchmarks import processes
from benchmarks.effort import Effort
from benchmarks.flights import setup
from benchmarks.page import Table
from benchmarks.timing import digits
from model.arrays import Array
from protocol.messages import Truth
from transport.harness import free_ports
from transport.log import RunLog, read_log

NOBODY, VIEWER, BROWSERS = "nobody", "the viewer", "the viewer and 3 browsers"

TEXT = (
    "What being watched costs: one flight of `resilient` as fast as it goes, with the viewer and three windows of "
    "headless Chromium beside it, 900 x 600 pixels, on the same machine and without a graphics processor. By turns all "
    "of them are frozen, the browsers alone, and none, for {block:g} s each; the first {skip:g} s after each change do "
    "not count. Real-time factor, median of {turns} turns (least to most); loss: by how much it is lower than while "
    "nobody watched in the same turn. Once the pages are open, browsers have the lowest priority (nice 19), the viewer "
    "has a low one (nice 10), their sessions as well."
)

_HOST = "127.0.0.1"
_WAIT_S, _LEAVE_S = 60, 10
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
HEADLESS = (
    "--headless=new",
    "--no-sandbox",  # of no use in a container, where it cannot be had
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=900,600",
)
_STAYS = "--remote-debugging-port=0"  # else it ends as soon as the page is loaded
# How long each turn takes, and how long what was frozen takes to catch up, s.
_BLOCK_S, _SKIP_S = 2.0, 0.5
_LOWEST = 19


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly with processes, watched and not."""
    run = setup("resilient", effort.watched)
    chromium = next(filter(None, map(shutil.which, _CHROMIUM)), None)
    cases = (NOBODY, VIEWER, BROWSERS) if chromium else (NOBODY, VIEWER)
    changes: list[tuple[int, str]] = []
    with tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        say(f"{run.maneuver.duration_s:g} s, by turns watched by {', '.join(cases)}")
        at, ended = Path(folder) / "flight", Event()
        with free_ports(_HOST, 1) as ports:
            port = ports[0]
        words = ("view", str(at), "--port", str(port), "--wait", str(_WAIT_S))
        viewer = stack.enter_context(_started([sys.executable, "-m", "transport", *words]))

        def alternate() -> None:
            with ExitStack() as windows:
                browsers = [
                    windows.enter_context(
                        _started(
                            [str(chromium), *HEADLESS, _STAYS, f"--user-data-dir={at}-{k}", f"http://{_HOST}:{port}"]
                        )
                    )
                    for k in range(3 if chromium and _wait(lambda: _listens(port), ended) else 0)
                ]
                if not _wait(lambda: _connections(port) >= len(browsers), ended):
                    return
                for process in browsers:
                    _lower(process)
                for name in cycle(cases):
                    _freeze(viewer, name == NOBODY)
                    for process in browsers:
                        _freeze(process, name != BROWSERS)
                    changes.append((time.time_ns(), name))
                    if ended.wait(_BLOCK_S):
                        return

        thread = Thread(target=alternate)
        thread.start()
        try:
            processes.recorded(run, at)
        finally:
            changes.append((time.time_ns(), ""))
            ended.set()
            thread.join()
        factors = turns(read_log(at / "run.mcap"), changes, cases, run.settings.sampling_period_s)
    rows = [_row(name, factors[:, k], factors[:, 0]) for k, name in enumerate(cases)]
    if chromium is None:
        rows.append((BROWSERS, "no Chromium", "-"))
    text = TEXT.format(block=_BLOCK_S, skip=_SKIP_S, turns=len(factors))
    return [Table(text=text, columns=("watched by", "real-time factor", "loss, %"), rows=rows)]


def turns(log: RunLog, changes: Sequence[tuple[int, str]], cases: Sequence[str], period_s: float) -> Array:
    """Real-time factors of the turns that are whole.

    Args:
        log: Of the flight.
        changes: When who began to watch, ns since 1970; the last is the end.
        cases: Who watches, in the order of a turn.
        period_s: Sampling period, s.
    Returns: (turns, cases).
    """
    at_ns = np.array(sorted(log.received_ns(Truth).values()))
    found = []
    for (begin_ns, _), (end_ns, _) in pairwise(changes):
        inside = at_ns[(at_ns >= begin_ns + _SKIP_S * 1e9) & (at_ns < end_ns)]
        if end_ns - begin_ns >= _BLOCK_S * 1e9 and len(inside) > 1:
            found.append((len(inside) - 1) * period_s / (float(inside[-1] - inside[0]) / 1e9))
    whole = len(found) // len(cases)
    return np.array(found[: whole * len(cases)]).reshape(whole, len(cases))


def _row(name: str, factors: Array, alone: Array) -> tuple[str, str, str]:
    if not len(factors):
        return name, "-", "-"
    losses = 100.0 * (1.0 - factors / alone)
    loss = f"{np.median(losses):.1f} ({losses.min():.1f} to {losses.max():.1f})"
    spread = f"{digits(float(np.median(factors)))} ({digits(float(factors.min()))} to {digits(float(factors.max()))})"
    return name, spread, "-" if name == NOBODY else loss


def _wait(condition: Callable[[], bool], ended: Event) -> bool:
    """Wait until something is so; False if the flight has ended before."""
    while not condition():
        if ended.wait(0.2):
            return False
    return True


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection((_HOST, port)):
        return True
    return False


def _connections(port: int) -> int:
    """How many are connected to a port of this machine, by the table of a Linux kernel."""
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    return sum(line.split()[1].endswith(f":{port:04X}") and line.split()[3] == "01" for line in lines)


def _lower(process: "subprocess.Popen[bytes]") -> None:
    """Give a process and its children the lowest priority."""
    os.setpriority(os.PRIO_PGRP, process.pid, _LOWEST)
    with suppress(OSError):  # where Linux shares processors among sessions first
        Path(f"/proc/{process.pid}/autogroup").write_text(str(_LOWEST), encoding="ascii")


def _freeze(process: "subprocess.Popen[bytes]", frozen: bool) -> None:
    os.killpg(process.pid, signal.SIGSTOP if frozen else signal.SIGCONT)


@contextmanager
def _started(command: Sequence[str]) -> Iterator["subprocess.Popen[bytes]"]:
    """A command in a session of its own, which is gone afterwards."""
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            for number in (signal.SIGTERM, signal.SIGCONT):
                os.killpg(process.pid, number)
            try:
                process.wait(_LEAVE_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
