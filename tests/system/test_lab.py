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
from transport.protocol.wire.messages import Plan

# Few processes, as each takes a second of a processor to start: two agents with two UAVs each.
TEAM = "agents.owned=[[1,2],[3,4]]"
NAMES = [*process_names(read_scenario(find_scenario("resilient"), [TEAM])), "recorder"]
# The clock waits for late agents: with many processes starting at once on few cores the run would diverge.
REAL_TIME = ("clock.mode=realtime", "clock.speed=1", "clock.on_overrun=hold")
CLIMB = "maneuver.phase=[{name='climb',duration_s=60.0,displacement_m=[0.0,0.0,-1.0]}]"
CUT_S, PERIOD_S = 2.0, 0.05

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=f"no lab: {unavailable()}")


def lab(folder: Path, *cuts: str) -> dict[str, Any]:
    """Return the result of a lab that runs in real time while cables are cut."""
    options = [part for cut in cuts for part in ("--cut", cut)]
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tests.support.lab", "--out", str(folder), *options),
            *settings(*REAL_TIME, TEAM, CLIMB),
        ],
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.slow
def test_cables(tmp_path: Path) -> None:
    """A run survives and records a second without an agent's cable.

    Without the coordinator's all processes end with a whole log.
    """
    found = lab(tmp_path / "lab", f"agent2:{CUT_S}:1", "coordinator:5")
    assert found["exits"] == dict.fromkeys(NAMES, 4)
    assert [(cut["did"], cut["host"]) for cut in found["cuts"]] == [
        ("cut", "agent2"),
        ("mend", "agent2"),
        ("cut", "coordinator"),
    ]

    log = read_log(tmp_path / "lab" / "run" / "run.mcap")
    assert log.cut == ""
    assert log.messages[-1].message.kind == "control"
    summary = json.loads((tmp_path / "lab" / "run" / "summary.json").read_text())
    assert (summary["outcome"], summary["reason"]) == ("aborted", "coordinator is gone")
    # A tick was held while the agent's cable was cut, and the agent takes part in those after.
    assert summary["deadline"]["tick_late_ms"]["max"] > 800.0
    last_before = round(CUT_S / PERIOD_S)
    assert max(plan.tick for plan in log.of(Plan) if plan.agent == 2) > last_before + 10
