"""Crash fuzzer: `python -m tests.support.crash_fuzzer` kills, freezes and interrupts processes of short runs at random.

After each run the command must have ended, no process may be left, the log must be readable and the exit code must
fit. A run is drawn from a seed and its number, so each can be repeated. Exit code 1 if any run has a problem.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from protocol.network.health import command_of
from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Control
from tests.support.fuzz_runs import COMMAND, FuzzRun, Injection, random_run
from transport.log.run_log import RunLog, read_log

# Time for a command to end after the last injection: the network gives up a frozen process after 10 s, the rest is for
# slow machines.
_DEADLINE_S = 60.0
# Time for the processes of a killed command to end.
_ORPHANS_S = 20.0
# A command that is frozen for good is killed after this time.
_FROZEN_S = 8.0
# A starting command may not have installed its signal handlers until then.
_HANDLERS_S = 0.5
# Time for all threads of a process to stop.
_STOPPING_S = 1.0
# Injections happen after this time even if the run has not begun.
_BEGIN_S = 30.0
_POLL_S = 0.02

_KINDS = ("hang", "orphan", "unreadable log", "wrong exit code")


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a run: the command's exit code (negative for a signal), and problems by kind."""

    run: FuzzRun
    exit_code: int
    problems: Mapping[str, str] = field(default_factory=dict)


def execute(run: FuzzRun, folder: Path, stop: threading.Event) -> Result:
    """Execute one run and check it; end all of its processes.

    Args:
        run: The run.
        folder: For its run folder and the output of the command.
        stop: Set to end the run early.
    """
    name = f"fault-{run.number}-{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [*python("transport"), "run", "resilient", "--out", name, "--no-figures"]
    for setting in run.settings:
        arguments += ["--set", setting]
    with (folder / f"{name}.txt").open("wb") as output:
        command = subprocess.Popen(
            arguments, cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            frozen = _inject_all(run, command, folder / name, stop)
            timeout_s = _FROZEN_S if frozen else _DEADLINE_S
            hangs = not _wait_for(lambda: command.poll() is not None or stop.is_set(), timeout_s)
        finally:
            if command.poll() is None:
                command.kill()
            command.wait()
    problems: dict[str, str] = {}
    if hangs and not frozen:
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
    wrong = _wrong_exit_code(run, command.returncode, log)
    if wrong and "hang" not in problems:
        problems["wrong exit code"] = wrong
    return Result(run=run, exit_code=command.returncode, problems=problems)


def _inject_all(run: FuzzRun, command: "subprocess.Popen[bytes]", folder: Path, stop: threading.Event) -> bool:
    """Send all signals; return whether the command is left frozen."""
    started_s = time.monotonic()
    threads = [threading.Thread(target=_inject, args=(i, command, folder, started_s, stop)) for i in run.injections]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if not any(i.target == COMMAND and i.signal == signal.SIGSTOP for i in run.injections):
        return False
    _wait_for(lambda: _state(command.pid) == "T" or command.poll() is not None, _STOPPING_S)
    return _state(command.pid) == "T"


def _inject(
    injection: Injection, command: "subprocess.Popen[bytes]", folder: Path, started_s: float, stop: threading.Event
) -> None:
    """Send the signals of one injection in time, if the process exists by then."""

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    if injection.since == "first tick":
        _wait_for(lambda: _has_begun(folder) or is_over(), _BEGIN_S)
        started_s = time.monotonic()
    for after_s, number in ((injection.after_s, injection.signal), (injection.resumed_s, signal.SIGCONT)):
        if after_s is None:
            return
        _wait_for(is_over, started_s + after_s - time.monotonic())
        if is_over():
            return
        pid = command.pid if injection.target == COMMAND else processes_of(folder.name).get(injection.target)
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        started_s = time.monotonic()


def processes_of(run: str) -> dict[str, int]:
    """Return names and pids of the living processes of a run, read from /proc."""
    found = {}
    for pid in (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal()):
        arguments = command_of(str(pid))
        if _state(pid) in ("", "Z") or "--run" not in arguments:
            continue
        if arguments[arguments.index("--run") + 1 :][:1] != [run]:
            continue
        role = arguments[arguments.index("transport") + 1] if "transport" in arguments else arguments[0]
        found[f"agent{arguments[arguments.index('--id') + 1]}" if role == "agent" else role] = pid
    return found


def _state(pid: int) -> str:
    """Return the state letter of a process (proc(5)), or nothing if the process is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (OSError, IndexError):
        return ""


def _has_begun(folder: Path) -> bool:
    """Return whether all processes have joined the coordinator."""
    try:
        return '"joined"' in (folder / "logs" / "coordinator.log").read_text(errors="replace")
    except OSError:
        return False


def _log(folder: Path) -> tuple[RunLog | None, str]:
    """Return the log of a run folder, or the reason why it is unreadable; neither if the run never began."""
    path = folder / "run.mcap"
    if not path.exists():
        return None, ""
    try:
        return read_log(path), ""
    except Exception as error:  # noqa: BLE001  # any error is the finding
        return None, f"{type(error).__name__}: {error}"


def _wrong_exit_code(run: FuzzRun, code: int, log: RunLog | None) -> str:
    """Return what is wrong with an exit code, or nothing."""
    expected = {0, 4, 6}
    for injection in run.injections:
        if injection.target == COMMAND and injection.signal in (signal.SIGKILL, signal.SIGSTOP):
            expected.add(-signal.SIGKILL)
        if injection.target in (COMMAND, "coordinator") and injection.signal in (signal.SIGTERM, signal.SIGINT):
            expected.add(EXIT_INTERRUPTED)
        if injection.target == COMMAND and injection.since == "start" and injection.after_s < _HANDLERS_S:
            expected.add(-injection.signal)
    if code not in expected:
        return f"{code}, expected one of {', '.join(map(str, sorted(expected)))}"
    ends = [] if log is None else [control.exit_code for control in log.of(Control)]
    if code in (0, 5, 6) and code not in ends:
        return f"{code}, but the log says {ends or 'nothing'}"
    return ""


def _wait_for(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition; return whether it came true in time."""
    until_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until_s:
            return False
        time.sleep(_POLL_S)
    return True


def _execute_all(runs: Sequence[FuzzRun], folder: Path, jobs: int) -> Iterator[Result]:
    """Execute runs, several at a time; keep the folders of those with problems."""
    stop = threading.Event()
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


def _exit_codes(results: Sequence[Result]) -> Iterator[str]:
    """Yield a line for each kind of injection: how often each exit code came."""
    rows: dict[str, Counter[int]] = {}
    for result in results:
        injection, *others = result.run.injections
        target = "agent" if injection.target.startswith("agent") else injection.target
        sent = "SIGSTOP, SIGCONT" if injection.resumed_s is not None else injection.signal.name
        rows.setdefault("two at once" if others else f"{sent} to {target}", Counter())[result.exit_code] += 1
    yield "runs by exit code"
    for name, counts in sorted(rows.items()):
        yield f"  {name:<32}" + ", ".join(f"{count} x {code}" for code, count in sorted(counts.items()))


def main() -> int:
    """Run the fuzzer with the options of the command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.crash_fuzzer", description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="end before this number")
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=0, help="random seed of all runs")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time; each has seven processes")
    parser.add_argument("--out", type=Path, help="folder for runs with problems; runs/faults-SEED by default")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    folder = options.out or Path("runs") / f"faults-{options.seed}"
    runs = [random_run(options.seed, number) for number in range(options.first, options.runs)]
    try:
        results = sorted(_execute_all(runs, folder, options.jobs), key=lambda result: result.run.number)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    lines = list(_exit_codes(results))
    counts = Counter(kind for result in results for kind in result.problems)
    found = ", ".join(f"{counts[kind]} {kind}{'' if counts[kind] == 1 else 's'}" for kind in _KINDS)
    lines.append(f"{len(results)} runs: {found}")
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
