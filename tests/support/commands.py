"""The command `transport` as a separate process."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, chdir, closing, contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import psutil

from transport.flight.fork_server import Start, close_fork_server, fork_server

# A maneuver short enough for tests that start processes: 1.5 s, 30 ticks.
SHORT = (
    "maneuver.phase=["
    "{name='hover', duration_s=0.5, displacement_m=[0.0, 0.0, 0.0]},"
    "{name='climb', duration_s=1.0, displacement_m=[0.0, 0.0, -0.5]}]"
)
# Settings of a run paced to real time that lasts until a test ends it.
ENDLESS = ("clock.speed=1.0",)

# Time to start six processes on a busy machine with two cores, s.
PATIENCE_S = 120.0


def command(*arguments: str | Path) -> list[str]:
    """Return the argument list of the command."""
    return [sys.executable, "-m", "transport", *map(str, arguments)]


def transport(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command to its end and return the result."""
    return subprocess.run(
        command(*arguments),
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S * 2,
        check=False,
    )


def start(*arguments: str | Path, cwd: Path) -> subprocess.Popen[str]:
    """Start the command in a session of its own."""
    return subprocess.Popen(
        command(*arguments),
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@contextmanager
def forks() -> Iterator[Callable[..., list[psutil.Process]]]:
    """Yield a function that starts commands in the current folder by one fork server, and end all at last.

    Each command is a list of words. The imports, most of the processor time of a process in a short test, are
    done once. The outputs are in the current folder: `process0.txt`, `process1.txt`, ...
    """
    started: list[psutil.Process] = []

    def begin(*commands: Sequence[str]) -> list[psutil.Process]:
        with ExitStack() as files:
            null = files.enter_context(Path(os.devnull).open("rb"))
            outputs = (
                files.enter_context(Path(f"process{len(started) + i}.txt").open("wb"))
                for i in range(len(commands))
            )
            pairs = zip(commands, outputs, strict=True)
            starts = [Start(each, null.fileno(), output.fileno()) for each, output in pairs]
            begun = fork_server().start(starts, {})
        started.extend(begun)
        return begun

    try:
        yield begin
    finally:
        for process in started:
            if process.is_running():
                process.kill()
            process.wait()
        close_fork_server()


@dataclass(frozen=True, slots=True)
class Forked:
    """A command that a fork server has started, and the file with all that it prints."""

    process: psutil.Process
    output: Path

    def end(self) -> tuple[int, str]:
        """Wait for its end; return exit code and output."""
        code = self.process.wait(PATIENCE_S * 2)
        assert code is not None
        return code, self.output.read_text(encoding="utf-8")


@contextmanager
def forked_commands() -> Iterator[Callable[..., Forked]]:
    """Yield a function that starts a command in a folder by a fork server, the same for all."""
    numbers = count()
    with forks() as begin:

        def one(*arguments: str | Path, cwd: Path) -> Forked:
            with chdir(cwd):
                (process,) = begin([*map(str, arguments)])
            return Forked(process, cwd / f"process{next(numbers)}.txt")

        yield one


def settings(*changes: str) -> list[str]:
    """Return `--set` options for settings."""
    return [part for change in changes for part in ("--set", change)]


def command_of(process: str) -> list[str]:
    """Return the words of a process's command line, or of its title if it has set one.

    None when it has ended.
    """
    try:
        content = (Path("/proc") / process / "cmdline").read_bytes()
    except OSError:
        return []
    return content.replace(b"\0", b" ").decode(errors="replace").split()


def processes_of(run: str) -> dict[str, int]:
    """Return names and pids of the living processes of a run, read from the system's process table."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except (OSError, IndexError):
            continue
        words = command_of(entry.name)
        if (
            state == "Z"
            or _is_of_another_worker(entry)
            or "--run" not in words
            or words[words.index("--run") + 1] != run
        ):
            continue
        role = words[words.index("transport") + 1]
        found["agent" + words[words.index("--id") + 1] if role == "agent" else role] = int(
            entry.name
        )
    return found


def _is_of_another_worker(process: Path) -> bool:
    """Return whether a process of /proc belongs to another pytest worker.

    It works in that worker's temporary folder, or descends from it.
    """
    own = f"popen-{os.environ.get('PYTEST_XDIST_WORKER', '')}"
    try:
        folder = (process / "cwd").readlink()
    except OSError:
        return False
    if any(part.startswith("popen-gw") and part != own for part in folder.parts):
        return True
    ancestors = _ancestors(int(process.name))
    return os.getppid() in ancestors and os.getpid() not in ancestors


def _ancestors(pid: int) -> set[int]:
    """Return the pids of a process's parent, its parent and so on."""
    found: set[int] = set()
    while pid > 1:
        try:
            stat = Path(f"/proc/{pid}/stat").read_text()
        except OSError:
            break
        pid = int(stat.rsplit(")", 1)[1].split()[1])
        found.add(pid)
    return found


def wait_for(
    condition: Callable[[], bool], timeout_s: float = PATIENCE_S, every_s: float = 0.05
) -> bool:
    """Poll a condition; return whether it came true in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(every_s)
    return True


def is_flying(folder: Path, names: Sequence[str]) -> Callable[[], bool]:
    """Return whether every process of a run has joined, according to their logs so far."""

    def joined(name: str) -> bool:
        log = folder / "logs" / f"{name}.log"
        return log.exists() and '"joined"' in log.read_text()

    return lambda: all(joined(name) for name in names)


def free_base() -> int:
    """Return a base port with free ports for a run above it.

    Simultaneous test runs and workers use different ports.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    bases = range(20_000 + 16 * (worker % 4), 30_000, 64)
    first = os.getpid() % len(bases)
    candidates: list[int] = [*bases[first:], *bases[:first]]
    return next(base for base in candidates if all(is_free(base + i) for i in range(8)))


def is_free(port: int) -> bool:
    """Return whether a port is free."""
    with closing(socket.socket()) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
