"""Targets given to an active run by command, file and Python: the bits of a run in memory with a script."""

from pathlib import Path

import numpy as np
import pytest

import transport
from protocol.wire.messages import PlantState, Target
from tests.support.commands import settings, start, wait_for
from tests.system.test_operate import succeed
from transport.log.run_log import read_log

SECONDS, REACHED_M = 26.0, 0.05
HOVER = [{"name": "hover", "duration_s": SECONDS, "displacement_m": [0, 0, 0]}]
WAYS = "x,y,z\n0.4,0.4,-10\n0,0.4,-10.3\n0,0,-10\n"


@pytest.mark.slow
def test_targets_by_hand_and_by_script_are_the_same_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All ways lead to the same bits as the scenario's targets at the same ticks, on a late network."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "path.csv").write_text(WAYS)
    late = ("links.delay_s=0.2", "links.loss=0.3")
    hover = f"maneuver.phase=[{{name='hover',duration_s={SECONDS},displacement_m=[0,0,0]}}]"
    run = start(
        "run", "precise", *settings("clock.speed=1.0", hover, *late), "--out", "runs/sent", "--no-figures", cwd=tmp_path
    )
    log = tmp_path / "runs" / "sent" / "run.mcap"
    try:
        assert wait_for(lambda: log.exists() and len(list(read_log(log).of(PlantState))) > 10)
        assert succeed("target", "0.4", "0", "-10.2").startswith("target from tick")
        assert transport.active().target(0.2, 0.3, -10.0, speed=0.5)["ends_s"] < SECONDS
        assert "the last way point at" in succeed("target", "--file", "path.csv", "--speed", "0.5")
        _, errors = run.communicate(timeout=120)
        assert run.returncode == 0, errors
    finally:
        run.kill()
        run.communicate()
    whole = read_log(log)
    found = list(whole.of(Target))
    script = [
        {"at_s": target.tick * 0.05, "points_m": target.points.tolist(), **speed}
        for target, speed in zip(found, ({}, {"speed_mps": 0.5}, {"speed_mps": 0.5}), strict=True)
    ]
    alone = transport.fly(
        "precise", {"maneuver.target": script, "links.delay_s": 0.2, "links.loss": 0.3}, phases=HOVER, progress=False
    )
    states = [np.array([state.x for state in of.of(PlantState)]) for of in (whole, alone.log)]
    assert states[0].tobytes() == states[1].tobytes()
    *_, last = transport.load(tmp_path / "runs" / "sent").summary["targets"]
    assert last["error_m"] < REACHED_M
