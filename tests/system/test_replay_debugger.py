"""`transport replay --pdb`: the debugger opens before a tick, and leaving it is no error of the program."""

import subprocess
from pathlib import Path

import pytest

from tests.support import runs
from tests.support.commands import PATIENCE_S, command
from tests.support.logs import record_run
from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recorded run."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    record_run(runs.setup(runs.ticks(10)), folder)
    return folder


def debugged(folder: Path, text: str, tick: int = 3) -> subprocess.CompletedProcess[str]:
    """Replay agent 1 with a debugger that reads a text."""
    return subprocess.run(
        command("replay", folder, "--agent", "1", "--pdb", str(tick)),
        input=text,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.mark.slow
def test_leaving_the_debugger_ends_the_replay(folder: Path) -> None:
    """At the end of its input the command ends with one line that says where."""
    done = debugged(folder, "p measurement.tick\n")
    assert done.returncode == EXIT_USAGE
    assert done.stderr == (
        "transport: --pdb: the debugger was left at tick 3, before the end of the comparison\n"
    )


@pytest.mark.slow
def test_the_debugger_leads_into_the_step(folder: Path) -> None:
    """As docs/replay.md says: `node` is the agent, and a breakpoint at its `receive` is reached."""
    done = debugged(folder, "tbreak node.receive\nc\np (self.name, event.tick)\nq\n")
    assert "('agent1', 3)" in done.stdout


@pytest.mark.slow
def test_going_on_compares_the_plans(folder: Path) -> None:
    """After `continue` all plans are compared."""
    done = debugged(folder, "c\n")
    assert done.returncode == 0, done.stderr
    assert "all 10 plans of ticks 0 to 9 are identical" in done.stdout
