"""Signals campaign: `python -m tests.campaigns.signals` kills, freezes and interrupts processes of random runs.

After each run the command must have ended, within 30 s of the last signal or of the end of a stop beside the time it
takes anyhow; time in which its processes wait for a processor does not count. No process may be left, no output may
have a traceback, the log must open and the exit code must fit. A run is drawn from a seed and its number, so each can
be repeated. Exit code 1 if any run has a problem.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Control
from tests.campaigns.inspection import (
    COMMAND,
    DRAWING,
    catches,
    end_orphans,
    log_in,
    names_below,
    state_of,
    tracebacks,
    wait_for,
    wait_given,
)
from tests.campaigns.signal_runs import Injection, SignalRun, random_run
from tests.support.trace_stop import TraceError, trace_stopped
from transport.log.run_log import RunLog

# Time for a command to end after the last injection, s: 30, and what an undisturbed run takes.
_DEADLINE_S = 30.0 + 15.0
# A command that is frozen for good is killed after this time.
_FROZEN_S = 8.0
# Time for all threads of a process to stop.
_STOPPING_S = 1.0
# Injections happen after this time even if the run has not begun.
_BEGIN_S = 30.0

# Processes that share a line of the table.
_CALLED = dict.fromkeys(("agent1", "agent2", "agent3", "agent4"), "agent")
_PROBLEMS = ("hang", "orphan", "traceback", "unreadable log", "wrong exit code")


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a run: the command's exit code (negative for a signal), signals sent, and problems by kind."""

    run: SignalRun
    exit_code: int
    sent: int = 0
    problems: Mapping[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class _Sending:
    """State of the injections of one run."""

    sent: int = 0
    is_frozen: bool = False  # the command, for good
    is_unready: bool = False  # the command had no handler yet for the signal it got
    traces: ExitStack = field(default_factory=ExitStack)


def execute(run: SignalRun, folder: Path, stop: threading.Event) -> Result:
    """Execute one run and check it; end all of its processes.

    Args:
        run: The run.
        folder: For its run folder and the output of the command; no other process may work there.
        stop: Set to end the run early.
    """
    name = f"signals-{run.number}-{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [*python("transport"), "run", "resilient", "--out", name]
    arguments += [*([] if run.figures else ["--no-figures"]), *(["--view", "--port", "0"] if run.viewer else [])]
    for setting in run.settings:
        arguments += ["--set", setting]
    sending = _Sending()
    with (folder / f"{name}.txt").open("wb") as output:
        command = subprocess.Popen(
            arguments, cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            _inject_all(run, command, folder / name, stop, sending)
            timeout_s = _FROZEN_S if sending.is_frozen else _DEADLINE_S

            def is_over() -> bool:
                return command.poll() is not None or stop.is_set()

            if run.viewer:
                said = folder / f"{name}.txt"
                wait_given(lambda: waits_for_user(said) or is_over(), folder, timeout_s)
                if waits_for_user(said):
                    command.send_signal(signal.SIGTERM)
            hangs = not wait_given(is_over, folder, timeout_s)
        finally:
            if command.poll() is None:
                command.kill()
            sending.traces.close()
            command.wait()
    problems: dict[str, str] = {}
    if hangs and not sending.is_frozen:
        problems["hang"] = f"the command has not ended within {_DEADLINE_S:g} s"
    orphans = end_orphans(folder)
    if orphans:
        problems["orphan"] = ", ".join(orphans)
    found = [] if sending.is_unready else list(tracebacks(folder))
    if found:
        problems["traceback"] = "; ".join(found)
    log, unreadable = log_in(folder / name)
    if unreadable:
        problems["unreadable log"] = unreadable
    wrong = _wrong_exit_code(run, command.returncode, log, is_unready=sending.is_unready)
    if wrong and "hang" not in problems:
        problems["wrong exit code"] = wrong
    return Result(run=run, exit_code=command.returncode, sent=sending.sent, problems=problems)


def _inject_all(
    run: SignalRun, command: "subprocess.Popen[bytes]", folder: Path, stop: threading.Event, sending: _Sending
) -> None:
    """Send all signals."""
    started_s = time.monotonic()
    threads = [
        threading.Thread(target=_inject, args=(i, command, folder, started_s, stop, sending)) for i in run.injections
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if any(i.target == COMMAND and i.is_final_stop for i in run.injections):
        sending.is_frozen = wait_for(lambda: state_of(command.pid) in ("T", "t"), _STOPPING_S)


def _inject(
    injection: Injection,
    command: "subprocess.Popen[bytes]",
    folder: Path,
    started_s: float,
    stop: threading.Event,
    sending: _Sending,
) -> None:
    """Send the signals of one injection in time, if the process exists by then."""

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    if injection.since == "first tick":
        wait_for(lambda: _has_begun(folder) or is_over(), _BEGIN_S)
        started_s = time.monotonic()
    if injection.since == "report" or injection.target == DRAWING:
        wait_for(lambda: (folder / "summary.json").exists() or is_over(), _BEGIN_S)
        started_s = time.monotonic()
    if injection.since == "start" and injection.target != COMMAND:
        wait_for(lambda: _pid_of(injection.target, command, folder.parent) is not None or is_over(), _BEGIN_S)
        started_s = time.monotonic()
    wait_for(is_over, started_s + injection.after_s - time.monotonic())
    pid = _pid_of(injection.target, command, folder.parent)
    if is_over() or pid is None:
        return
    if injection.target == COMMAND and not catches(pid, signal.SIGTERM):
        sending.is_unready = True
    sending.sent += 1
    if injection.kind.startswith("trace stop"):
        with suppress(TraceError):
            tracing = trace_stopped(pid, first_thread=injection.kind != "trace stop")
            sending.traces.enter_context(tracing)
        return
    with suppress(ProcessLookupError):
        os.kill(pid, injection.number)
        if injection.resumed_s is not None:
            wait_for(stop.is_set, injection.resumed_s)
            os.kill(pid, signal.SIGCONT)


def _pid_of(target: str, command: "subprocess.Popen[bytes]", folder: Path) -> int | None:
    """Return the process id of a target, or None if there is none yet or no more."""
    if target == COMMAND:
        return command.pid
    return next((pid for pid, name in names_below(folder).items() if name == target), None)


def waits_for_user(output: Path) -> bool:
    """Return whether a command has said that its viewer stays open until the user ends it."""
    return b"the viewer stays open" in output.read_bytes()


def _has_begun(folder: Path) -> bool:
    """Return whether all processes have joined the coordinator."""
    try:
        return '"joined"' in (folder / "logs" / "coordinator.log").read_text(errors="replace")
    except OSError:
        return False


def _wrong_exit_code(run: SignalRun, code: int, log: RunLog | None, *, is_unready: bool) -> str:
    """Return what is wrong with an exit code, or nothing."""
    expected = {0, 4, 6}
    for injection in run.injections:
        if injection.target == COMMAND and (injection.is_final_stop or injection.kind == "KILL"):
            expected.add(-signal.SIGKILL)
        if injection.target == COMMAND and (injection.kind == "SEGV" or is_unready):
            expected.add(-injection.number)
        if injection.target in (COMMAND, "coordinator") and injection.kind in ("TERM", "INT", "HUP"):
            expected.add(EXIT_INTERRUPTED)
    if code not in expected:
        return f"{code}, expected one of {', '.join(map(str, sorted(expected)))}"
    ends = [] if log is None else [control.exit_code for control in log.of(Control)]
    if code in (0, 5, 6) and code not in ends:
        return f"{code}, but the log says {ends or 'nothing'}"
    return ""


def _execute_all(runs: Sequence[SignalRun], folder: Path, jobs: int) -> Iterator[Result]:
    """Execute runs, several at a time; keep the folders of those with problems."""
    stop = threading.Event()
    for run in runs:  # kept by an earlier campaign, whose process id may have been the same
        shutil.rmtree(folder / str(run.number), ignore_errors=True)
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(execute, run, folder / str(run.number), stop) for run in runs]
        try:
            for future in as_completed(futures):
                result = future.result()
                if not result.problems:
                    shutil.rmtree(folder / str(result.run.number), ignore_errors=True)
                sys.stderr.write(f"run {result.run.number}: {', '.join(result.problems) or 'no problem'}\n")
                yield result
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    with suppress(OSError):
        folder.rmdir()  # only if no folder was kept


def table(results: Sequence[Result]) -> Iterator[str]:
    """Yield a line for each kind of injection: how often each exit code came, and the problems."""
    rows: dict[str, Counter[str]] = {}
    for result in results:
        first, *others = result.run.injections
        sent = "two at once" if others else f"{first.sent} to {_CALLED.get(first.target, first.target)}"
        row = rows.setdefault(sent, Counter())
        row[f"exit {result.exit_code}"] += 1
        row.update(list(result.problems))
    yield "runs by exit code"
    for name, counts in sorted(rows.items()):
        yield f"  {name:<44}" + ", ".join(f"{count} x {outcome}" for outcome, count in sorted(counts.items()))


def main() -> int:
    """Run the campaign with the options of the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.signals", description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="end before this number")
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=0, help="random seed of all runs")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time; each has eight processes")
    parser.add_argument("--out", type=Path, help="folder for runs with problems; runs/signals-SEED by default")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The commands inherit these: they would ignore SIGINT in the background of a shell, and SIGHUP under nohup.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    folder = options.out or Path("runs") / f"signals-{options.seed}"
    runs = [random_run(options.seed, number) for number in range(options.first, options.runs)]
    try:
        results = sorted(_execute_all(runs, folder, options.jobs), key=lambda result: result.run.number)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    lines = list(table(results))
    counts = Counter(kind for result in results for kind in result.problems)
    found = ", ".join(f"{counts[kind]} {kind}{'' if counts[kind] == 1 else 's'}" for kind in _PROBLEMS)
    lines.append(f"{len(results)} runs, {sum(result.sent for result in results)} signals: {found}")
    for result in (result for result in results if result.problems):
        number = result.run.number
        lines += ["", f"run {number}, kept in {folder / str(number)}; repeat with:"]
        lines += [f"  {parser.prog} --seed {options.seed} --first {number} --runs {number + 1}"]
        lines += [f"  {kind}: {text}" for kind, text in result.problems.items()]
        lines += [f"  {line}" for line in (*result.run.injections, *result.run.settings)]
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if counts else 0


if __name__ == "__main__":
    sys.exit(main())
