"""Processes of the fork server behave like started ones."""

import ctypes
import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import psutil
import pytest

from tests.support.commands import command, command_of, wait_for
from transport.cli.hosts.fork_server_process import Prepared
from transport.cli.options import read_setup
from transport.flight import fork_server, local_processes
from transport.flight.fork_server import ForkServer
from transport.flight.local_processes import Child, ToStart, start_children
from transport.mpc.law.present_law import Regulation
from transport.protocol.network.parent_and_environment import FORK_SERVER

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are forked on Linux alone"
)

# An agent that waits for agents that never join.
LONELY = (
    "agent",
    "--id",
    "1",
    "--scenario",
    "paper",
    "--run",
    "lonely",
    "--listen",
    "tcp/127.0.0.1:0",
)
_PR_GET_CHILD_SUBREAPER = 37  # <sys/prctl.h>


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ForkServer]:
    """A separate server for each test, which starts the children of a harness."""
    found = ForkServer()
    monkeypatch.setattr(local_processes, "fork_server", lambda: found)
    yield found
    found.close()


@pytest.fixture
def children() -> Iterator[list[Child]]:
    """Children that a test starts; they are killed afterwards."""
    found: list[Child] = []
    yield found
    for child in found:
        child.signal(signal.SIGKILL)
        child.wait(20.0)
        child.close()


Begin = partial[Child]


@pytest.fixture
def begin(server: ForkServer, children: list[Child], tmp_path: Path) -> Begin:
    """Return a function that starts a command with a log of a given name."""

    def start(log: str, *arguments: str) -> Child:
        children.extend(start_children([ToStart("test", arguments, tmp_path / log)]))
        return children[-1]

    return partial(start)


def is_forked(child: Child) -> bool:
    """Return whether a child was forked, not started as a program."""
    return not isinstance(child.process, psutil.Popen)


def waits(child: Child) -> bool:
    """Return whether an agent waits for the others."""
    return '"listening"' in child.log.read_text()


def test_as_if_started(begin: Begin) -> None:
    """Output and exit code of a forked command are those of a started one."""
    for k, arguments in enumerate(
        (["agent", "--help"], ["agent", "--id", "9"], ["agent", "--id", "x"], ["--version"])
    ):
        child = begin(f"{k}.log", *arguments)
        assert is_forked(child)
        expected = subprocess.run(command(*arguments), capture_output=True, text=True, check=False)
        assert child.wait(60.0) == expected.returncode
        assert child.log.read_text() == expected.stdout + expected.stderr


def test_place_of_its_own(begin: Begin, server: ForkServer) -> None:
    """A forked process has its own session, title and parent, no other open files, and ends by signals."""
    child = begin("agent.log", *LONELY)
    assert wait_for(lambda: waits(child))
    assert command_of(str(child.process.pid)) == ["transport", *LONELY]
    assert os.getsid(child.process.pid) == child.process.pid
    assert child.process.ppid() == os.getpid()
    parent = psutil.Process(server.pid)
    assert parent.num_threads() == 1  # required for fork
    own, servers = (
        {str(link.readlink()) for link in Path(f"/proc/{p.pid}/fd").iterdir()}
        for p in (child.process, parent)
    )
    assert str(child.log) in own
    assert not [name for name in own & servers if name.startswith(("socket", "pipe"))]
    assert child.wait(0.05) is None
    assert child.signal(signal.SIGTERM)
    assert child.wait(20.0) == 130
    assert not child.signal(signal.SIGTERM)  # the signal must not reach another process
    killed = begin("killed.log", *LONELY)
    killed.signal(signal.SIGKILL)
    assert killed.wait(20.0) == -signal.SIGKILL


def adopts_orphans() -> bool:
    """Return whether orphaned descendants of this process become its children."""
    adopts = ctypes.c_int()
    assert ctypes.CDLL(None).prctl(_PR_GET_CHILD_SUBREAPER, ctypes.byref(adopts), 0, 0, 0) == 0
    return bool(adopts.value)


def test_orphans_are_adopted_until_the_server_is_closed(server: ForkServer) -> None:
    """A program that simulates a run gets the orphans of its other parts during the run only."""
    assert adopts_orphans()
    server.close()
    assert not adopts_orphans()


def test_a_fork_that_fails_in_the_server_starts_programs(
    server: ForkServer, children: list[Child], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes that the server could not fork are started as programs, in their places."""
    forked = fork_server._forked
    monkeypatch.setattr(
        fork_server, "_forked", lambda requests, starts, given: forked(requests, starts[:1], given)
    )
    logs = [tmp_path / f"{number}.log" for number in range(3)]
    children += start_children([ToStart(log.stem, ["--version"], log) for log in logs])
    assert [is_forked(child) for child in children] == [True, False, False]
    assert [child.wait(60.0) for child in children] == [0, 0, 0]
    assert len({log.read_text() for log in logs}) == 1


def test_a_command_is_forked_into_its_server() -> None:
    """The server has the imports of the command, one thread, no file of it, and ends with it."""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", BRANCHED], stdin=pipe, stdout=pipe) as parent:
        assert parent.stdout is not None
        pid, has_module = parent.stdout.readline().split()
        assert has_module == b"True"
        assert wait_for(lambda: command_of(pid.decode()) == ["transport", FORK_SERVER])
        found = psutil.Process(int(pid))
        assert found.num_threads() == 1
        assert {str(Path(f"/proc/{found.pid}/fd/{k}").readlink()) for k in range(3)} == {os.devnull}
    assert wait_for(lambda: status(found.pid) == psutil.STATUS_ZOMBIE, 20.0)


def test_orphans_end(begin: Begin, server: ForkServer) -> None:
    """Forked processes end when their parent's pipe closes, also after the end of the server."""
    child = begin("agent.log", *LONELY)
    assert wait_for(lambda: waits(child))
    server.close()
    assert child.wait(0.2) is None
    child.close()
    assert child.wait(20.0) == 4


# Starts a server, prints its id and waits for its end.
PARENT = (
    "import time; from transport.flight.fork_server import ForkServer; server = ForkServer();"
    "print(server.pid, flush=True); time.sleep(600)"
)


# Forks itself into a server, which tells by its first process whether it has a module of this program.
BRANCHED = """
import os, sys
import colorsys
from transport.flight import fork_server
from transport.flight.fork_server import Start

def tell():
    os.write(1, str("colorsys" in sys.modules).encode())
    os._exit(0)

fork_server.fork_into_server(lambda requests: fork_server.serve(requests, lambda _: None, tell))
server = fork_server.fork_server()
os.write(1, f"{server.pid} ".encode())
[process] = server.start([Start([], 0, 1)], {})
process.wait(20.0)
os.write(1, b"\\n")
sys.stdin.read()
"""


def status(pid: int) -> str:
    """Return the status of a process; that of a zombie if it has gone."""
    with suppress(psutil.NoSuchProcess):
        return str(psutil.Process(pid).status())
    return str(psutil.STATUS_ZOMBIE)


def test_a_stopped_server_ends_with_its_parent() -> None:
    """The end of the parent continues the server, which then sees that its socket is closed."""
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        try:
            # With its title it waits for requests, and watches its parent.
            assert wait_for(lambda: command_of(str(pid)) == ["transport", FORK_SERVER])
            os.kill(pid, signal.SIGSTOP)
            assert wait_for(lambda: status(pid) == psutil.STATUS_STOPPED)
        finally:
            parent.kill()
        try:
            assert wait_for(lambda: status(pid) == psutil.STATUS_ZOMBIE, 20.0)
        finally:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


# Starts two processes as the server does, with a process in between that ends late. The new ones
# print whether their parent is this program, and this program prints their ids, in any order.
STARTED = """
import os, sys, time
from transport.flight import fork_server

def end_late(code, end=os._exit):
    sys.stdout.flush()
    time.sleep(0.5)
    end(code)

os._exit = end_late
fork_server._adopt_orphans(True)
own = os.getpid()
request = {"arguments": [[], []], "environment": {}}
# A write for each line: two processes write at the same time.
say = lambda word: os.write(1, f"{word}\\n".encode())
is_own = lambda: say("own" if os.getppid() == own else "other")
ids = fork_server._started(request, [0, 1, 0, 1], is_own)
say(ids)
for pid in ids:
    os.waitpid(pid, 0)
"""
# The same, where no process is left for the new one.
NONE_LEFT = f"""
import os

def fork(fork=os.fork, first=os.getpid()):
    if os.getpid() != first:
        raise OSError("no process left")
    return fork()

os.fork = fork
{STARTED}
"""


def output_of(code: str) -> tuple[list[str], str]:
    """Return the lines and the errors that a program prints."""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ran.stdout.split(), ran.stderr


def test_a_process_begins_as_a_child_of_the_one_that_asked() -> None:
    """It does not watch the process in between, whose end would continue it if it had been stopped."""
    words, errors = output_of(STARTED)
    assert words.count("own") == 2
    assert "other" not in words
    assert errors == ""


def test_a_fork_that_fails_gives_no_process() -> None:
    """The process in between ends; only the server goes on."""
    assert output_of(NONE_LEFT) == (["[]"], "")


# A program that calls the command after it did something else: it tells whether it was forked.
CALLS = """
import os, sys, threading
import zenoh
from transport.flight import fork_server
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import open_session
from transport.protocol.wire.key_expressions import Keys

before = sys.argv[1]
if before == "thread":
    threading.Thread(target=threading.Event().wait, daemon=True).start()
elif before == "network":
    endpoints = Endpoints(listen=["tcp/127.0.0.1:0"], connect=[])
    open_session(endpoints, 1.0, "agent1", Keys("a"), 1.0).close()
reads, writes = os.pipe()
fork_server.fork_into_server(lambda _: os.write(writes, b"forked"))
os.close(writes)
os.write(1, os.read(reads, 10))
"""


@pytest.mark.parametrize("before", ["nothing", "thread", "network"])
def test_a_program_with_threads_is_not_forked(before: str) -> None:
    """A fork of a program that has used the network could not use it."""
    ran = subprocess.run(
        [sys.executable, "-c", CALLS, before], capture_output=True, text=True, check=True
    )
    assert (ran.stdout, ran.stderr) == ("forked" if before == "nothing" else "", "")


def test_threads_share_a_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that threads start at the same time have one server."""

    class SlowServer:
        def __init__(self) -> None:
            time.sleep(0.05)

    servers: list[ForkServer] = []
    monkeypatch.setattr(fork_server, "_servers", servers)
    monkeypatch.setattr(fork_server, "ForkServer", SlowServer)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda _: fork_server.fork_server(), range(4)))
    assert len(servers) == 1


def no_process(*_: object, **__: object) -> None:
    """Fail as a start does where no process is left."""
    raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))


@pytest.mark.parametrize("what", ["another system", "not started", "dead", "large environment"])
def test_without_server(
    what: str, begin: Begin, server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes are started as programs where fork is impossible, and where the server does not answer."""
    if what in ("another system", "not started"):
        server.close()
        with monkeypatch.context() as system:
            if what == "another system":
                system.setattr(sys, "platform", "darwin")
            else:
                system.setattr(subprocess, "Popen", no_process)
            elsewhere = ForkServer()
        assert not adopts_orphans()
        monkeypatch.setattr(local_processes, "fork_server", lambda: elsewhere)
    elif what == "dead":
        os.kill(server.pid, signal.SIGKILL)
    else:  # longer than a request; Linux has 128 KiB for each variable
        for name in ("FIRST", "SECOND"):
            monkeypatch.setenv(name, "x" * 100_000)
    child = begin("out.log", "--version")
    assert not is_forked(child)
    assert child.wait(60.0) == 0


def test_processes_share_the_control_law() -> None:
    """What an agent or the plant computes first, the server has computed for all."""
    prepared = Prepared()
    prepared.prepare(["plant", "--scenario", "resilient"])
    setup = read_setup("resilient")
    law = Regulation(setup.model, setup.hover, setup.settings, setup.reference.sampled)
    assert prepared.law is not None
    assert law.current.about_hover is prepared.law.current.about_hover
    assert law.fail_safe.motion is prepared.law.fail_safe.motion is not None


def test_processes_have_splines_before_their_first_tick() -> None:
    """A target through way points comes within a tick, in which an import takes too long.

    A run as fast as possible waits for it instead.
    """
    code = (
        "import sys; from transport.cli.hosts.processes import ProcessOptions; "
        "ProcessOptions(scenario=sys.argv[1]).setup(); sys.exit('scipy.interpolate' in sys.modules)"
    )
    for scenario, has_splines in (("playground", True), ("paper", False)):
        found = subprocess.run([sys.executable, "-c", code, scenario], check=False)
        assert found.returncode == has_splines


def test_environment_and_folder_of_now(
    begin: Begin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folder, variables and scenario are the current ones, not those at the start of the server."""
    scenario = tmp_path / "scenario.toml"
    ready = subprocess.run(
        command("validate", "paper"), capture_output=True, text=True, check=True
    ).stdout
    monkeypatch.chdir(tmp_path)
    for name in ("first", "second"):
        scenario.write_text(ready.replace('name = "paper"', f'name = "{name}"'))
        child = begin("log", "agent", "--id", "9", "--scenario", "scenario.toml")
        assert is_forked(child)
        assert child.wait(60.0) == 2
        assert f"of scenario {name}, got 9" in child.log.read_text()
    monkeypatch.setenv("COLUMNS", "40")
    child = begin("log", "agent", "--help")
    assert is_forked(child)
    assert child.wait(60.0) == 0
    assert max(map(len, child.log.read_text().splitlines())) <= 50
