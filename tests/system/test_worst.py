"""The command `transport worst`: what it finds can be flown again, with the same bits everywhere."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.support.commands import PATIENCE_S, start, wait_for
from tests.support.commands import transport as command
from tests.support.runs import SHORT
from tests.system.test_sweep import gone

# With a fail-safe that keeps level a death tilts the payload, so there is something to find.
LEVEL = ("--set", "controller.fail_safe=level")
SEARCH = ("worst", "resilient", *LEVEL, "--over", "gusts,deaths", "--budget", "8", "--limit", "0.2")


@pytest.mark.slow
def test_the_minimal_case_is_flown_again_with_the_same_bits(tmp_path: Path) -> None:
    """The file fails in memory and with processes alike, and says so in its comment."""
    folder = tmp_path / "worst"
    words = [*SEARCH, "--set", SHORT, "--out", str(folder), "--format", "json"]
    done = command(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["failures"] > 0
    file = folder / "minimal.toml"
    assert file.read_text(encoding="utf-8").startswith("# Minimal case of a search on resilient")
    assert (folder / "minimal.png").stat().st_size > 0

    import transport

    in_memory = transport.fly(file, progress=False)
    with_processes = transport.fly(file, processes=True, folder=tmp_path / "run", progress=False)
    assert in_memory.summary["attitude_max_deg"] == with_processes.summary["attitude_max_deg"]
    assert in_memory.summary["cost"] == with_processes.summary["cost"]
    assert in_memory.summary["attitude_max_deg"] > 0.2


@pytest.mark.slow
def test_an_interrupted_search_is_resumed_with_the_same_result(tmp_path: Path) -> None:
    """Ctrl-C ends the command and its workers, which stay from batch to batch; the rest is flown later."""
    words = [*SEARCH, "--set", SHORT, "--budget", "12", "--jobs", "2", "--format", "json", "--out"]
    process = start(*words, "one", cwd=tmp_path)
    file = tmp_path / "one" / "evaluations.jsonl"
    assert wait_for(lambda: file.exists() and file.read_bytes().count(b"\n") > 4)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert gone(process)

    resumed = json.loads(command(*words, "one", cwd=tmp_path).stdout)
    whole = json.loads(command(*words, "other", "--jobs", "1", cwd=tmp_path).stdout)
    assert {**resumed, "folder": ""} == {**whole, "folder": ""}
    assert (tmp_path / "one/minimal.toml").read_bytes() == (
        tmp_path / "other/minimal.toml"
    ).read_bytes()
