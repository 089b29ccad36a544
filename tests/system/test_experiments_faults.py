"""Fault runs: drawn from their number, judged without mercy, and a few of them flown."""

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from tests.support.commands import command
from transport.experiments.faults import COMMAND, FaultRun, Strike, drawn, processes_of, simulate

MANY = 300
HOVER = ("maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]",)
# Eight runs, two at a time, on a slow machine: each may wait ten seconds for a process to be given up.
PATIENCE_S = 240.0


def test_runs_are_drawn_from_their_number() -> None:
    """The same seed and number is the same run, another of either is another."""
    runs = [drawn(seed, number) for seed in (0, 1) for number in range(50)]
    assert runs == [drawn(seed, number) for seed in (0, 1) for number in range(50)]
    assert len({(run.settings, run.strikes) for run in runs}) == len(runs)


def test_everything_happens_to_everybody() -> None:
    """Many runs strike every process with every signal, freeze with and without end, alone and together."""
    runs = [drawn(0, number) for number in range(MANY)]
    strikes = [strike for run in runs for strike in run.strikes]
    names = {"coordinator", "plant", "agent1", "agent2", "agent3", "agent4", COMMAND}
    signals = {signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT}
    assert {(strike.target, strike.signal) for strike in strikes} == {(n, s) for n in names for s in signals}
    assert {strike.since for strike in strikes} == {"start", "flight"}
    freezes = Counter(strike.freed_s is None for strike in strikes if strike.signal == signal.SIGSTOP)
    assert min(freezes[True], freezes[False]) > 20
    assert all(strike.freed_s is None for strike in strikes if strike.signal != signal.SIGSTOP)
    assert {len(run.strikes) for run in runs} == {1, 2}
    settings = [setting for run in runs for setting in run.settings]
    for given in (
        "on_agent_loss=abort",
        "on_agent_loss=continue",
        "mode=realtime",
        "negotiation_iterations=2",
        "links",
    ):
        assert any(given in setting for setting in settings)


def test_every_run_can_be_flown() -> None:
    """Whatever is drawn is a valid scenario."""
    path = find_scenario("resilient")
    for settings in {drawn(0, number).settings for number in range(MANY)}:
        read_scenario(path, settings)
    assert Setup.of(read_scenario(path, drawn(0, 1).settings), "resilient").ticks >= 60


def test_a_flight_in_which_nothing_happens(tmp_path: Path) -> None:
    """Nothing is wrong with a run that nobody disturbs, and nothing is left of it but its folder."""
    run = FaultRun(number=1, settings=HOVER, strikes=())
    verdict = simulate(run, tmp_path, threading.Event())
    assert (verdict.code, verdict.problems) == (0, {})
    assert processes_of(f"fault-1-{os.getpid()}") == {}


def test_an_exit_code_that_does_not_fit_is_found(tmp_path: Path) -> None:
    """A command that refuses its scenario ends with a code that no fault can cause."""
    verdict = simulate(FaultRun(number=2, settings=("controller.horizon=0",), strikes=()), tmp_path, threading.Event())
    assert verdict.code == 3
    assert verdict.problems == {"wrong exit code": "3, expected one of 0, 4, 6"}


def test_an_orphan_is_found_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process of the run that is left over is named, and ended by who found it; so is a log that is none."""
    monkeypatch.setattr("transport.experiments.faults._ORPHANS_S", 0.5)
    name = f"fault-3-{os.getpid()}"
    (tmp_path / name).mkdir()  # the command refuses a folder that exists, and flies nothing
    (tmp_path / name / "run.mcap").write_bytes(b"not a log")
    words = ["transport", "agent", "--id", "7", "--run", name]
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", *words])
    try:
        verdict = simulate(FaultRun(number=3, settings=HOVER, strikes=()), tmp_path, threading.Event())
        assert verdict.problems["orphan"] == "agent7"
        assert left.wait(10.0) == -signal.SIGKILL
    finally:
        left.kill()
    assert "unreadable log" in verdict.problems
    assert verdict.problems["wrong exit code"].startswith("2, expected one of")


def test_a_frozen_command_is_killed_by_who_froze_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that is stopped for good cannot end; its processes do, once it is killed, and a frozen one with it."""
    monkeypatch.setattr("transport.experiments.faults._FROZEN_S", 1.0)
    long = ("maneuver.phase=[{name='hover',duration_s=30.0,displacement_m=[0,0,0]}]", "clock.speed=1.0")
    strikes = tuple(
        Strike(target=target, signal=signal.SIGSTOP, since="flight", after_s=after_s)
        for target, after_s in (("agent2", 0.3), (COMMAND, 0.6))
    )
    verdict = simulate(FaultRun(number=4, settings=long, strikes=strikes), tmp_path, threading.Event())
    assert (verdict.code, verdict.problems) == (-signal.SIGKILL, {})


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S + 60.0)
def test_some_fault_runs(tmp_path: Path) -> None:
    """Eight runs from the front of those that are flown by the hundred: nothing hangs, nothing is left, codes fit."""
    arguments = ["experiment", "faults", "--runs", "8", "--seed", "0", "--jobs", "2"]
    result = subprocess.run(
        command(*arguments), cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.splitlines()[-1] == "8 runs: 0 hangs, 0 orphans, 0 unreadable logs, 0 wrong exit codes"
    assert "runs by exit code" in result.stdout
    assert not list((tmp_path / "runs").iterdir())
