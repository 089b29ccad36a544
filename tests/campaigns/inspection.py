"""Remains of a command: processes, tracebacks, logs that do not open."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from tests.support.commands import command_of
from transport.log.run_log import RunLog, read_log

# Time for the processes of a killed command to end, s.
ORPHANS_S = 20.0
_POLL_S, _LOOK_S = 0.02, 0.25
_SIGCGT = "SigCgt:"

# Names of processes of a run besides coordinator, plant, agent1, ...: the command itself, which contains the recorder
# and whose exit code is the run's; the process that reports, and those that draw for it.
COMMAND, FORK_SERVER, REPORT, DRAWING, VIEWER = "transport", "fork-server", "report", "drawing", "viewer"
# Programs that libraries start for a moment: compiler and linker in the first run on a machine, uname for its name.
TOOL = "tool"
_BY_COMMAND = {"run": COMMAND, "plot": REPORT, "view": VIEWER, "coordinator": "coordinator", "plant": "plant"}
_TOOLS = frozenset({"cc", "gcc", "clang", "cc1", "as", "collect2", "ld", "uname"})


def wait_for(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Poll a condition; return whether it came true in time."""
    until_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until_s:
            return False
        time.sleep(_POLL_S)
    return True


def wait_given(condition: Callable[[], bool], folder: Path, timeout_s: float) -> bool:
    """Poll a condition; return whether it came true before processes that work in a folder were idle for too long.

    Time in which one of them waits for a processor does not count, so that a busy machine does not look like a hang.
    """
    left_s = timeout_s
    while not condition():
        if left_s < 0.0:
            return False
        began_s, waited_s = time.monotonic(), _waited_s(folder)
        wait_for(condition, _LOOK_S)
        longest_s = max((now_s - waited_s.get(pid, now_s) for pid, now_s in _waited_s(folder).items()), default=0.0)
        left_s -= max(0.0, time.monotonic() - began_s - longest_s)
    return True


def _waited_s(folder: Path) -> dict[int, float]:
    """Return how long each process in a folder has waited for a processor, s, without zombies (proc(5), schedstat)."""
    found = {}
    for pid in processes_below(folder):
        with suppress(OSError, IndexError):  # gone since
            found[pid] = int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9
    return found


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
    """Return the name of a process of a run by its command line, or the command line of one that is not known.

    An agent that was started again, or waits for that, has its incarnation in its name, as in that of its output:
    agent2-1.
    """
    if "fork-server" in words or any(word.endswith("transport.cli.fork_server") for word in words):
        return FORK_SERVER
    if words and _TOOLS & set(Path(words[0]).name.split("-")):  # x86_64-linux-gnu-gcc-12
        return TOOL
    after = words[words.index("transport") + 1 :] if "transport" in words else []
    if after[:1] == ["agent"] and "--id" in after:
        incarnation = after[after.index("--incarnation") + 1] if "--incarnation" in after else "0"
        return f"agent{after[after.index('--id') + 1]}{'' if incarnation == '0' else f'-{incarnation}'}"
    return _BY_COMMAND.get(after[0] if after else "", " ".join(words))


def names_below(folder: Path) -> dict[int, str]:
    """Return the names of all living processes that work in a folder or below it, by process id, ascending."""
    found = {pid: name_of(words) for pid, words in sorted(processes_below(folder).items())}
    # A process that draws is forked from the one that reports, and has its command line.
    drawing = [pid for pid, name in found.items() if name == REPORT and found.get(parent_of(pid)) == REPORT]
    return found | dict.fromkeys(drawing, DRAWING)


def parent_of(pid: int) -> int:
    """Return the process id of a process's parent, or 0 if the process is gone."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
    except (OSError, IndexError):
        return 0


def end_orphans(folder: Path) -> list[str]:
    """Return the names of processes that are left in a folder after a while, and kill them."""
    if wait_given(lambda: not processes_below(folder), folder, ORPHANS_S):
        return []
    left = names_below(folder)
    for pid in left:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return list(left.values())


def remains(folder: Path) -> dict[str, str]:
    """Return problems after a command by kind: processes left in its folder, which are killed, and tracebacks."""
    found = {"orphan": ", ".join(end_orphans(folder)), "traceback": "; ".join(tracebacks(folder))}
    return {kind: text for kind, text in found.items() if text}


def tracebacks(folder: Path) -> Iterator[str]:
    """Yield the files in a folder that have a traceback, each with its last line."""
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
