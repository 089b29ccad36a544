"""Seeded fault runs: short flights of real processes that are killed, frozen or interrupted at random instants.

Whatever happens to whom, the command has to end, nobody may be left behind, the log has to be readable and the
exit code has to say how it ended. Each run is drawn from its number and a seed, so that it can be repeated.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from protocol.network.health import command_of
from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from transport.log.run_log import RunLog

# The command itself, in which also the recorder lives; its exit code is the run's.
COMMAND = "transport"
_CHILDREN = ("coordinator", "plant", "agent1", "agent2", "agent3", "agent4")
_TARGETS = (*_CHILDREN, COMMAND, COMMAND)

# What a command may take to end after the last thing was done to it. The network gives up a frozen process after
# ten seconds; the rest is for slow machines.
_DEADLINE_S = 60.0
# What the processes of a command that was killed may take to notice.
_ORPHANS_S = 20.0
# A command that is frozen for good cannot end: whoever froze it kills it after this.
_FROZEN_S = 8.0
# Until then a command that starts may not have come to saying what it does on a signal.
_HELPLESS_S = 0.5
# Share of what is done while the run starts, and how long after its start or its first tick at the latest: a flight
# takes about three seconds, so now and then it is over by then and the report is written.
_AT_START, _LATEST_S = 0.2, 3.5
# What a process may take to be frozen.
_STOPPING_S = 1.0
# How long to wait for a flight to begin before it is struck all the same.
_TAKE_OFF_S = 30.0
_POLL_S = 0.02

_EXIT_WRONG = 1
_KINDS = ("hang", "orphan", "unreadable log", "wrong exit code")

_SLOW = "maneuver.phase=[{name='climb',duration_s=3.0,displacement_m=[0,0,-1.5]}]"
_FAST = "maneuver.phase=[{name='climb',duration_s=12.0,displacement_m=[0,0,-6.0]}]"
_IMPAIRED = (
    "links={delay_s=0.06,jitter_s=0.05,loss=0.1}",
    "links={delay_s=0.02,loss=0.05,duplicate=0.2,reorder=0.2,reorder_s=0.1,measurement={loss=0.1},actuation={loss=0.1}}",
    "links.partition=[{between=['agent1','agent2'],start_s=0.5,end_s=1.0}]",
    "links.change=[{at_s=0.5,delay_s=0.1},{at_s=1.5,delay_s=0.0}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """One thing done to one process.

    Attributes:
        target: Its name, or "transport" for the command.
        signal: What it is sent.
        since: Whether `after_s` counts from the start of the command or from the first tick.
        after_s: When.
        freed_s: After a SIGSTOP, how much later SIGCONT follows; None for never.
    """

    target: str
    signal: signal.Signals
    since: Literal["start", "flight"]
    after_s: float
    freed_s: float | None = None

    def __str__(self) -> str:
        freed = "" if self.freed_s is None else f", SIGCONT {self.freed_s:.2f} s later"
        return f"{self.signal.name} to {self.target} {self.after_s:.2f} s after the {self.since}{freed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultRun:
    """One run as it is drawn.

    Attributes:
        number: Which one.
        settings: Changes of the scenario.
        strikes: What is done, in no order.
    """

    number: int
    settings: tuple[str, ...]
    strikes: tuple[Strike, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What came of a run.

    Attributes:
        run: As it was drawn.
        code: Exit code of the command; negative for a signal.
        problems: What is wrong, by kind.
    """

    run: FaultRun
    code: int
    problems: Mapping[str, str] = field(default_factory=dict)


def drawn(seed: int, number: int) -> FaultRun:
    """A run by its number."""
    chance = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    pace = chance.choice(("fast", "paced", "realtime"))
    settings = ["clock.barrier_timeout_s=1.0", "clock.join_timeout_s=10.0"]
    settings += [f"clock.on_agent_loss={chance.choice(('abort', 'continue'))}"]
    if pace == "fast":
        settings += [_FAST]
    else:
        settings += [_SLOW, "clock.speed=1.0"]
    if pace == "realtime":
        settings += ["clock.mode=realtime", f"clock.on_overrun={chance.choice(('continue', 'continue', 'hold'))}"]
    elif chance.random() < 0.2:
        settings += ["controller.negotiation_iterations=2"]
    if chance.random() < 0.3:
        settings += [chance.choice(_IMPAIRED)]
    count = 2 if chance.random() < 0.3 else 1
    return FaultRun(number=number, settings=tuple(settings), strikes=tuple(_strike(chance) for _ in range(count)))


def _strike(chance: random.Random) -> Strike:
    target = chance.choice(_TARGETS)
    number = chance.choice((signal.SIGKILL, signal.SIGSTOP, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT))
    return Strike(
        target=target,
        signal=number,
        since="start" if chance.random() < _AT_START else "flight",
        after_s=chance.uniform(0.0, _LATEST_S),
        freed_s=chance.uniform(0.1, 4.0) if number == signal.SIGSTOP and chance.random() < 0.5 else None,
    )


def simulate(run: FaultRun, folder: Path, stop: threading.Event) -> Verdict:
    """Fly one run and judge it; nothing of it is left running.

    Args:
        run: As it was drawn.
        folder: For its run folder and what the command says.
        stop: Ends it early.
    """
    name = f"fault-{run.number}-{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [*python("transport"), "run", "resilient", "--out", name, "--no-figures"]
    for setting in run.settings:
        arguments += ["--set", setting]
    with (folder / f"{name}.txt").open("wb") as said:
        command = subprocess.Popen(
            arguments, cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
        )
        try:
            frozen = _strike_all(run, command, folder / name, stop)
            hangs = not _wait(command, time.monotonic() + (_FROZEN_S if frozen else _DEADLINE_S), stop)
        finally:
            if command.poll() is None:
                command.kill()
            command.wait()
    problems: dict[str, str] = {}
    if hangs and not frozen and not stop.is_set():
        problems["hang"] = f"the command has not ended within {_DEADLINE_S:g} s"
    if not _wait_for(lambda: not processes_of(name), _ORPHANS_S):
        left = processes_of(name)
        problems["orphan"] = ", ".join(left)
        for pid in left.values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    log, unreadable = _log(folder / name)
    if unreadable:
        problems["unreadable log"] = unreadable
    wrong = _wrong_code(run, command.returncode, log)
    if wrong and "hang" not in problems:
        problems["wrong exit code"] = wrong
    return Verdict(run=run, code=command.returncode, problems=problems)


def _strike_all(run: FaultRun, command: "subprocess.Popen[bytes]", folder: Path, stop: threading.Event) -> bool:
    """Do all that is to be done; whether the command is left frozen."""
    began_s = time.monotonic()
    hands = [threading.Thread(target=_do, args=(strike, command, folder, began_s, stop)) for strike in run.strikes]
    for hand in hands:
        hand.start()
    for hand in hands:
        hand.join()
    if not any(strike.target == COMMAND and strike.signal == signal.SIGSTOP for strike in run.strikes):
        return False
    # All its threads have to take note.
    _wait_for(lambda: _is_stopped(command.pid) or command.poll() is not None, _STOPPING_S)
    return _is_stopped(command.pid)


def _do(
    strike: Strike, command: "subprocess.Popen[bytes]", folder: Path, began_s: float, stop: threading.Event
) -> None:
    """Do one thing at its instant, if its process is there then."""

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    if strike.since == "flight":
        _wait_for(lambda: _flies(folder) or is_over(), _TAKE_OFF_S)
        began_s = time.monotonic()
    sent = (strike.after_s, strike.signal), (strike.freed_s, signal.SIGCONT)
    for after_s, number in sent:
        if after_s is None:
            return
        until_s = began_s + after_s
        _wait_for(lambda until_s=until_s: time.monotonic() >= until_s or is_over(), _TAKE_OFF_S)  # type: ignore[misc]
        if is_over():
            return
        pid = command.pid if strike.target == COMMAND else processes_of(folder.name).get(strike.target)
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        began_s = time.monotonic()


def _is_stopped(pid: int) -> bool:
    """Whether a process is frozen."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "T"
    except (OSError, IndexError):
        return False


def processes_of(run: str) -> dict[str, int]:
    """Names and pids of the living processes of a run, from the system's own table."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except (OSError, IndexError):
            continue
        words = command_of(entry.name)
        if state == "Z" or "--run" not in words or words[words.index("--run") + 1 :][:1] != [run]:
            continue
        role = words[words.index("transport") + 1] if "transport" in words else words[0]
        found[f"agent{words[words.index('--id') + 1]}" if role == "agent" else role] = int(entry.name)
    return found


def _flies(folder: Path) -> bool:
    """Whether the coordinator has seen everybody."""
    try:
        return '"joined"' in (folder / "logs" / "coordinator.log").read_text(errors="replace")
    except OSError:
        return False


def _log(folder: Path) -> "tuple[RunLog | None, str]":
    """The log of a run folder if there is one, and why it cannot be read if it cannot."""
    from transport.log.run_log import read_log

    path = folder / "run.mcap"
    if not path.exists():
        return None, ""  # it never came to flying
    try:
        return read_log(path), ""
    except Exception as error:  # noqa: BLE001  # whatever it is, it is the finding
        return None, f"{type(error).__name__}: {error}"


def _wrong_code(run: FaultRun, code: int, log: "RunLog | None") -> str:
    """What is wrong with an exit code, if anything."""
    from protocol.wire.messages import Control

    fits = {0, 4, 6}
    for strike in run.strikes:
        if strike.target == COMMAND and (strike.signal == signal.SIGKILL or strike.signal == signal.SIGSTOP):
            fits.add(-signal.SIGKILL)
        if strike.target in (COMMAND, "coordinator") and strike.signal in (signal.SIGTERM, signal.SIGINT):
            fits.add(EXIT_INTERRUPTED)
        if strike.target == COMMAND and strike.since == "start" and strike.after_s < _HELPLESS_S:
            fits.add(-strike.signal)
    if code not in fits:
        return f"{code}, expected one of {', '.join(map(str, sorted(fits)))}"
    ends = [] if log is None else [control.exit_code for control in log.of(Control)]
    if code in (0, 5, 6) and code not in ends:
        return f"{code}, but the log says {ends or 'nothing'}"
    return ""


def _wait(command: "subprocess.Popen[bytes]", until_s: float, stop: threading.Event) -> bool:
    """Wait for a command to end; whether it did."""
    while command.poll() is None and time.monotonic() < until_s and not stop.is_set():
        stop.wait(_POLL_S)
    return command.poll() is not None


def _wait_for(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition; whether it came true in time."""
    until_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until_s:
            return False
        time.sleep(_POLL_S)
    return True


def _flown(planned: Sequence[FaultRun], folder: Path, jobs: int, console: "Console") -> Iterator[Verdict]:
    """Fly runs, several at a time, and keep the folders of those that fail."""
    from transport.experiments.progress import SweepProgress

    stop = threading.Event()
    with SweepProgress("faults", 0, len(planned), console) as progress, ThreadPoolExecutor(jobs) as workers:
        flights = [workers.submit(simulate, run, folder / str(run.number), stop) for run in planned]
        try:
            for flight in as_completed(flights):
                verdict = flight.result()
                if not verdict.problems:
                    shutil.rmtree(folder / str(verdict.run.number), ignore_errors=True)
                progress.advance(f"run {verdict.run.number}: {', '.join(verdict.problems) or 'fine'}")
                yield verdict
        except BaseException:
            stop.set()
            for flight in flights:
                flight.cancel()
            raise
    with suppress(OSError):
        folder.rmdir()  # if nothing had to be kept


def _table(verdicts: Sequence[Verdict]) -> "Table":
    """Exit codes by what was done first to whom."""
    from rich.table import Table

    codes = sorted({verdict.code for verdict in verdicts})
    rows: dict[tuple[str, str], Counter[int]] = {}
    for verdict in verdicts:
        strike, *others = verdict.run.strikes
        target = "agent" if strike.target.startswith("agent") else strike.target
        what = "SIGSTOP, SIGCONT" if strike.freed_s is not None else strike.signal.name
        row = ("two at once", "") if others else (target, what)
        rows.setdefault(row, Counter())[verdict.code] += 1
    table = Table(title="runs by exit code", title_justify="left", box=None)
    for name in ("to", "what", *map(str, codes)):
        table.add_column(name, justify="left" if name in ("to", "what") else "right")
    for row, counts in sorted(rows.items()):
        table.add_row(*row, *(str(counts[code]) if counts[code] else "" for code in codes))
    return table


def conduct(runs: int, seed: int, first: int, jobs: int, folder: Path) -> int:
    """Fly all runs of a number and say what came of them.

    Args:
        runs: Up to which number, without it.
        seed: Of what happens to whom and when.
        first: Number of the first run.
        jobs: Runs at a time.
        folder: Where the folders of failing runs are kept.
    Returns: Exit code: 0, or 1 if anything is wrong.
    """
    from rich.console import Console

    planned = [drawn(seed, number) for number in range(first, runs)]
    flown = _flown(planned, folder, jobs, Console(stderr=True))
    verdicts = sorted(flown, key=lambda verdict: verdict.run.number)
    Console().print(_table(verdicts))
    counts = Counter(kind for verdict in verdicts for kind in verdict.problems)
    found = ", ".join(f"{counts[kind]} {kind}{'' if counts[kind] == 1 else 's'}" for kind in _KINDS)
    sys.stdout.write(f"{len(verdicts)} runs: {found}\n")
    for verdict in (verdict for verdict in verdicts if verdict.problems):
        number = verdict.run.number
        again = f"transport experiment faults --seed {seed} --first {number} --runs {number + 1}"
        lines = [f"run {number}, kept in {folder / str(number)}; again: {again}"]
        lines += [f"  {kind}: {text}" for kind, text in verdict.problems.items()]
        lines += [f"  {line}" for line in (*verdict.run.strikes, *verdict.run.settings)]
        sys.stdout.write("\n" + "\n".join(lines) + "\n")
    return _EXIT_WRONG if counts else 0
