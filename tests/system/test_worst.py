"""The command `transport worst`: what it finds can be flown again, with the same bits everywhere."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import PATIENCE_S, start, wait_for
from tests.support.results import here
from tests.support.runs import SHORT
from tests.system.test_sweep import gone

# With a fail-safe that keeps level a death tilts the payload, so there is something to find.
LEVEL = ("--set", "controller.fail_safe=level")
OVER = ("--over", "gusts,deaths", "--budget", "6", "--limit", "0.2")
SEARCH = ("worst", "resilient", *LEVEL, *OVER, "--set", SHORT, "--format", "json")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return folder and summary of a search that nothing interrupts, with one worker."""
    folder = tmp_path_factory.mktemp("whole") / "worst"
    done = here(*SEARCH, "--jobs", "1", "--out", folder)
    assert done.exit_code == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.slow
def test_the_minimal_case_is_flown_again_with_the_same_bits(
    found: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """The file fails in memory and with processes alike, and says so in its comment."""
    folder, result = found
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
def test_an_interrupted_search_is_resumed_with_the_same_result(
    found: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """Ctrl-C ends the command and its workers, which stay from batch to batch; the rest is flown later by one."""
    process = start(*SEARCH, "--jobs", "2", "--out", "one", cwd=tmp_path)
    file = tmp_path / "one" / "evaluations.jsonl"
    assert wait_for(lambda: file.exists() and file.read_bytes().count(b"\n") > 2)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert gone(process)

    resumed = json.loads(here(*SEARCH, "--jobs", "1", "--out", tmp_path / "one").stdout)
    folder, whole = found
    assert {**resumed, "folder": ""} == {**whole, "folder": ""}
    assert (tmp_path / "one/minimal.toml").read_bytes() == (folder / "minimal.toml").read_bytes()
