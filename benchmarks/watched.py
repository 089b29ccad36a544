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
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle, pairwise
from pathlib import Path
from threading import Event

import numpy as np
from scipy.stats import quantile_test

from benchmarks import processes
from benchmarks.effort import Effort
from benchmarks.flights import setup
from benchmarks.page import BenchmarkError, Table
from benchmarks.timing import digits
from model.arrays import Array
from protocol.messages import Truth
from protocol.setup import Setup
from transport.harness import free_ports
from transport.log import RunLog, read_log
from transport.viewer.viewer import ViewerError, require_viser

NOBODY = "nobody"

# Who looks on besides the viewer, and whether they draw on this machine.
WATCHERS: Mapping[str, bool] = {"3 browsers on other machines": False, "3 browsers here": True}

TEXT = (
    "What being watched costs: `resilient` as fast as it goes, with the viewer and those who look on beside it: three "
    "windows of headless Chromium, 900 x 600 pixels, on the same machine and without a graphics processor, or three "
    "connections on which all is read that a browser is sent, as if it drew on another machine. One flight for each "
    "kind; in each, by turns, all of them are frozen for {part:g} s, and none for {part:g} s; the first {skip:g} s "
    "after each change do not count. Real-time factor, median of all turns (least to most). Loss: by how much it is "
    "lower than in the mean of the parts before and after, in which nobody watched, median ({confidence:.0%} "
    "confidence interval of the median). Processors: how many the viewer keeps busy, and those who look on, mean, the "
    "pictures they draw now and then included. Opening: processor time of the viewer and of those who look on, from "
    "the start of the latter until {opened:g} s after all were connected, once. Browsers have the priority of any "
    "program; the viewer has nice 10, and so has its session."
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
# How long a part of a turn takes, and what was frozen takes to catch up, s: the machine's own speed changes from minute
# to minute, so that many short turns tell more than few long ones. A page that is held back draws once a minute, frozen
# or not in between, so that as many of its pictures are counted as of the time.
_PART_S, _SKIP_S = 4.0, 1.0
_CONFIDENCE = 0.95
# How many look on, and how long their pages may take to be complete once they are connected, s.
_COUNT, _OPEN_S = 3, 20.0


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly with processes, watched and not, once for each kind of those who look on."""
    try:
        require_viser()
    except ViewerError as error:
        raise BenchmarkError(str(error)) from error
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
    text = TEXT.format(part=_PART_S, skip=_SKIP_S, opened=_OPEN_S, confidence=_CONFIDENCE)
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
                if chromium is not None and _wait(lambda: _listens(port), ended, viewer):
                    commands = _windows(chromium, at, f"http://{_HOST}:{port}")
                    others = [looking.enter_context(_started(command)) for command in commands]
                    if _wait(lambda: _connections(port) >= _COUNT, ended, viewer, *others):
                        seen.set()
                ended.wait()

        if chromium is not None:
            viewer, port = stack.enter_context(_viewer(at))
        with ThreadPoolExecutor(1) as beside:
            looked = beside.submit(look)
            try:
                factor = float(processes.recorded(run, at).summary["real_time_factor"])
            finally:
                ended.set()
        looked.result()
        return factor if chromium is None or seen.is_set() else math.nan  # over before they were there


def _flown(run: Setup, chromium: str | None) -> tuple[Array, Array, Array]:
    """One flight, watched by turns.

    Args:
        run: What is flown.
        chromium: The browser; None for readers in its place.
    Returns: Real-time factors with nobody and with all, (turns, 2); processors that the viewer kept busy then, and
        those who looked on, (turns, 2); processor time that their opening took, s, (2,), NaN if the flight was over.
    """
    changes_ns: list[int] = []
    used_s: list[Array] = []  # by viewer and others
    opening_s = [np.full(2, np.nan)]
    with tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        at, ended = Path(folder) / "flight", Event()
        viewer, port = stack.enter_context(_viewer(at))

        def alternate() -> None:
            with ExitStack() as looking:
                if not _wait(lambda: _listens(port), ended, viewer):
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
                if not _wait(lambda: _connections(port) >= _COUNT, ended, viewer, *others) or ended.wait(_OPEN_S):
                    return
                opening_s[0] = used() - before_s
                for watched in cycle((False, True)):
                    for process in (viewer, *others):
                        _freeze(process, not watched)
                    changes_ns.append(time.time_ns())
                    if ended.wait(_SKIP_S):
                        return
                    before_s = used()
                    if ended.wait(_PART_S - _SKIP_S):
                        return
                    if watched:
                        used_s.append(used() - before_s)

        with ThreadPoolExecutor(1) as beside:
            alternated = beside.submit(alternate)
            try:
                processes.recorded(run, at)
            finally:
                ended.set()
        alternated.result()
        factors = turns(read_log(at / "run.mcap"), changes_ns, run.settings.sampling_period_s)
    busy = np.array(used_s[: len(factors)]).reshape(-1, 2) / (_PART_S - _SKIP_S)
    return factors, busy, opening_s[0]


def turns(log: RunLog, changes_ns: Sequence[int], period_s: float) -> Array:
    """Real-time factors of the turns that are whole.

    Args:
        log: Of the flight.
        changes_ns: When somebody ceased to watch and began to, by turns, ns since 1970.
        period_s: Sampling period, s.
    Returns: (turns, 2): the mean of the parts before and after, in which nobody watched, and the part between them.
    """
    at_ns = np.array(sorted(log.received_ns(Truth).values()))
    parts = []
    for begin_ns, end_ns in pairwise(changes_ns):
        inside = at_ns[(at_ns >= begin_ns + _SKIP_S * 1e9) & (at_ns < end_ns)]
        if end_ns > at_ns[-1] or len(inside) < 2:
            break  # the flight is over, its report is being made
        parts.append((len(inside) - 1) * period_s / (float(inside[-1] - inside[0]) / 1e9))
    alone, watched = np.array(parts[::2]), np.array(parts[1::2])
    count = min(len(watched), max(0, len(alone) - 1))
    return np.column_stack([(alone[:count] + alone[1 : count + 1]) / 2.0, watched[:count]])


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
    loss = 100.0 * (1.0 - factors / alone)
    low, high = quantile_test(loss, p=0.5).confidence_interval(_CONFIDENCE)
    return (
        name,
        spread,
        str(len(factors)),
        f"{np.median(loss):.1f} ({low:.1f} to {high:.1f})",
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


def _wait(condition: Callable[[], bool], ended: Event, *needed: "subprocess.Popen[bytes]") -> bool:
    """Wait until something is so; False if the flight has ended before.

    Raises: BenchmarkError: a process that is needed has ended.
    """
    while not condition():
        if ended.wait(0.2):
            return False
        for process in needed:
            if process.poll() is not None:
                raise BenchmarkError(f"{process.args!r}: expected to stay, ended with {process.returncode}")
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
