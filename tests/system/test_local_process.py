"""Why a process of a run cannot answer: it has ended or is stopped; nothing is said where that is not known."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.commands import wait_for
from transport.flight.live import LiveRun, why_silent

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")

RUN = LiveRun("mine", {"coordinator": "tcp/127.0.0.1:7447"}, os.getpid())
SLEEPS = "import time; time.sleep(60)"


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process with the command line of agent 2; the run has started it and plant, which has ended."""
    (tmp_path / "logs").mkdir()
    for name in ("agent2", "plant"):
        (tmp_path / "logs" / f"{name}.log").touch()
    words = ["transport", "agent", "--id", "2", "--run", "mine"]
    with subprocess.Popen([sys.executable, "-c", SLEEPS, *words]) as process:
        yield process
        process.kill()


def test_a_process_that_runs_has_no_reason(agent: subprocess.Popen[bytes], tmp_path: Path) -> None:
    """A running process may answer; one that the run did not start is not judged."""
    assert wait_for(lambda: why_silent(tmp_path, RUN, "agent2") == "")
    assert why_silent(tmp_path, RUN, "agent3") == ""
    assert why_silent(tmp_path, LiveRun("mine", RUN.endpoints, 2**31 - 1), "agent2") == ""


def test_stopped_and_ended_processes_are_named(agent: subprocess.Popen[bytes], tmp_path: Path) -> None:
    """The reason names the process, the run and the command that helps."""
    assert wait_for(lambda: why_silent(tmp_path, RUN, "agent2") == "")
    agent.send_signal(signal.SIGSTOP)
    stopped = "agent2 of run mine is stopped by a signal; transport fault continue agent2 lets it go on"
    assert wait_for(lambda: why_silent(tmp_path, RUN, "agent2") == stopped)
    agent.kill()
    ended = "agent2 of run mine has ended; transport fault restart agent2 starts it again"
    assert wait_for(lambda: why_silent(tmp_path, RUN, "agent2") == ended)
    assert why_silent(tmp_path, RUN, "plant") == "plant of run mine has ended, and the run ends"
