"""What being watched costs: flights as fast as they go, by turns with nobody, the viewer, and those who look on."""

import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from protocol.setup import Setup
from transport.harness import free_ports
from transport.log import RunLog, read_log
from transport.viewer.viewer import DRAW_FULL_S

NOBODY = "nobody"

# Who looks on besides the viewer, and whether they draw on this machine.
WATCHERS: Mapping[str, bool] = {"3 browsers on other machines": False, "3 browsers here": True}

TEXT = (
    "What being watched costs: `resilient` as fast as it goes, with the viewer and those who look on beside it: three "
    "windows of headless Chromium, 900 x 600 pixels, on the same machine and without a graphics processor, or three "
    "connections on which all is read that a browser is sent, as if it drew on another machine. One flight for each "
    "kind; in each, by turns, all of them are frozen for {alone:g} s, and none for {watched:g} s; the first {skip:g} s "
    "after each change do not count. Real-time factor, median of all turns (least to most). Loss: by how much it is "
    "lower than while nobody watched in the same turn, median (quartiles). Processors: how many the viewer keeps busy, "
    "and those who look on, mean. Opening: processor time of the viewer and of those who look on, from the start of "
    "the latter until {opened:g} s after all were connected, once. Browsers have the priority of any program; the "
    "viewer has nice 10, and so has its session."
)

PACED = (
    "`resilient` at real speed (`clock.speed=1`, lockstep), whole flights by turns with nobody and with the viewer and "
    "three such windows on the same machine, which open as the flight begins. Real-time factor, median (least to most)."
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
# How long what was frozen takes to catch up, and how long the parts of a turn take, s. What counts of the watched one
# is as long as a page that is held back goes without a picture: there is one in it. Were browsers frozen longer than
# the viewer, or any of them for much longer, they would be given up, and load all anew.
_SKIP_S = 2.0
_BLOCKS_S = (22.0, DRAW_FULL_S + _SKIP_S)
# How many look on, and how long their pages may take to be complete once they are connected, s.
_COUNT, _OPEN_S = 3, 20.0


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly with processes, watched and not, once for each kind of those who look on."""
    run = setup("resilient", effort.watched)
    chromium = next(filter(None, map(shutil.which, _CHROMIUM)), None)
    measured: dict[str, tuple[Array, Array, Array]] = {}
    for name, draws in WATCHERS.items():
        if draws and chromium is None:
            continue
        say(f"{run.maneuver.duration_s:g} s, by turns watched by {NOBODY} and {name}")
        factors, busy, opening_s = measured[name] = _flown(run, chromium if draws else None)
        say(", ".join(_row(name, factors[:, 1], factors[:, 0], busy, opening_s)))
    rows = [_row(NOBODY, np.concatenate([factors[:, 0] for factors, _, _ in measured.values()]))]
    for name in WATCHERS:
        if name in measured:
            factors, busy, opening_s = measured[name]
            rows.append(_row(name, factors[:, 1], factors[:, 0], busy, opening_s))
        else:
            rows.append((name, "no Chromium", "-", "-", "-", "-"))
    columns = ("watched by", "real-time factor", "turns", "loss, %", "processors", "opening, s")
    alone_s, watched_s = _BLOCKS_S
    text = TEXT.format(alone=alone_s, watched=watched_s, skip=_SKIP_S, opened=_OPEN_S)
    return [Table(text=text, columns=columns, rows=rows), _paced(effort, chromium, say)]


def _paced(effort: Effort, chromium: str | None, say: Callable[[str], None]) -> Table:
    """Whole flights at real speed, by turns watched and not."""
    run = setup("resilient", *effort.paced, "clock.speed=1.0")
    factors: dict[str, list[float]] = {NOBODY: [], **{name: [] for name, draws in WATCHERS.items() if draws}}
    for _ in range(effort.paced_flights):
        for name, found in factors.items():
            if name == NOBODY or chromium is not None:
                say(f"{run.maneuver.duration_s:g} s at real speed, watched by {name}")
                found.append(_paced_flight(run, None if name == NOBODY else chromium))
    rows = [
        _row(name, np.array([factor for factor in found if not math.isnan(factor)]))[:3]
        for name, found in factors.items()
    ]
    return Table(text=PACED, columns=("watched by", "real-time factor", "flights"), rows=rows)


def _paced_flight(run: Setup, chromium: str | None) -> float:
    """Real-time factor of a flight, with the viewer and browsers beside it if there is a browser."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        at, ended, seen = Path(folder) / "flight", Event(), Event()

        def look() -> None:
            with ExitStack() as looking:
                if chromium is not None and _wait(lambda: _listens(port), ended):
                    for command in _windows(chromium, at, f"http://{_HOST}:{port}"):
                        looking.enter_context(_started(command))
                    if _wait(lambda: _connections(port) >= _COUNT, ended):
                        seen.set()
                ended.wait()

        if chromium is not None:
            port = stack.enter_context(_viewer(at))[1]
        thread = Thread(target=look)
        thread.start()
        try:
            factor = float(processes.recorded(run, at).summary["real_time_factor"])
        finally:
            ended.set()
            thread.join()
        return factor if chromium is None or seen.is_set() else math.nan  # over before they were there


def _flown(run: Setup, chromium: str | None) -> tuple[Array, Array, Array]:
    """One flight, watched by turns.

    Args:
        run: What is flown.
        chromium: The browser; None for readers in its place.
    Returns: Real-time factors with nobody and with all, (turns, 2); processors that the viewer kept busy then, and
        those who looked on, (turns, 2); processor time that their opening took, s, (2,), NaN if the flight was over.
    """
    changes: list[tuple[int, str]] = []
    used_s: list[Array] = []  # by viewer and others
    opening_s = [np.full(2, np.nan)]
    with tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        at, ended = Path(folder) / "flight", Event()
        viewer, port = stack.enter_context(_viewer(at))

        def alternate() -> None:
            with ExitStack() as looking:
                if not _wait(lambda: _listens(port), ended):
                    return
                address = f"http://{_HOST}:{port}"
                commands = [[sys.executable, "-m", "benchmarks.readers", address, str(_COUNT)]]
                if chromium is not None:
                    commands = _windows(chromium, at, address)
                others: list[subprocess.Popen[bytes]] = []

                def used() -> Array:
                    return np.array([_processor_s(viewer.pid), sum(_processor_s(process.pid) for process in others)])

                before_s = used()
                others += [looking.enter_context(_started(command)) for command in commands]
                if not _wait(lambda: _connections(port) >= _COUNT, ended) or ended.wait(_OPEN_S):
                    return
                opening_s[0] = used() - before_s
                for watched in cycle((False, True)):  # as in _BLOCKS_S
                    for process in (viewer, *others):
                        _freeze(process, not watched)
                    changes.append((time.time_ns(), str(watched)))
                    if ended.wait(_SKIP_S):
                        return
                    before_s = used()
                    if ended.wait(_BLOCKS_S[watched] - _SKIP_S):
                        return
                    if watched:
                        used_s.append(used() - before_s)

        thread = Thread(target=alternate)
        thread.start()
        try:
            processes.recorded(run, at)
        finally:
            changes.append((time.time_ns(), ""))
            ended.set()
            thread.join()
        factors = turns(read_log(at / "run.mcap"), changes, _BLOCKS_S, run.settings.sampling_period_s)
    busy = np.array(used_s[: len(factors)]).reshape(-1, 2) / (_BLOCKS_S[True] - _SKIP_S)
    return factors, busy, opening_s[0]


def turns(log: RunLog, changes: Sequence[tuple[int, str]], blocks_s: Sequence[float], period_s: float) -> Array:
    """Real-time factors of the turns that are whole.

    Args:
        log: Of the flight.
        changes: When who began to watch, ns since 1970; the last is the end.
        blocks_s: How long each part of a turn takes at least, s.
        period_s: Sampling period, s.
    Returns: (turns, parts).
    """
    at_ns = np.array(sorted(log.received_ns(Truth).values()))
    found = []
    for ((begin_ns, _), (end_ns, _)), block_s in zip(pairwise(changes), cycle(blocks_s), strict=False):
        inside = at_ns[(at_ns >= begin_ns + _SKIP_S * 1e9) & (at_ns < end_ns)]
        if end_ns - begin_ns >= block_s * 1e9:
            time_s = float(inside[-1] - inside[0]) / 1e9 if len(inside) > 1 else math.inf
            found.append((len(inside) - 1) * period_s / time_s)
    whole = len(found) // len(blocks_s)
    return np.array(found[: whole * len(blocks_s)]).reshape(whole, len(blocks_s))


def _row(
    name: str,
    factors: Array,
    alone: Array | None = None,
    busy: Array | None = None,
    opening_s: Array | None = None,
) -> tuple[str, str, str, str, str, str]:
    if not len(factors):
        return name, "-", "0", "-", "-", "-"
    spread = f"{digits(float(np.median(factors)))} ({digits(float(factors.min()))} to {digits(float(factors.max()))})"
    if alone is None or busy is None or opening_s is None:
        return name, spread, str(len(factors)), "-", "-", "-"
    low, middle, high = np.percentile(100.0 * (1.0 - factors / alone), (25, 50, 75))
    return (
        name,
        spread,
        str(len(factors)),
        f"{middle:.1f} ({low:.1f} to {high:.1f})",
        " + ".join(f"{one:.3f}" for one in busy.mean(axis=0)),
        " + ".join(f"{one:.1f}" for one in opening_s),
    )


@contextmanager
def _viewer(at: Path) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """A viewer of a run that is to come, and its port."""
    with free_ports(_HOST, 1) as ports:
        port = ports[0]
    words = ("view", str(at), "--port", str(port), "--wait", str(_WAIT_S))
    with _started([sys.executable, "-m", "transport", *words]) as viewer:
        yield viewer, port


def _windows(chromium: str, at: Path, address: str) -> list[list[str]]:
    """Commands of the browsers."""
    return [[chromium, *HEADLESS, _STAYS, f"--user-data-dir={at}-{k}", address] for k in range(_COUNT)]


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


def _processor_s(session: int) -> float:
    """Processor time that a session's processes have had, s, with threads and children that have ended."""
    ticks = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if os.getsid(int(process.name)) == session:
                words = (process / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
                ticks += sum(map(int, words[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


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
