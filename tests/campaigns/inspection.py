"""Remains of a command: processes, tracebacks, logs that do not open."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from protocol.network.health import command_of
from protocol.wire import exit_codes
from transport.log.run_log import RunLog, read_log

# Exit codes of the table (docs/command-line.md).
TABLE = {0, *(code for name, code in vars(exit_codes).items() if name.startswith("EXIT_"))}
# Time for the processes of a killed command to end, s.
ORPHANS_S = 20.0
_POLL_S = 0.02
_SIGCGT = "SigCgt:"


def wait_for(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition; return whether it came true in time."""
    until_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until_s:
            return False
        time.sleep(_POLL_S)
    return True


def state_of(pid: int) -> str:
    """Return the state letter of a process (proc(5)), or nothing if the process is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (OSError, IndexError):
        return ""


def catches(pid: int, number: signal.Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        caught = next(line for line in lines if line.startswith(_SIGCGT))
    except (OSError, StopIteration):
        return False
    return bool(int(caught.removeprefix(_SIGCGT), 16) >> (number - 1) & 1)


def processes_below(folder: Path) -> dict[int, list[str]]:
    """Return the command lines of all living processes that work in a folder or below it, by process id."""
    found = {}
    for pid in (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal()):
        with suppress(OSError):
            if Path(f"/proc/{pid}/cwd").readlink().is_relative_to(folder.resolve()) and state_of(pid) not in ("", "Z"):
                found[pid] = command_of(str(pid))
    return found


def name_of(words: list[str]) -> str:
    """Return the name of a process of a run by its command line: agent2, plant, fork-server, transport."""
    if "fork-server" in words or any(word.endswith("transport.cli.fork_server") for word in words):
        return "fork-server"
    if "--run" not in words or "transport" not in words:
        return "transport"
    role = words[words.index("transport") + 1]
    return f"agent{words[words.index('--id') + 1]}" if role == "agent" else role


def end_orphans(folder: Path) -> list[str]:
    """Return the names of processes that are left in a folder after a while, and kill them."""
    if wait_for(lambda: not processes_below(folder), ORPHANS_S):
        return []
    left = processes_below(folder)
    for pid in left:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return [name_of(words) for words in left.values()]


def tracebacks(*folders: Path) -> Iterator[str]:
    """Yield the files in folders that have a traceback, each with its last line."""
    for folder in folders:
        for path in (*folder.rglob("*.txt"), *folder.rglob("*.log")):
            text = path.read_text(errors="replace")
            if "Traceback (most recent call last)" in text:
                yield f"{path.name}: {text.strip().splitlines()[-1]}"


def log_in(folder: Path) -> tuple[RunLog | None, str]:
    """Return the log of a run folder, or the reason why it is unreadable; neither if there is none."""
    path = folder / "run.mcap"
    if not path.exists():
        return None, ""
    try:
        return read_log(path), ""
    except Exception as error:  # noqa: BLE001  # any error is the finding
        return None, f"{type(error).__name__}: {error}"
