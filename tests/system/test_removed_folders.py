"""Folders that vanish: a run folder while its run is active, and the current folder."""

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from tests.support.commands import (
    PATIENCE_S,
    command,
    is_flying,
    processes_of,
    settings,
    start,
    wait_for,
)
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNRECORDED, EXIT_USAGE

TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
# Paced, so that there is time to remove the folder; the run ends by itself.
PACED = (
    "maneuver.phase=[{name='hover',duration_s=4.0,displacement_m=[0,0,0]}]",
    "clock.speed=1.0",
)


@pytest.mark.slow
@pytest.mark.parametrize("removed", ["folder", "log"])
def test_a_run_whose_log_is_removed_is_not_recorded(tmp_path: Path, removed: str) -> None:
    """The run goes on to its end and says at once that it is not recorded: exit code 10, one line, no process left."""
    out = tmp_path / "out"
    process = start("run", "paper", *settings(*PACED), "--out", "out", "--no-figures", cwd=tmp_path)
    assert wait_for(is_flying(out, TEAM))
    assert wait_for(lambda: (out / "live.json").exists())
    if removed == "folder":
        shutil.rmtree(out)
    else:
        (out / "run.mcap").unlink()
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == EXIT_UNRECORDED, errors
    assert "Traceback" not in errors
    assert "the run continues without recording" in errors
    assert errors.splitlines()[-1] == (
        "transport: out/run.mcap: cannot write the log (the file has been removed); "
        "the run completed"
    )
    assert processes_of("out") == {}


@pytest.mark.slow
def test_a_run_interrupted_while_it_waits_leaves_no_folder(tmp_path: Path) -> None:
    """Before the first tick an interrupt leaves neither a run folder nor the link to it."""
    process = start("run", "paper", "--external", "agent1", cwd=tmp_path)
    runs = tmp_path / "runs"
    assert wait_for(lambda: any(runs.glob("*/live.json")))
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert output == ""
    assert errors.splitlines()[-1] == "transport: interrupted; nothing is recorded"
    assert [path.name for path in runs.iterdir()] == []


def in_a_removed_folder(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a folder that is removed before it begins."""
    folder.mkdir()
    program = "import os, sys; os.rmdir(os.getcwd()); os.execv(sys.argv[1], sys.argv[1:])"
    words = command(*arguments)
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    return subprocess.run(
        [words[0], "-c", program, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("status",),
        ("plot",),
        ("validate", "paper", "--set", "agents.controller=mine:Hover"),
        ("run", "paper"),
        ("run", "paper", "--set", "agents.controller=mine:Hover"),
    ],
    ids=" ".join,
)
def test_commands_in_a_removed_folder(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    """Without a current folder a command that needs one ends with one line, exit code 2 or 3."""
    done = in_a_removed_folder(tmp_path / "gone", *arguments)
    assert done.returncode in (EXIT_USAGE, EXIT_USAGE + 1), done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("transport: ")


@pytest.mark.slow
def test_a_run_in_a_removed_folder(tmp_path: Path) -> None:
    """A run that needs no file of the current folder is simulated and recorded elsewhere."""
    short = "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
    out = tmp_path / "out"
    arguments = ("run", "paper", "--set", short, "--out", str(out), "--no-figures")
    done = in_a_removed_folder(tmp_path / "gone", *arguments)
    assert done.returncode == 0, done.stderr
    assert (out / "summary.json").exists()
