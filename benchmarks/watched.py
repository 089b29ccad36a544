"""What being watched costs: flights as fast as they go, by turns with nobody and with the viewer and who looks on."""

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
from concurrent.futures import Future, ThreadPoolExecutor
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
from protocol.scenario.setup import Setup
from protocol.wire.messages import PlantState
from transport.flight.harness import free_ports
from transport.log.run_log import RunLog, read_log
from transport.viewer.viewer import ViewerError, require_viser

NOBODY = "nobody"

# Who looks on besides the viewer, and whether they draw on this machine.
WATCHERS: Mapping[str, bool] = {"3 browsers on other machines": False, "3 browsers here": True}

TEXT = (
    "What being watched costs: `resilient` as fast as it goes, with the viewer and those who look on beside it: three "
    "windows of headless Chromium, 900 x 600 pixels, on the same machine and without a graphics processor, or three "
    "connections on which all is read that a browser is sent, as if it drew on another machine. One flight for each "
    "kind; in it, by turns, all of them are frozen for a while, and none for a while, {low:g} to {high:g} s each, as "
    "a random number has it; the first {skip:g} s after each change do not count. Real-time factor, median of all "
    "parts (least to most). Loss: by how much it is lower than in the mean of the parts before and after, in which "
    "nobody watched, median ({confidence:.0%} confidence interval of the median, by ranks; neighbours share a part, "
    "so that it is a little too narrow). Processors: how many the viewer keeps busy, and those who look on, mean, "
    "with the pictures they draw now and then. Opening: processor time of the viewer and of those who look on, from "
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
# How long a part of a turn takes, and how long what was frozen takes to catch up, s. The machine's own speed changes
# from minute to minute, so that many short turns tell more than few long ones. Their length is random, or pictures that
# are drawn once a minute would always fall into the same part of a turn.
_PART_S, _SKIP_S = (4.0, 6.0), 2.0
_SEED = 0
_CONFIDENCE = 0.95
# How many look on, and how long their pages may take to be complete once they are connected, s.
_COUNT, _OPEN_S = 3, 20.0


def check() -> None:
    """Refuse before anything is flown.

    Raises: BenchmarkError: there is no viewer.
    """
    try:
        require_viser()
    except ViewerError as error:
        raise BenchmarkError(str(error)) from error


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
        say(", ".join(_row(name, factors[1::2], losses(factors), busy, opening_s)))
    rows = [_row(NOBODY, np.concatenate([factors[::2] for factors, _, _ in measured.values()]))]
    for name in WATCHERS:
        if name in measured:
            factors, busy, opening_s = measured[name]
            rows.append(_row(name, factors[1::2], losses(factors), busy, opening_s))
        else:
            rows.append((name, "no Chromium", "-", "-", "-", "-"))
    columns = ("watched by", "real-time factor", "parts", "loss, %", "processors", "opening, s")
    low, high = _PART_S
    text = TEXT.format(low=low, high=high, skip=_SKIP_S, opened=_OPEN_S, confidence=_CONFIDENCE)
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
                factor = float(processes.recorded(run, at, given_up=_failed(looked)).summary["real_time_factor"])
            finally:
                ended.set()
                looked.result()
        return factor if chromium is None or seen.is_set() else math.nan  # over before they were there


def _flown(run: Setup, chromium: str | None) -> tuple[Array, Array, Array]:
    """One flight, watched by turns.

    Args:
        run: What is flown.
        chromium: The browser; None for readers in its place.
    Returns: Real-time factors, (2 turns + 1,), with nobody and with all by turns; processors that the viewer kept busy
        while all watched, and those who looked on, (turns, 2); processor time that their opening took, s, (2,), NaN if
        the flight was over.
    """
    changes_ns: list[int] = []
    busy: list[Array] = []  # by viewer and others
    rng = np.random.default_rng(_SEED)
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
                    before_s, since = used(), time.monotonic()
                    if ended.wait(rng.uniform(*_PART_S) - _SKIP_S):
                        return
                    if watched:
                        busy.append((used() - before_s) / (time.monotonic() - since))
                        _require(viewer, *others)
                        if _connections(port) < _COUNT and not ended.wait(_SKIP_S):
                            raise BenchmarkError(f"{address}: expected {_COUNT} to look on, got {_connections(port)}")

        with ThreadPoolExecutor(1) as beside:
            alternated = beside.submit(alternate)
            try:
                processes.recorded(run, at, given_up=_failed(alternated))
            finally:
                ended.set()
                alternated.result()
        log = read_log(at / "run.mcap", horizons=False)
        factors = paces(log, changes_ns, run.settings.sampling_period_s)
    return factors, np.array(busy[: len(factors) // 2]).reshape(-1, 2), opening_s[0]


def paces(log: RunLog, changes_ns: Sequence[int], period_s: float) -> Array:
    """Real-time factors of the parts of a flight.

    Args:
        log: Of the flight.
        changes_ns: When somebody ceased to watch and began to, by turns, ns since 1970.
        period_s: Sampling period, s.
    Returns: (2 turns + 1,), 0 where the flight stood still; of parts that are whole, and none that is watched without
        one behind it that is not.
    """
    at_ns = np.array(sorted(log.received_ns(PlantState).values()))
    found = []
    for begin_ns, end_ns in pairwise(changes_ns):
        if not len(at_ns) or end_ns > at_ns[-1]:
            break  # the flight is over, its report is being made
        counted_ns = begin_ns + _SKIP_S * 1e9
        ticks = np.count_nonzero((at_ns >= counted_ns) & (at_ns < end_ns))
        found.append(ticks * period_s / ((end_ns - counted_ns) / 1e9))
    turns = (len(found) - 1) // 2
    return np.array(found[: 2 * turns + 1] if turns > 0 else [])


def losses(factors: Array) -> Array:
    """By how much a flight is slower while it is watched, of the mean before and after, %.

    Args:
        factors: As from `paces`.
    Returns: (turns,).
    """
    alone = (factors[:-2:2] + factors[2::2]) / 2.0
    return 100.0 * (1.0 - factors[1::2] / alone)


def _row(
    name: str,
    factors: Array,
    lost: Array | None = None,
    busy: Array | None = None,
    opening_s: Array | None = None,
) -> tuple[str, str, str, str, str, str]:
    if not len(factors):
        return name, "-", "0", "-", "-", "-"
    spread = f"{digits(float(np.median(factors)))} ({digits(float(factors.min()))} to {digits(float(factors.max()))})"
    if lost is None or busy is None or opening_s is None:
        return name, spread, str(len(factors)), "-", "-", "-"
    interval = quantile_test(lost, p=0.5).confidence_interval(_CONFIDENCE)
    within = "{:.1f} to {:.1f}".format(*interval) if np.isfinite(interval).all() else "too few for an interval"
    return (
        name,
        spread,
        str(len(factors)),
        f"{np.median(lost):.1f} ({within})",
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
        _require(*needed)
    return True


def _require(*needed: "subprocess.Popen[bytes]") -> None:
    """Raises: BenchmarkError: one of the processes has ended."""
    for process in needed:
        if process.poll() is not None:
            raise BenchmarkError(f"{process.args!r}: expected to stay, ended with {process.returncode}")


def _failed(beside: "Future[None]") -> Callable[[], bool]:
    """Whether what is done beside a flight has failed, so that the flight is for nothing."""
    return lambda: beside.done() and beside.exception() is not None


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
                with suppress(ProcessLookupError):  # it has ended by itself
                    os.killpg(process.pid, number)
            try:
                process.wait(_LEAVE_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
