"""Targets given to an active run by command, file and Python.

The bits of a run in memory with a script.
"""

import signal
from pathlib import Path

import pytest

import transport
from tests.support.commands import settings, start, wait_for
from tests.support.live_log import LiveLog
from tests.support.same_flight import before, flight_bits, simulated_before
from tests.system.test_operate import succeed
from transport.protocol.wire.messages import Message, PlantState, Target

HOVER = "maneuver.phase=[{name='hover',duration_s=100.0,displacement_m=[0,0,0]}]"
WAYS = "x,y,z\n0.4,0.4,-10\n0,0.4,-10.3\n0,0,-10\n"


@pytest.mark.slow
def test_targets_by_hand_and_by_script_are_the_same_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All ways lead to the same bits as the scenario's targets at the same ticks, on a late network."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "path.csv").write_text(WAYS)
    changes = settings("clock.speed=2.0", HOVER, "links.delay_s=0.2", "links.loss=0.3")
    run = start("run", "precise", *changes, "--out", "runs/sent", "--no-figures", cwd=tmp_path)
    folder = tmp_path / "runs" / "sent"
    try:
        assert wait_for((folder / "run.mcap").exists)
        log = LiveLog(folder / "run.mcap")
        assert wait_for(lambda: len(log.of(PlantState)) > 10)
        assert succeed("target", "0.4", "0", "-10.2").startswith("target from tick")
        assert transport.active().target(0.2, 0.3, -10.0, speed=0.5)["ends_s"] < 100.0
        assert "the last way point at" in succeed("target", "--file", "path.csv", "--speed", "0.5")
        assert wait_for(lambda: len(log.of(Target)) == 3)
        until = log.of(Target)[-1].tick + 40  # on the way along the file
        assert wait_for(lambda: log.of(PlantState)[-1].tick > until)
    finally:
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=60)
    script = [
        f"{{at_s={target.tick * 0.05!r},points_m={target.points.tolist()}{speed}}}"
        for target, speed in zip(
            log.of(Target), ("", ",speed_mps=0.5", ",speed_mps=0.5"), strict=True
        )
    ]
    alone = simulated_before(
        until, folder / "scenario.toml", f"maneuver.target=[{','.join(script)}]"
    )
    assert len(flight_bits(alone)) == until * 5
    assert flight_bits(alone) == flight_bits(before(until, log.of(Message)))
