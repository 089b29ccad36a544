"""Processes of the fork server behave like started ones."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest

from tests.support.commands import command, command_of, wait_for
from transport.cli.options import read_setup
from transport.cli.processes import Prepared
from transport.flight import harness
from transport.flight.fork_server import ForkServer
from transport.flight.harness import Child, start_child
from transport.mpc.regulation import Regulation

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


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ForkServer]:
    """A separate server for each test, which starts the children of a harness."""
    found = ForkServer()
    monkeypatch.setattr(harness, "fork_server", lambda: found)
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
        children.append(start_child("test", arguments, tmp_path / log))
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
    parent = psutil.Process(server._process.pid)
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


def test_orphans_end(begin: Begin, server: ForkServer) -> None:
    """Forked processes end when their parent's pipe closes, also after the end of the server."""
    child = begin("agent.log", *LONELY)
    assert wait_for(lambda: waits(child))
    server.close()
    assert child.wait(0.2) is None
    child.close()
    assert child.wait(20.0) == 4


@pytest.mark.parametrize("what", ["another system", "dead"])
def test_without_server(
    what: str, begin: Begin, server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes are started as programs where fork is impossible, and where the server does not answer."""
    pid = server._process.pid
    if what == "another system":
        with monkeypatch.context() as system:
            system.setattr(sys, "platform", "darwin")
            elsewhere = ForkServer()
        monkeypatch.setattr(harness, "fork_server", lambda: elsewhere)
    else:
        os.kill(pid, signal.SIGKILL)
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
        "import sys; from transport.cli.processes import ProcessOptions; "
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
