"""The part of docs/active-runs.md on a run impaired by hand.

Its commands, in order, on the scenario `playground`.
"""

import json
import re
import shlex
import signal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.support.commands import PATIENCE_S, is_flying, processes_of, settings, start, wait_for
from transport.analysis.series import series_of
from transport.cli.main import app
from transport.log.run_folder import open_run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "active-runs.md"
TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
INTERRUPTED = 130
# Ticks between two commands; time of a step on a busy machine, s.
BETWEEN, BUSY = 20, ("clock.barrier_timeout_s=5.0",)
# Limits of a load that is in the air: light gusts and an absent agent move it by a few decimetres.
NEAR_M, LEVEL_DEG = 1.0, 10.0


def command_lines() -> tuple[list[str], list[list[str]]]:
    """Return the words of the command that starts the run, and of those that act on it."""
    _, _, part = PAGE.read_text(encoding="utf-8").partition("To impair a run by hand")
    first, second = re.findall(r"^```\n(.*?)^```", part, re.MULTILINE | re.DOTALL)[:2]
    lines = [shlex.split(line, comments=True)[1:] for line in (first + second).splitlines()]
    return lines[0], lines[1:]


def invoke(*arguments: str) -> str:
    """Return the output of a command that must succeed.

    In this process, as starting one takes seconds.
    """
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 0, (arguments, result.stderr)
    return result.stdout


@pytest.mark.slow
@pytest.mark.pages
def test_the_load_stays_in_the_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After every command, one after the other, the whole team carries the load, level and near its place."""
    monkeypatch.chdir(tmp_path)
    begin, commands = command_lines()
    assert begin == ["run", "playground"]
    assert [" ".join(words[:2]) for words in commands] == [
        "target 2",
        *["link set"] * 2,
        "link clear",
        *["fault kill", "fault restart", "fault stop", "fault continue"],
        "status",
        "top",
    ]
    process = start(*begin, *settings(*BUSY), "--out", "runs/played", "--no-figures", cwd=tmp_path)

    def status() -> dict[str, Any]:
        found: dict[str, Any] = json.loads(invoke("status", "--format", "json"))
        return found

    def has(members: list[int]) -> bool:
        return bool(status()["members"] == members)

    def is_at(tick: int) -> bool:
        return bool(status()["tick"] >= tick)

    try:
        assert wait_for(is_flying(tmp_path / "runs" / "played", TEAM)), process.communicate(
            timeout=10
        )
        # Names the run to the commands.
        assert wait_for((tmp_path / "runs" / "played" / "live.json").exists)
        assert wait_for(partial(is_at, 1))  # the processes have started before
        members = [1, 2, 3, 4]
        for words in commands:
            # It shows the agents until the run ends.
            invoke(*words, *(["--once"] if words == ["top"] else []))
            members = (
                {"kill": [1, 3, 4], "stop": [1, 3, 4]}.get(words[1], [1, 2, 3, 4])
                if len(words) > 1
                else members
            )
            assert wait_for(partial(has, members)), words
            until = status()["tick"] + BETWEEN
            assert wait_for(partial(is_at, until))
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == INTERRUPTED, errors
    assert processes_of("played") == {}
    run = open_run(tmp_path / "runs" / "played", horizons=False)
    series = series_of(run.setup, run.log)
    assert np.linalg.norm(series.payload_error_I, axis=1).max() < NEAR_M
    assert series.attitude_max_deg.max() < LEVEL_DEG
