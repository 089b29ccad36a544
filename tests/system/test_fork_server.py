"""Processes of the fork server behave like started ones."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import IO

import pytest

from protocol.network.health import command_of
from protocol.network.parent import PARENT_PIPE
from tests.support.commands import command, wait_for
from tests.support.trace_stop import trace_stopped
from transport.flight import fork_server as fork_server_module
from transport.flight.fork_server import Forked, ForkServer, Started
from transport.flight.vitals import has_died

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

# An agent that waits for agents that never join.
LONELY = ("agent", "--id", "1", "--scenario", "paper", "--run", "lonely", "--listen", "tcp/127.0.0.1:0")

_PIPES: list[IO[bytes]] = []  # closed at the end of a test, which ends the processes


@pytest.fixture
def server() -> Iterator[ForkServer]:
    """A separate server for each test."""
    found = ForkServer()
    yield found
    found.close()
    while _PIPES:
        _PIPES.pop().close()


def begin(server: ForkServer, output: Path, *arguments: str) -> Started:
    """Start a command."""
    with output.open("wb") as file:
        process = server.start(arguments, file, {PARENT_PIPE: "1"})
    assert process.stdin is not None
    _PIPES.append(process.stdin)
    return process


def waits(output: Path) -> bool:
    """Return whether an agent waits for the others."""
    return '"listening"' in output.read_text()


def open_files(pid: int) -> set[str]:
    """Return the open files of a process."""
    return {str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()}


def test_as_if_started(server: ForkServer, tmp_path: Path) -> None:
    """Output and exit code of a forked command are those of a started one."""
    for k, arguments in enumerate((["agent", "--help"], ["agent", "--id", "9"], ["agent", "--id", "x"], ["--version"])):
        process = begin(server, tmp_path / f"{k}.log", *arguments)
        assert isinstance(process, Forked)
        expected = subprocess.run(command(*arguments), capture_output=True, text=True, check=False)
        assert process.wait(60.0) == expected.returncode
        assert (tmp_path / f"{k}.log").read_text() == expected.stdout + expected.stderr
        assert not Path(f"/proc/{process.pid}").exists()  # already waited for


def test_place_of_its_own(server: ForkServer, tmp_path: Path) -> None:
    """A forked process has its own session, title and parent, and no other open files."""
    log = tmp_path / "agent.log"
    process = begin(server, log, *LONELY)
    assert isinstance(process, Forked)
    assert wait_for(lambda: waits(log))
    assert command_of(str(process.pid)) == ["transport", *LONELY]
    assert os.getsid(process.pid) == process.pid
    stat = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    assert int(stat[1]) == os.getpid()
    assert server._process is not None
    assert len(list(Path(f"/proc/{server._process.pid}/task").iterdir())) == 1  # required for fork
    own = open_files(process.pid)
    assert str(log) in own
    assert not [name for name in own & open_files(server._process.pid) if name.startswith(("socket", "pipe"))]
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.05)
    process.terminate()
    assert process.wait(20.0) == 130
    process.send_signal(signal.SIGTERM)  # the signal must not reach another process
    assert process.poll() == 130


def test_killed(server: ForkServer, tmp_path: Path) -> None:
    """The exit code names the signal that ended the process, also for simultaneous calls."""
    log = tmp_path / "agent.log"
    process = begin(server, log, *LONELY)
    assert wait_for(lambda: waits(log))
    codes: list[int] = []
    askers = [threading.Thread(target=lambda: codes.append(process.wait(20.0))) for _ in range(4)]
    for asker in askers:
        asker.start()
    process.kill()
    for asker in askers:
        asker.join()
    assert codes == [-signal.SIGKILL] * 4


def test_orphans_end(server: ForkServer, tmp_path: Path) -> None:
    """Forked processes end when their parent's pipe closes, also after the end of the server."""
    log = tmp_path / "agent.log"
    process = begin(server, log, *LONELY)
    assert wait_for(lambda: waits(log))
    server.close()
    time.sleep(0.2)
    assert process.poll() is None
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(20.0) == 4


def test_server_ends_with_its_process(tmp_path: Path) -> None:
    """The server ends when its process is killed."""
    code = (
        "import time\nfrom transport.flight.fork_server import fork_server\n"
        "print(fork_server()._process.pid, flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=tmp_path, text=True) as process:
        assert process.stdout is not None
        number = process.stdout.readline().strip()
        assert wait_for(lambda: command_of(number) == ["transport", "fork-server"])
        process.kill()
    assert wait_for(lambda: command_of(number) == [])


def test_without_server(tmp_path: Path, server: ForkServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes are started where fork is impossible: another system, a dead server, changed variables."""
    monkeypatch.setattr(sys, "platform", "darwin")
    elsewhere = ForkServer()
    monkeypatch.undo()
    assert elsewhere._process is None
    assert begin(elsewhere, tmp_path / "elsewhere.log", "--version").wait(60.0) == 0
    monkeypatch.setenv("PAYLOAD_TRANSPORT_NATIVE", "0")
    other = begin(server, tmp_path / "other.log", "--version")
    assert not isinstance(other, Forked)
    assert other.wait(60.0) == 0
    monkeypatch.undo()
    same = begin(server, tmp_path / "same.log", "--version")
    assert isinstance(same, Forked)
    assert same.wait(60.0) == 0
    assert server._process is not None
    server._process.kill()
    server._process.wait()
    assert begin(server, tmp_path / "gone.log", "--version").wait(60.0) == 0
    assert (tmp_path / "gone.log").read_text() == (tmp_path / "elsewhere.log").read_text()


def test_environment_and_folder_of_now(server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folder, variables and scenario are the current ones, not those at the start of the server."""
    scenario = tmp_path / "scenario.toml"
    ready = subprocess.run(command("validate", "paper"), capture_output=True, text=True, check=True).stdout
    monkeypatch.chdir(tmp_path)
    for name in ("first", "second"):
        scenario.write_text(ready.replace('name = "paper"', f'name = "{name}"'))
        process = begin(server, tmp_path / "log", "agent", "--id", "9", "--scenario", "scenario.toml")
        assert isinstance(process, Forked)
        assert process.wait(60.0) == 2
        assert f"of scenario {name}, got 9" in (tmp_path / "log").read_text()
    scenario.write_text("nonsense = 1\n")
    process = begin(server, tmp_path / "log", "agent", "--id", "1", "--scenario", "scenario.toml")
    assert process.wait(60.0) == 3
    assert (tmp_path / "log").read_text().count("nonsense") == 1
    monkeypatch.setenv("COLUMNS", "40")
    process = begin(server, tmp_path / "log", "agent", "--help")
    assert isinstance(process, Forked)
    assert process.wait(60.0) == 0
    assert max(map(len, (tmp_path / "log").read_text().splitlines())) <= 50


@pytest.mark.parametrize("first_thread", [None, False], ids=["SIGSTOP", "trace stop"])
def test_a_server_that_does_not_answer_is_given_up(
    first_thread: bool | None, server: ForkServer, tmp_path: Path
) -> None:
    """A stopped server, also one that its tracer keeps from being reaped, is ended, and the command started anew."""
    assert server._process is not None
    pid = server._process.pid
    with ExitStack() as stops:
        if first_thread is None:
            os.kill(pid, signal.SIGSTOP)
        else:
            stops.enter_context(trace_stopped(pid, first_thread=first_thread))
        process = begin(server, tmp_path / "out.log", "--version")
        assert isinstance(process, subprocess.Popen)
        assert has_died(pid)
        assert process.wait(60.0) == 0


def test_a_process_of_a_server_that_was_given_up_is_ended(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that has forked a process but not said so leaves none beside the one that is started in its place."""

    def is_running() -> list[int]:
        pids = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal()]
        return [pid for pid in pids if command_of(str(pid))[-len(LONELY) :] == [*LONELY]]

    def give_up(*_: object) -> None:
        assert wait_for(lambda: len(is_running()) == 1)
        raise TimeoutError

    monkeypatch.setattr(fork_server_module, "_await_answer", give_up)
    process = begin(server, tmp_path / "agent.log", *LONELY)
    assert isinstance(process, subprocess.Popen)
    assert wait_for(lambda: is_running() == [process.pid])
    process.kill()
    process.wait()


def test_threads_get_their_own_processes(server: ForkServer, tmp_path: Path) -> None:
    """Each of several threads that start processes at once gets the process it has asked for."""
    wrong: list[str] = []

    def is_called(pid: int, name: str) -> bool:
        return command_of(str(pid))[-1:] == [name]

    def start(thread: int) -> None:
        for number in range(8):
            name = f"thread{thread}-{number}"
            process = begin(server, tmp_path / f"{name}.log", "plot", name)
            if not wait_for(partial(is_called, process.pid, name)):
                wrong.append(name)
            process.kill()
            process.wait()

    threads = [threading.Thread(target=start, args=(thread,)) for thread in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
