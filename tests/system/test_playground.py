"""The README's part "watch it happen": its commands, in order, on the scenario `playground`."""

import json
import re
import shlex
import signal
from pathlib import Path

import numpy as np
import pytest

from protocol.wire.messages import PlantState
from tests.support.commands import PATIENCE_S, is_flying, processes_of, settings, start, transport, wait_for
from transport.analysis.series import series_of
from transport.log.run_folder import open_run

README = Path(__file__).resolve().parents[2] / "README.md"
TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
INTERRUPTED = 130
# Half of real time, as a busy machine needs; ticks between two commands.
SLOWLY, BETWEEN = ("clock.speed=0.5",), 20
# Limits of a load that is in the air: light gusts and an absent agent move it by a few decimetres.
NEAR_M, LEVEL_DEG = 1.0, 10.0


def command_lines() -> tuple[list[str], list[list[str]]]:
    """Return the words of the command that starts the run, and of those that act on it."""
    _, _, part = README.read_text(encoding="utf-8").partition("Or watch it happen")
    first, second = re.findall(r"^```\n(.*?)^```", part, re.MULTILINE | re.DOTALL)[:2]
    lines = [shlex.split(line, comments=True)[1:] for line in (first + second).splitlines()]
    return lines[0], lines[1:]


@pytest.mark.slow
def test_the_load_stays_in_the_air(tmp_path: Path) -> None:
    """After every command, one after the other, the whole team carries the load, level and near its place."""
    begin, commands = command_lines()
    assert begin == ["run", "playground"]
    assert [" ".join(words[:2]) for words in commands] == [
        *["link set"] * 2,
        "link clear",
        *["fault stop", "fault continue", "fault kill", "fault restart"],
        "status",
        "top",
    ]
    process = start(*begin, *settings(*SLOWLY), "--out", "runs/played", "--no-figures", cwd=tmp_path)

    def status() -> dict[str, object]:
        found: dict[str, object] = json.loads(transport("status", "--format", "json", cwd=tmp_path).stdout or "{}")
        return found

    def tick() -> int:
        """Return the tick of the run; -1 if a busy coordinator does not answer."""
        found = status().get("tick", -1)
        assert isinstance(found, int)
        return found

    try:
        assert wait_for(is_flying(tmp_path / "runs" / "played", TEAM)), process.communicate(timeout=10)
        for words in commands:
            last = [*words, "--once"] if words == ["top"] else words  # it shows the agents until the run ends
            done = transport(*last, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
            assert wait_for(lambda: tick() >= 0)
            until = tick() + BETWEEN
            assert wait_for(lambda until=until: tick() >= until)
        assert wait_for(lambda: status().get("members") == [1, 2, 3, 4])
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == INTERRUPTED, errors
    assert processes_of("played") == {}
    run = open_run(tmp_path / "runs" / "played", horizons=False)
    assert next(run.log.of(PlantState), None) is not None
    series = series_of(run.setup, run.log)
    assert np.linalg.norm(series.payload_error_I, axis=1).max() < NEAR_M
    assert series.attitude_max_deg.max() < LEVEL_DEG
