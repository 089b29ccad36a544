"""Deployment in a lab of network namespaces: cables are cut, and the lab leaves nothing behind."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import PATIENCE_S, settings
from tests.support.lab import unavailable
from transport.log.run_log import read_log
from transport.protocol.network.mesh import process_names
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

NAMES = [*process_names(read_scenario(find_scenario("resilient"))), "recorder"]
# The clock waits for late agents: with fourteen processes starting at once on few cores the run
# would diverge.
REAL_TIME = ("clock.mode=realtime", "clock.speed=1", "clock.on_overrun=hold")

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=f"no lab: {unavailable()}")


def climb(duration_s: float) -> str:
    """Return the setting of a slow climb."""
    return (
        f"maneuver.phase=[{{name='climb',duration_s={duration_s},displacement_m=[0.0,0.0,-1.0]}}]"
    )


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


@pytest.mark.slow
def test_cables(tmp_path: Path) -> None:
    """A run survives and records a second without cable.

    Without coordinator all processes end with a whole log.
    """
    # Both labs at once: the second one mostly waits for a connection timeout.
    with lab(tmp_path / "b", "coordinator:2", duration_s=30.0) as second:
        with lab(tmp_path / "a", "agent2:3:1", duration_s=6.0) as first:
            briefly = ended(first)
        for_good = ended(second)

    assert briefly["exits"] == dict.fromkeys(NAMES, 0)
    assert [(cut["did"], cut["host"]) for cut in briefly["cuts"]] == [
        ("cut", "agent2"),
        ("mend", "agent2"),
    ]
    summary = json.loads((tmp_path / "a" / "run" / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    # A tick was held while the cable was cut.
    assert summary["deadline"]["tick_late_ms"]["max"] > 800.0

    assert for_good["exits"] == dict.fromkeys(NAMES, 4)
    log = read_log(tmp_path / "b" / "run" / "run.mcap")
    assert log.cut == ""
    assert log.messages[-1].message.kind == "control"
    summary = json.loads((tmp_path / "b" / "run" / "summary.json").read_text())
    assert (summary["outcome"], summary["reason"]) == ("aborted", "coordinator is gone")
