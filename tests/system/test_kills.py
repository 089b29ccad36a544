"""Killed processes leave no process, no unreadable log and no wrong exit code."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from rich.console import Console

from tests.support.commands import (
    ENDLESS,
    Forked,
    is_flying,
    processes_of,
    settings,
    wait_for,
)
from tests.support.results import here
from tests.support.runs import setup, ticks
from transport.flight.local_processes import Child
from transport.flight.run_execution import simulate
from transport.log.run_log import read_log
from transport.protocol.wire.messages import Roster

TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
USAGE, LOST, INTERRUPTED = 2, 4, 130

# A command that hangs at its end, and signals then.
SIGNALLED_AFTERWARDS = """
import atexit, os, sys, time
from transport.__main__ import main

def hang():
    os.kill(os.getpid(), {number})
    print("signalled", flush=True)
    os.kill(os.getpid(), {number})
    time.sleep(600.0)

atexit.register(hang)
sys.argv[1:] = {arguments}
main()
"""
# One run after another, the second in a forked process, which has none of the threads of the
# network.
FORKED = """
import multiprocessing
import transport

def fly(folder):
    phases = [dict(name="hover", duration_s=0.2, displacement_m=[0.0, 0.0, 0.0])]
    try:
        return transport.fly("paper", processes=True, phases=phases, folder=folder).summary["outcome"]
    except transport.TransportError as error:
        return str(error)

print(fly("first"))
with multiprocessing.get_context("fork").Pool(1) as pool:
    print(pool.map(fly, ["second"])[0])
"""
# An engine whose process stops before it joins: it integrates once beforehand.
STOPS = """
import os, signal
from transport.plant.engines import Rods

class Stops(Rods):
    def advance(self, u, forces, duration_s):
        os.kill(os.getpid(), signal.SIGSTOP)
"""


TakeOff = Callable[..., Forked]


@pytest.fixture
def take_off(forked: Callable[..., Forked], tmp_path: Path) -> TakeOff:
    """Start a run paced to real time and wait until it simulates."""

    def begin(run: str, *changes: str) -> Forked:
        options = ["--out", run, "--no-figures"]
        started = forked("run", "paper", *settings(*ENDLESS, *changes), *options, cwd=tmp_path)
        assert wait_for(is_flying(tmp_path / run, TEAM)), started.output.read_text()
        log = tmp_path / run / "run.mcap"
        assert wait_for(lambda: log.exists() and log.stat().st_size > 100_000)
        return started

    return begin


def test_a_process_told_to_end_leaves_at_once(take_off: TakeOff) -> None:
    """SIGTERM to one process while the run goes on: it is gone before any timeout, and named."""
    run = take_off("told", "clock.barrier_timeout_s=60.0")
    os.kill(processes_of("told")["plant"], signal.SIGTERM)
    code, printed = run.end()
    assert code == LOST
    assert "plant is gone" in printed
    assert processes_of("told") == {}


def test_a_recorder_that_begins_late_is_there(tmp_path: Path) -> None:
    """A viewer that takes longer than `clock.join_timeout_s` to open, as on a busy machine.

    The recorder begins after it; the others see it before, and the run completes.
    """
    join_s = 1.0
    team = setup(f"clock.join_timeout_s={join_s}", ticks(5))
    finished = simulate(
        team, tmp_path / "late", Console(quiet=True), ready=lambda: time.sleep(3.0 * join_s)
    )
    assert (finished.exit_code, finished.reason) == (0, "")


def test_a_starved_process_is_not_missing(tmp_path: Path) -> None:
    """A process that works on its start, slower than the time to join, has not been lost.

    One without processor time since the last question, or that was stopped, is.
    """
    program = "import time\nwhile True: sum(range(10**5)); time.sleep(0.001)"
    process = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE)
    assert process.stdin is not None
    child = Child("plant", psutil.Process(process.pid), process.stdin, tmp_path / "plant.log")
    longest_s = 30.0
    try:
        assert wait_for(lambda: child.is_starting(longest_s))
        assert wait_for(lambda: child.is_starting(longest_s))  # it goes on working
        assert not child.is_starting(0.0)  # it has worked for too long
        process.send_signal(signal.SIGSTOP)
        assert wait_for(lambda: child.is_stopped)
        assert not child.is_starting(longest_s)
    finally:
        process.kill()
        process.wait()
        child.close()
    assert not child.is_starting(longest_s)


@pytest.mark.slow
def test_a_process_stopped_before_the_run_is_named(
    forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """A plant that is stopped while the processes join.

    Exit code 4, the plant named, no process left.
    """
    (tmp_path / "own.py").write_text(STOPS, encoding="utf-8")
    options = settings("clock.join_timeout_s=8.0", "plant.engine=own:Stops")
    started = forked("run", "paper", *options, "--out", "join", "--no-figures", cwd=tmp_path)
    code, printed = started.end()
    assert code == LOST, printed
    (error,) = (line for line in printed.splitlines() if line.startswith("transport: "))
    assert "no sign of plant within 8 s" in error
    assert error.endswith("logs in join/logs")
    assert processes_of("join") == {}


@pytest.mark.parametrize("victim", ["coordinator", "agent4"])
def test_a_killed_process_ends_the_run_in_order(
    victim: str, take_off: TakeOff, tmp_path: Path
) -> None:
    """SIGKILL of any process.

    Exit code 4, the victim named, the log complete up to then, no process left.
    """
    run = f"kill-{victim}"
    started = take_off(run)
    os.kill(processes_of(run)[victim], signal.SIGKILL)
    code, printed = started.end()
    assert code == LOST
    (error,) = (line for line in printed.splitlines() if line.startswith("transport: "))
    # The end of the victim comes first, then its effect and the folder of logs.
    assert error.startswith(f"transport: {victim} was killed by SIGKILL; so {victim} is gone")
    assert error.endswith(f"logs in {run}/logs")
    assert "Traceback" not in printed
    assert processes_of(run) == {}
    summary = json.loads((tmp_path / run / "summary.json").read_text())
    assert summary["outcome"] == "aborted"
    assert summary["ticks"] > 5
    assert not read_log(tmp_path / run / "run.mcap").cut


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)]
)
def test_an_interrupted_run_is_reported(
    number: signal.Signals, take_off: TakeOff, tmp_path: Path
) -> None:
    """Ctrl-C and a closed terminal end a run in order.

    Exit code 130, a report of what was flown, no process left.
    """
    run = take_off("interrupted")
    run.process.send_signal(number)
    code, printed = run.end()
    assert code == INTERRUPTED, printed
    assert "aborted" in printed
    assert "Traceback" not in printed
    assert processes_of("interrupted") == {}
    assert not read_log(tmp_path / "interrupted" / "run.mcap").cut


@pytest.mark.slow
def test_a_killed_harness_leaves_no_orphans(take_off: TakeOff, tmp_path: Path) -> None:
    """SIGKILL of `transport run` itself.

    Its processes notice and end; the log opens and can be reported.
    """
    run = take_off("orphans")
    run.process.kill()
    run.end()
    assert wait_for(lambda: processes_of("orphans") == {}, timeout_s=20.0)
    result = here("plot", tmp_path / "orphans", "--format", "json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["ticks"] > 5
    assert summary["log_cut"]


def test_the_others_continue_if_configured(take_off: TakeOff, tmp_path: Path) -> None:
    """With `on_agent_loss = "continue"` the clock goes on without the killed agent, and the record names it."""
    run = take_off("continued", "clock.on_agent_loss=continue")
    os.kill(processes_of("continued")["agent3"], signal.SIGKILL)
    assert wait_for(lambda: "agent3" not in processes_of("continued"))
    log = tmp_path / "continued" / "run.mcap"
    assert wait_for(lambda: any(roster.agents == (1, 2, 4) for roster in read_log(log).of(Roster)))
    assert not wait_for(lambda: run.process.status() == psutil.STATUS_ZOMBIE, timeout_s=0.8)
    run.process.send_signal(signal.SIGINT)
    _, printed = run.end()
    assert "agent3 is gone" in printed
    assert processes_of("continued") == {}


@pytest.mark.parametrize(
    ("number", "arguments", "code"),
    [(signal.SIGINT, ["plot", "nowhere"], USAGE), (signal.SIGTERM, ["--help"], 0)],
)
def test_signals_after_the_end(number: signal.Signals, arguments: list[str], code: int) -> None:
    """A finished command keeps its exit code; a second signal ends it even if it hangs then."""
    program = SIGNALLED_AFTERWARDS.format(number=int(number), arguments=arguments)
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (result.returncode, "signalled" in result.stdout, "Traceback" in result.stderr) == (
        code,
        True,
        False,
    )


@pytest.mark.slow
def test_a_run_in_a_forked_process_is_refused(tmp_path: Path) -> None:
    """The threads of the network do not survive a fork.

    The second run is refused in words, at once.
    """
    result = subprocess.run(
        [sys.executable, "-c", FORKED],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    first, second = result.stdout.splitlines()
    assert first == "completed"
    assert "start it by 'spawn'" in second
    assert not (tmp_path / "second").exists()
