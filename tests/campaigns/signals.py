"""Signals campaign: kills, freezes and interrupts processes of random runs.

After each run the command must have ended in time, no process may be left, no output may have a
traceback, the log must open and the exit code must fit.
"""

import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.campaigns.harness import Result
from tests.support.commands import command_of
from tests.support.commands import wait_for as wait
from transport.log.run_log import read_log
from transport.protocol.network.parent_and_environment import FORK_SERVER, python
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED
from transport.protocol.wire.messages import Control

# The command itself contains the recorder, and its exit code is the run's.
COMMAND, REPORT = "transport", "report"
TARGETS = (
    "coordinator",
    "plant",
    "agent1",
    "agent2",
    "agent3",
    "agent4",
    FORK_SERVER,
    REPORT,
    COMMAND,
)
KINDS = ("KILL", "STOP", "STOP", "STOP", "SEGV", "TERM", "INT", "HUP")
# Times after which a stopped process goes on, s: within every timeout, near Zenoh's 10 s, beyond,
# never. The command waits for fork server and report without a look at their state.
RESUMED_S = (1.0, 7.0, 20.0, None)

# Share of signals before the first tick, and their latest time after the start of the process; the
# latest time after the first tick: a run takes 3 s, so some come while the report is written, s.
_BEFORE, _JOINING_S, _LATEST_S = 0.3, 1.5, 3.5
# Time for the run to begin, for a command to end after the last signal, and for its processes to
# end after it, s.
_BEGIN_S, _END_S, _ORPHANS_S = 60.0, 90.0, 20.0
# A command that is frozen for good is killed after this time, s.
_FROZEN_S = 8.0
_PACED = "maneuver.phase=[{name='climb',duration_s=3.0,displacement_m=[0,0,-1.5]}]"
_UNPACED = "maneuver.phase=[{name='climb',duration_s=12.0,displacement_m=[0,0,-6.0]}]"
_IMPAIRED = (
    "links={delay_s=0.06,jitter_s=0.05,loss=0.1,duplicate=0.2,reorder=0.2,reorder_s=0.1}",
    "links.partition=[{between=['agent1','agent2'],start_s=0.5,end_s=1.0}]",
    "links.change=[{at_s=0.5,delay_s=0.1},{at_s=1.5,delay_s=0.0}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """A signal to one process.

    Attributes:
        target: One of `TARGETS`.
        kind: One of `KINDS`.
        is_early: Whether the time counts from the start of the process and not from the first tick.
        after_s: Time of the signal, s.
        resumed_s: Time from a stop to its end, s; None for never.
    """

    target: str
    kind: str
    is_early: bool
    after_s: float
    resumed_s: float | None

    @property
    def freezes_the_command(self) -> bool:
        """Whether it stops the command for good."""
        return (self.target, self.kind, self.resumed_s) == (COMMAND, "STOP", None)

    def __str__(self) -> str:
        since = "its start" if self.is_early else "the first tick"
        resumed = (
            "" if self.kind != "STOP" else f", CONT after {self.resumed_s or float('inf'):g} s"
        )
        return f"{self.kind}{resumed} to {self.target} {self.after_s:.2f} s after {since}"


def random_run(seed: int, number: int) -> tuple[list[str], list[Injection]]:
    """Draw settings and one or two injections of a run from the seed and its number."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    pace = rng.choice(("fast", "paced", "realtime"))
    settings = [
        "clock.barrier_timeout_s=1.0",
        f"clock.on_agent_loss={rng.choice(('abort', 'continue'))}",
    ]
    settings += [_UNPACED] if pace == "fast" else [_PACED, "clock.speed=1.0"]
    if pace == "realtime":
        settings += ["clock.mode=realtime", f"clock.on_overrun={rng.choice(('continue', 'hold'))}"]
    elif rng.random() < 0.3:
        settings += ["controller.negotiation_iterations=2"]
    if rng.random() < 0.3:
        settings += [rng.choice(_IMPAIRED)]
    return settings, [_random_injection(rng) for _ in range(2 if rng.random() < 0.3 else 1)]


def _random_injection(rng: random.Random) -> Injection:
    target, kind = rng.choice(TARGETS), rng.choice(KINDS)
    # The fork server has done its work by the first tick; the command has its handlers a while
    # after its start.
    is_early = target == FORK_SERVER or (target != COMMAND and rng.random() < _BEFORE)
    resumed_s = rng.choice(RESUMED_S[: 3 if target in (FORK_SERVER, REPORT) else 4])
    after_s = rng.uniform(0.0, _JOINING_S if is_early or target == REPORT else _LATEST_S)
    return Injection(
        target=target, kind=kind, is_early=is_early, after_s=after_s, resumed_s=resumed_s
    )


def execute(seed: int, number: int, folder: Path, stop: threading.Event) -> Result:
    """Execute the run of a number and check it; end all of its processes."""
    settings, injections = random_run(seed, number)
    exit_code, problems = execute_run(settings, injections, folder, stop)
    first, *others = injections
    label = "two at once" if others else f"{first.kind} to {first.target.rstrip('1234')}"
    details = (*map(str, injections), *settings)
    return Result(
        number=number, label=label, outcome=f"exit {exit_code}", problems=problems, details=details
    )


def execute_run(
    settings: list[str], injections: list[Injection], folder: Path, stop: threading.Event
) -> tuple[int, dict[str, str]]:
    """Execute a run in a folder where no other process works, check it, and end all of its processes.

    Returns: Exit code of the command (negative for a signal), problems by kind.
    """
    run, output = folder / "run", folder / "output.txt"
    words = [*python("transport"), "run", "resilient", "--out", run.name]
    words += [] if any(injection.target == REPORT for injection in injections) else ["--no-figures"]
    words += [word for setting in settings for word in ("--set", setting)]
    with output.open("wb") as file:
        command = subprocess.Popen(
            words,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
        )

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    try:
        threads = [
            threading.Thread(target=_inject, args=(each, command, run, is_over))
            for each in injections
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        is_frozen = any(injection.freezes_the_command for injection in injections)
        hangs = not wait(is_over, _FROZEN_S if is_frozen else _END_S) and not is_frozen
    finally:
        if command.poll() is None:
            command.kill()
        command.wait()
    return command.returncode, dict(_problems(folder, injections, command.returncode, hangs=hangs))


def _inject(
    injection: Injection, command: "subprocess.Popen[bytes]", run: Path, is_over: Callable[[], bool]
) -> None:
    """Send the signals of one injection in time, if the process exists by then."""

    def pid() -> int | None:
        return (
            command.pid
            if injection.target == COMMAND
            else _processes_below(run.parent).get(injection.target)
        )

    joined = run / "logs" / "coordinator.log"
    if injection.is_early or injection.target == REPORT:
        wait(lambda: pid() is not None or is_over(), _BEGIN_S)
    else:
        wait(
            lambda: (
                (joined.exists() and '"joined"' in joined.read_text(errors="replace")) or is_over()
            ),
            _BEGIN_S,
        )
    wait(is_over, injection.after_s)
    found = pid()
    if is_over() or found is None:
        return
    with suppress(ProcessLookupError):
        os.kill(found, signal.Signals[f"SIG{injection.kind}"])
        if injection.kind == "STOP" and injection.resumed_s is not None:
            time.sleep(injection.resumed_s)
            os.kill(found, signal.SIGCONT)


def _processes_below(folder: Path) -> dict[str, int]:
    """Return the living processes that work in a folder or below it, by their names in a run."""
    found: dict[str, int] = {}
    for process in (entry.name for entry in Path("/proc").iterdir() if entry.name.isdecimal()):
        with suppress(OSError):
            is_below = Path(f"/proc/{process}/cwd").readlink().is_relative_to(folder.resolve())
            if is_below and (words := command_of(process)):  # none of a zombie
                found.setdefault(_name_of(words), int(process))
    return found


def end_orphans(folder: Path) -> str:
    """Wait for the processes that work below a folder to end; kill those left, and name them."""
    if wait(lambda: not _processes_below(folder), _ORPHANS_S):
        return ""
    left = _processes_below(folder)
    for pid in left.values():
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return ", ".join(left)


def _name_of(words: list[str]) -> str:
    """Return the name of a process of a run by its command line, or the command line of one that is not known."""
    after = words[words.index("transport") + 1 :] if "transport" in words else words
    if after[:1] == ["agent"] and "--id" in after:
        return f"agent{after[after.index('--id') + 1]}"
    known = {"run": COMMAND, "plot": REPORT, "coordinator": "coordinator", "plant": "plant"}
    return known.get(" ".join(after[:1]), FORK_SERVER if FORK_SERVER in words else " ".join(words))


def _problems(
    folder: Path, injections: list[Injection], code: int, *, hangs: bool
) -> Iterator[tuple[str, str]]:
    """Yield what is wrong after a run, by kind; end the processes that are left."""
    if hangs:
        yield "hang", f"the command has not ended within {_END_S:g} s"
    left = end_orphans(folder)
    if left:
        yield "orphan", left
    for path in (*folder.rglob("*.txt"), *folder.rglob("*.log")):
        text = path.read_text(errors="replace")
        if "Traceback (most recent call last)" in text:
            yield "traceback", f"{path.name}: {text.strip().splitlines()[-1]}"
    ends: list[int] = []
    if (path := folder / "run" / "run.mcap").exists():
        try:
            ends = [control.exit_code for control in read_log(path).of(Control)]
        except Exception as error:  # noqa: BLE001  # any error is the finding
            yield "unreadable log", f"{type(error).__name__}: {error}"
    expected = {0, 4, 6}
    for injection in injections:
        if injection.target == COMMAND and (
            injection.freezes_the_command or injection.kind in ("KILL", "SEGV")
        ):
            expected |= {-signal.SIGKILL, -signal.SIGSEGV}
        if injection.target in (COMMAND, "coordinator") and injection.kind in (
            "TERM",
            "INT",
            "HUP",
        ):
            expected.add(EXIT_INTERRUPTED)
    if code not in expected and not hangs:
        yield "wrong exit code", f"{code}, expected one of {sorted(expected)}"
    elif code in (0, 6) and code not in ends:
        yield "wrong exit code", f"{code}, but the log says {ends or 'nothing'}"
