"""Deployment in a lab of network namespaces: cables are cut, and the lab leaves nothing behind."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from protocol.network.endpoints import process_names
from protocol.scenario.file import find_scenario, read_scenario
from tests.support.commands import PATIENCE_S, settings, wait_for
from tests.support.lab import unavailable
from transport.log.run_log import read_log

NAMES = [*process_names(read_scenario(find_scenario("resilient"))), "recorder"]
# The clock waits for late agents: with fourteen processes starting at once on few cores the run would diverge.
REAL_TIME = ("clock.mode=realtime", "clock.speed=1", "clock.on_overrun=hold")

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=f"no lab: {unavailable()}")


def climb(duration_s: float) -> str:
    """Return the setting of a slow climb."""
    return f"maneuver.phase=[{{name='climb',duration_s={duration_s},displacement_m=[0.0,0.0,-1.0]}}]"


def lab(folder: Path, *cuts: str, duration_s: float) -> subprocess.Popen[str]:
    """Start a lab that runs in real time while cables are cut."""
    options = [part for cut in cuts for part in ("--cut", cut)]
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "tests.support.lab", "--out", str(folder), *options),
            *settings(*REAL_TIME, climb(duration_s)),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the result that a lab prints at its end."""
    printed, errors = process.communicate(timeout=2 * PATIENCE_S)
    assert process.returncode == 0, errors
    found: dict[str, Any] = json.loads(printed)
    return found


def belonging_to(folder: Path) -> list[int]:
    """Return the processes with a folder in their command line."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and str(folder).encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


@pytest.mark.slow
def test_cables(tmp_path: Path) -> None:
    """A run survives and records a second without cable; without coordinator all processes end with a whole log."""
    # Both labs at once: the second one mostly waits for a connection timeout.
    with lab(tmp_path / "b", "coordinator:2", duration_s=30.0) as second:
        with lab(tmp_path / "a", "agent2:8:1", duration_s=12.0) as first:
            briefly = ended(first)
        for_good = ended(second)

    assert briefly["exits"] == dict.fromkeys(NAMES, 0)
    assert [(cut["did"], cut["host"]) for cut in briefly["cuts"]] == [("cut", "agent2"), ("mend", "agent2")]
    summary = json.loads((tmp_path / "a" / "run" / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert summary["deadline"]["tick_late_ms"]["max"] > 800.0  # a tick was held while the cable was cut

    assert for_good["exits"] == dict.fromkeys(NAMES, 4)
    log = read_log(tmp_path / "b" / "run" / "run.mcap")
    assert log.cut == ""
    assert log.messages[-1].message.kind == "control"
    summary = json.loads((tmp_path / "b" / "run" / "summary.json").read_text())
    assert (summary["outcome"], summary["reason"]) == ("aborted", "coordinator is gone")


@pytest.mark.slow
def test_nothing_stays(tmp_path: Path) -> None:
    """A lab that is killed, or ended by Ctrl-C, takes its processes and its network with it."""
    links = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    for number in (signal.SIGKILL, signal.SIGINT):
        folder = tmp_path / number.name
        with lab(folder, duration_s=60.0) as process:
            logs = folder / "logs" / "recorder.log"
            assert wait_for(logs.exists)
            assert len(belonging_to(folder)) > 5
            # The terminal sends Ctrl-C to all processes in the foreground, the lab inside the namespaces among them.
            inside = [
                pid for pid in belonging_to(folder) if b"tests.support.lab" in Path(f"/proc/{pid}/cmdline").read_bytes()
            ]
            (process.send_signal(number) if number is signal.SIGKILL else _send(max(inside), number))
            process.communicate(timeout=PATIENCE_S)
        assert process.returncode != 0
        assert wait_for(lambda folder=folder: not belonging_to(folder), 5.0)  # type: ignore[misc]
    time.sleep(0.1)
    assert subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout == links


def _send(pid: int, number: int) -> None:
    subprocess.run(["kill", f"-{number}", str(pid)], check=True)
