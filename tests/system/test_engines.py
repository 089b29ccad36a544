"""Engines of a person and a plant started by hand.

They fly, and what is wrong with them ends in one line.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.support.commands import (
    SHORT,
    free_base,
    processes_of,
    settings,
    start,
    transport,
    wait_for,
)
from tests.support.results import here
from tests.support.runs import plant_states, ready, recorded
from transport.log.run_log import read_log
from transport.model.arrays import Array
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_DIVERGED,
    EXIT_SCENARIO,
    EXIT_UNREACHABLE,
    EXIT_USAGE,
)
from transport.protocol.wire.messages import PlantState

BROKEN = """
import time
from transport.plant.engines import Rods

class Raising(Rods):
    def advance(self, u, forces, duration_s):
        raise OSError("the other program has gone")

class Slow(Rods):
    calls = 0
    def advance(self, u, forces, duration_s):
        self.calls += 1
        if self.calls > 4:  # the first is before the run
            time.sleep(60.0)
        return super().advance(u, forces, duration_s)
"""

# What the code of an engine may do to its process.
ROUGH = """
import sys
from transport.plant.engines import Rods

class Prints(Rods):
    def __init__(self, *arguments):
        print("from Python")
        super().__init__(*arguments)

class Base(Rods):
    def __init__(self, *arguments):
        raise BaseException("no more")

class Exits(Rods):
    def advance(self, u, forces, duration_s):
        sys.exit(0)
"""


def line_of(module: str, code: str) -> int:
    """Return the number of the first line of a module's text that has some code."""
    numbered = enumerate(module.splitlines(), start=1)
    return next(number for number, line in numbered if code in line)


def states(folder: Path) -> Array:
    """Return the recorded states of the plant, (ticks, n)."""
    return np.array([entry.x for entry in read_log(folder / "run.mcap").of(PlantState)])


@pytest.mark.slow
def test_a_plant_started_by_hand(tmp_path: Path) -> None:
    """`--external` waits for a plant that the user starts with what is printed.

    The run has the same bits.
    """
    options = settings(SHORT, f"network.base_port={free_base()}")
    run = start(
        "run",
        "resilient",
        "--external",
        "plant",
        *options,
        "--out",
        "mine",
        "--no-figures",
        cwd=tmp_path,
    )
    try:
        assert run.stderr is not None
        # The model may be compiled before.
        line = next((line for line in run.stderr if line.startswith("waiting")), "")
        keys = re.search(r"digest \w+; it listens on .*--set '(network.keys=.*)'\n", line)
        assert keys is not None, line
        names = ("--scenario", "mine/scenario.toml", "--run", "mine", *settings(keys[1]))
        plant = transport("plant", *names, cwd=tmp_path)
        _, errors = run.communicate(timeout=60)
    finally:
        run.kill()  # without effect once it has ended
        run.wait()
    assert (plant.returncode, run.returncode) == (0, 0), (plant.stderr, errors)
    summary = json.loads((tmp_path / "mine" / "summary.json").read_text())
    assert (summary["outcome"], summary["rejections"], summary["log_cut"]) == (
        "completed",
        [],
        None,
    )
    assert not (tmp_path / "mine" / "logs" / "plant.log").exists()
    own = np.array([entry.x for entry in plant_states(recorded(ready("resilient", SHORT)))])
    assert states(tmp_path / "mine").tobytes() == own.tobytes()


@pytest.mark.slow
def test_mujoco_across_processes(tmp_path: Path) -> None:
    """With MuJoCo a run of separate processes equals the one in memory bit for bit, and the summary names it."""
    changes = (SHORT, "plant.engine=mujoco")
    done = transport(
        "run", "resilient", *settings(*changes), "--out", "out", "--no-figures", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    own = np.array([entry.x for entry in plant_states(recorded(ready("resilient", *changes)))])
    assert states(tmp_path / "out").tobytes() == own.tobytes()
    assert re.fullmatch(
        r"mujoco \d+\.\d+\.\d+",
        json.loads((tmp_path / "out" / "summary.json").read_text())["engine"],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "code", "text"),
    [
        (
            "broken:Raising",
            EXIT_DIVERGED,
            "transport: engine broken:Raising: advance raised OSError: the other program has gone "
            f"(broken.py:{line_of(BROKEN, 'raise OSError')}) at t = 0.00 s",
        ),
        (
            "broken:Slow",
            EXIT_UNREACHABLE,
            "transport: no agent answered tick 4 in time: is the plant alive?; logs in out/logs",
        ),
    ],
)
def test_an_engine_that_fails(engine: str, code: int, text: str, tmp_path: Path) -> None:
    """An engine that raises, or needs longer than the barrier, ends the run in one line.

    No process is left behind.
    """
    (tmp_path / "broken.py").write_text(BROKEN, encoding="utf-8")
    options = settings(SHORT, f"plant.engine={engine}", "clock.barrier_timeout_s=2.0")
    done = transport("run", "paper", *options, "--out", "out", "--no-figures", cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stderr.strip().splitlines()[-1] == text
    assert "Traceback" not in done.stderr
    assert wait_for(lambda: not processes_of("out"))


@pytest.mark.parametrize(
    ("engine", "code", "text"),
    [
        ("rough:Prints", 0, ""),
        pytest.param(
            *(
                "rough:Base",
                EXIT_SCENARIO,
                "the constructor raised BaseException: no more "
                f"(rough.py:{line_of(ROUGH, 'raise BaseException')})",
            ),
            marks=pytest.mark.slow,
        ),
        (
            "rough:Exits",
            EXIT_DIVERGED,
            f"advance raised SystemExit: 0 (rough.py:{line_of(ROUGH, 'sys.exit(0)')})",
        ),
    ],
)
def test_an_engine_that_does_not_behave(engine: str, code: int, text: str, tmp_path: Path) -> None:
    """Prints do not reach the results.

    Whatever else it does to its process is named in one line, in time.
    """
    (tmp_path / "rough.py").write_text(ROUGH, encoding="utf-8")
    options = settings(SHORT, f"plant.engine={engine}", "clock.join_timeout_s=4.0")
    done = transport(
        "run", "paper", *options, "--out", "out", "--no-figures", "--format", "json", cwd=tmp_path
    )
    assert done.returncode == code, done.stderr
    assert text in done.stderr
    assert "Traceback" not in done.stderr
    if code == EXIT_SCENARIO:  # refused before the run
        assert done.stdout == ""
    else:
        result = json.loads(done.stdout)
        assert (result["run_id"], result["exit_code"]) == ("out", code)
    assert wait_for(lambda: not processes_of("out"))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            ["--external", "coordinator"],
            "--external: expected one of plant, agent1, agent2, agent3, agent4, got 'coordinator'",
        ),
        (
            [
                "--external",
                "agent2",
                "--set",
                "faults.event=[{at_s=1.0,do='kill',target='agent2'}]",
            ],
            "--external: expected a process without scripted faults, which act only on processes of the run, "
            "got 'agent2'",
        ),
    ],
)
def test_what_cannot_run_is_refused(
    options: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything starts: no process, no folder."""
    monkeypatch.chdir(tmp_path)
    done = here("run", "paper", *options)
    assert (done.exit_code, done.stderr) == (EXIT_USAGE, f"transport: {text}\n")
    assert list(tmp_path.iterdir()) == []
