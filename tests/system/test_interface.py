"""The Python interface with processes, with a viewer, and as installed from a wheel."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

import transport
from tests.support.commands import PATIENCE_S, wait_for
from transport.log.run_log import RunLog
from transport.protocol.wire.messages import Message, Plan, PlantState

ROOT = Path(__file__).resolve().parents[2]
PHASES = (
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 1.0, "displacement_m": [0.0, 0.0, -0.5]},
)
SETTINGS: dict[str, Any] = {"links.delay_s": 0.1, "links.loss": 0.2, "maneuver.phase": PHASES}
PACKAGES = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "deploy", "transport"),
    *("scenarios", "vehicles"),
)


def digest(log: RunLog) -> dict[tuple[str, int, str], bytes]:
    """Return the bits of all plans and states by sender, tick and kind."""
    messages: list[Message] = [entry.message for entry in log.messages]
    plans = {
        (m.sender, m.tick, m.kind): m.inputs.tobytes() for m in messages if isinstance(m, Plan)
    }
    return plans | {
        (m.sender, m.tick, m.kind): m.x.tobytes() for m in messages if isinstance(m, PlantState)
    }


def children() -> set[int]:
    """Return the children of this process, ended ones too, by the system's process table.

    Those of earlier tests may end at any time.
    """
    found = set()
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = entry.read_text().rsplit(")", 1)[1].split()[1]
        except OSError:
            continue
        if int(parent) == os.getpid():
            found.add(int(entry.parent.name))
    return found


def open_files() -> list[str]:
    """Return the kinds of what this process has open and a run could leave.

    Sockets, pipes, processes, shared memory.

    Zenoh's runtime starts threads when it needs them and keeps them, with their events.
    """
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if target.startswith(("socket:", "pipe:", "/dev/shm/", "anon_inode:[pidfd]")):  # noqa: S108  # only read
            found.append(target.partition(":[")[0])
    return sorted(found)


@pytest.mark.slow
def test_processes_give_the_bits_of_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With processes, in the main thread or another, plans and states are those in memory.

    Nothing stays.
    """
    monkeypatch.chdir(tmp_path)
    before = children()
    expected = digest(transport.fly("resilient", SETTINGS, progress=False).log)
    first = transport.fly("resilient", SETTINGS, processes=True, progress=False)
    assert digest(first.log) == expected
    assert first.folder is not None
    assert first.folder.parent == Path("runs")
    assert {"run.mcap", "summary.json", "figures", "logs"} <= {
        path.name for path in first.folder.iterdir()
    }
    files = open_files()
    found: list[transport.Run] = []

    def fly() -> None:
        found.append(
            transport.fly("resilient", SETTINGS, processes=True, progress=False, folder="second")
        )

    thread = threading.Thread(target=fly)
    thread.start()
    thread.join()
    assert digest(found[0].log) == expected
    assert children() <= before
    assert open_files() == files
    with pytest.raises(
        transport.ArgumentError,
        match="folder: expected a folder that does not exist yet, got second",
    ):
        transport.fly("resilient", SETTINGS, processes=True, folder="second")


@pytest.mark.slow
def test_an_interrupt_ends_the_processes(tmp_path: Path) -> None:
    """Ctrl-C during a run with processes raises KeyboardInterrupt, and no process is left."""
    before, folder = children(), tmp_path / "run"
    done = threading.Event()

    def interrupt() -> None:
        wait_for(
            lambda: (
                done.is_set()
                or ((log := folder / "run.mcap").exists() and log.stat().st_size > 50_000)
            )
        )
        if not done.is_set():
            os.kill(os.getpid(), signal.SIGINT)

    def fly() -> None:
        try:
            transport.fly(
                "paper", {"clock.speed": 1.0}, processes=True, progress=False, folder=folder
            )
        finally:
            done.set()

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        fly()
    thread.join()
    assert children() <= before
    assert transport.load(folder).outcome == "aborted"


def test_a_run_that_cannot_start_is_an_error(tmp_path: Path) -> None:
    """An address of another machine: one line, the error class of the interface, and nothing is left."""
    before = children()
    with pytest.raises(transport.TransportError) as caught:
        transport.fly(
            "paper",
            {"network.host": "192.0.2.1"},
            processes=True,
            progress=False,
            folder=tmp_path / "run",
        )
    assert "\n" not in str(caught.value)
    assert children() <= before


def test_the_viewer_of_a_run() -> None:
    """A run is shown by a server of this process until it is closed; no thread stays."""
    pytest.importorskip("viser")
    run = transport.fly("resilient", SETTINGS, progress=False)
    threads = threading.active_count()
    with run.view(port=0) as viewer:
        with urllib.request.urlopen(viewer.address, timeout=PATIENCE_S) as page:  # noqa: S310  # loopback
            assert b"<html" in page.read().lower()
        assert viewer.address in viewer._repr_html_()
        assert "<iframe" in viewer._repr_html_()
    assert "closed" in repr(viewer)
    viewer.close()
    assert wait_for(lambda: threading.active_count() <= threads)


@pytest.mark.slow
def test_the_wheel_is_complete(tmp_path: Path) -> None:
    """A wheel holds one package, and simulates a scenario in an empty folder, in both ways.

    The other packages are those of this environment.
    """
    sources, site, empty = (tmp_path / name for name in ("sources", "site", "empty"))
    for path in (*PACKAGES, "pyproject.toml", "README.md", "LICENSE"):
        if (ROOT / path).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / path, sources / path, symlinks=True, ignore=ignore)
        else:
            shutil.copy(ROOT / path, sources / path)
    # As pip builds it, but with the setuptools of this environment: pip would download its own.
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(tmp_path)!r})"
    subprocess.run(
        [sys.executable, "-c", build],
        cwd=sources,
        check=True,
        capture_output=True,
        timeout=PATIENCE_S,
    )
    (wheel,) = tmp_path.glob("payload_transport-*.whl")
    with ZipFile(wheel) as archive:
        archive.extractall(site)
    names = {path.name for path in site.iterdir()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"transport"}
    assert (site / "transport" / "py.typed").exists()
    empty.mkdir()
    program = (
        "import transport as t;"
        "assert t.__file__.startswith({site!r}), t.__file__;"
        f"s = {SETTINGS!r};"
        "runs = [t.fly('resilient', s, processes=p, progress=False) for p in (False, True)];"
        "print(*(run.summary['cost']['mean'] for run in runs))"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-c", program.replace("{site!r}", repr(str(site)))],
        cwd=empty,
        env=environment,
        capture_output=True,
        text=True,
        timeout=5 * PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    alone, apart = done.stdout.split()
    assert alone == apart
