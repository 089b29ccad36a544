"""Experiments from the command line.

The tables depend neither on the executor nor on interruptions.
"""

import csv
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import LocalCluster

from tests.support.commands import PATIENCE_S, start, transport, wait_for
from tests.support.results import FLIGHTS, SMALL, here, kept, tables
from tests.support.runs import ticks

DONE, LOST, INTERRUPTED = 0, 4, 130

# Runs long enough to be killed.
LONG = (
    "experiment",
    "latency",
    "--set",
    ticks(200),
    "--delay",
    "0.1",
    "--delay",
    "0.2",
    "--delay",
    "0.3",
)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the small experiment, run one by one in the command's own process."""
    folder = tmp_path_factory.mktemp("experiments") / "one"
    result = here(*SMALL, "--jobs", "1", "--out", folder)
    assert result.exit_code == DONE, result.output
    return folder


def members(session: int) -> list[int]:
    """Return the living processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            state, _, _, of = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:4]
        except (OSError, IndexError):
            continue
        if state != "Z" and int(of) == session:
            found.append(int(entry.name))
    return found


def gone(process: subprocess.Popen[str]) -> bool:
    """Return whether all processes of a command have ended."""
    return wait_for(lambda: not members(process.pid), timeout_s=20.0)


def test_the_output_is_whole(reference: Path) -> None:
    """Tables, figures and kept results; cases.csv has a row for each run, without wall-clock times."""
    names = {
        "experiment.json",
        "results.jsonl",
        "points.csv",
        "cases.csv",
        "figure.png",
        "figure.svg",
        "report.md",
    }
    assert {path.name for path in reference.iterdir()} == names
    with (reference / "cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == kept(reference) == FLIGHTS
    assert {row["outcome"] for row in rows} == {"completed"}
    assert [(row["model"], row["seed"]) for row in rows] == [
        ("none", "0"),
        *[(model, seed) for model in ("bernoulli", "bursts") for seed in ("0", "1")],
    ]
    with (reference / "points.csv").open() as file:
        points = list(csv.DictReader(file))
    assert [row["flights"] for row in points] == ["1", "2", "2"]
    assert points[0]["cost_mean_ci95"] == ""
    assert float(points[1]["plan_age_mean_ticks_ci95"]) > 0.0


def test_a_killed_experiment_is_resumed(reference: Path) -> None:
    """After SIGKILL, even in the middle of a line, finished runs are not repeated and the tables are the same."""
    folder = reference.parent / "killed"
    process = start(*SMALL, "--jobs", "1", "--out", "killed", cwd=reference.parent)
    assert wait_for(lambda: kept(folder) >= 2)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    done = kept(folder)
    with (folder / "results.jsonl").open("ab") as file:
        file.write(b'{"key": "0123')
    result = here(*SMALL, "--jobs", "1", "--out", folder)
    assert result.exit_code == DONE, result.output
    assert f"{done} of {FLIGHTS} runs are done already" in result.stderr
    assert kept(folder) == FLIGHTS + 1  # with the broken line
    assert tables(folder) == tables(reference)


@pytest.fixture
def cluster() -> Iterator[str]:
    """Return the address of a cluster of two workers on this machine."""
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as found:
        yield found.scheduler_address


@pytest.mark.slow
def test_a_cluster_gives_the_same(reference: Path, cluster: str) -> None:
    """The workers of a Dask cluster give the same tables, byte for byte."""
    result = transport(*SMALL, "--dask", cluster, "--out", "cluster", cwd=reference.parent)
    assert result.returncode == DONE, result.stderr
    assert tables(reference.parent / "cluster") == tables(reference)


@pytest.mark.parametrize(
    ("number", "jobs"),
    [pytest.param(signal.SIGINT, "2", marks=pytest.mark.slow), (signal.SIGTERM, "1")],
)
def test_an_interrupted_experiment_leaves_nothing_running(
    number: signal.Signals, jobs: str, tmp_path: Path
) -> None:
    """Ctrl-C, sent to all processes, and SIGTERM give exit code 130, keep results and leave no process."""
    process = start(*LONG, "--jobs", jobs, "--out", "out", cwd=tmp_path)
    assert wait_for(lambda: kept(tmp_path / "out") >= 1)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == INTERRUPTED, errors
    assert "resume with: --out out" in errors
    assert "Traceback" not in errors
    assert gone(process)


@pytest.mark.slow
def test_a_killed_experiment_leaves_nothing_running(tmp_path: Path) -> None:
    """After SIGKILL of the command its workers end."""
    process = start(*LONG, "--jobs", "2", "--out", "out", cwd=tmp_path)
    assert wait_for(lambda: len(members(process.pid)) > 3)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    assert gone(process)


@pytest.mark.slow
def test_a_dead_worker_is_reported(tmp_path: Path) -> None:
    """A killed worker ends the experiment with a line and exit code 4; no process is left."""
    process = start(*LONG, "--jobs", "2", "--out", "out", cwd=tmp_path)
    assert wait_for(lambda: kept(tmp_path / "out") >= 1)
    workers = [
        pid for pid in members(process.pid) if b"loky" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    os.kill(max(workers), signal.SIGKILL)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == LOST, errors
    assert "a worker process died" in errors
    assert "Traceback" not in errors
    assert gone(process)
