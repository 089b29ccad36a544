"""Signals campaign: kills, freezes and interrupts processes of random runs.

After each run the command must have ended, within 30 s of the last signal or of the end of a stop beside the time it
takes anyhow; time in which its processes wait for a processor does not count. No process may be left, no output may
have a traceback, the log must open and the exit code must fit.
"""

import os
import signal
import subprocess
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Control
from tests.campaigns.harness import Result
from tests.campaigns.inspection import (
    COMMAND,
    DRAWING,
    catches,
    log_in,
    names_below,
    remains,
    state_of,
    wait_for,
    wait_given,
)
from tests.campaigns.signal_runs import Injection, SignalRun, random_run
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


@dataclass(slots=True)
class _Sending:
    """State of the injections of one run."""

    sent: int = 0
    is_frozen: bool = False  # the command, for good
    is_unready: bool = False  # the command had no handler yet for the signal it got


def execute(seed: int, number: int, folder: Path, stop: threading.Event) -> Result:
    """Execute the run of a number and check it; end all of its processes."""
    run = random_run(seed, number)
    exit_code, problems, sent = execute_run(run, folder, stop)
    first, *others = run.injections
    return Result(
        number=number,
        label="two at once" if others else f"{first.sent} to {_CALLED.get(first.target, first.target)}",
        outcome=f"exit {exit_code}",
        problems=problems,
        details=(f"{sent} signals sent", *map(str, run.injections), *run.settings),
    )


def execute_run(run: SignalRun, folder: Path, stop: threading.Event) -> tuple[int, dict[str, str], int]:
    """Execute a run and check it; end all of its processes.

    Args:
        run: The run.
        folder: For its run folder and the output of the command; no other process may work there.
        stop: Set to end the run early.
    Returns: Exit code of the command (negative for a signal), problems by kind, number of signals sent.
    """
    name = f"signals-{run.number}-{os.getpid()}"
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
            command.wait()
    problems: dict[str, str] = {}
    if hangs and not sending.is_frozen:
        problems["hang"] = f"the command has not ended within {_DEADLINE_S:g} s"
    problems |= remains(folder)
    if sending.is_unready:
        problems.pop("traceback", None)
    log, unreadable = log_in(folder / name)
    if unreadable:
        problems["unreadable log"] = unreadable
    wrong = _wrong_exit_code(run, command.returncode, log, is_unready=sending.is_unready)
    if wrong and "hang" not in problems:
        problems["wrong exit code"] = wrong
    return command.returncode, problems, sending.sent


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
