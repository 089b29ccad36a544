"""The viewer in a browser.

Recorded, cut and live runs, whole frames, commands, and what is refused.
"""

import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from tests.support import runs
from tests.support.browser import (
    END,
    Browser,
    browser,
    connected_pages,
    needs_browser,
)
from tests.support.commands import PATIENCE_S, command, start, wait_for
from tests.support.logs import record_run
from transport.cli.main import app
from transport.flight import active_runs
from transport.flight.active_runs import LiveRun
from transport.flight.run_execution import simulate as run_processes
from transport.log.run_folder import setup_of
from transport.log.run_log import LogTail, read_log
from transport.protocol.network.parent_and_environment import PARENT_PIPE
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import SceneBuilder
from transport.viewer.viewer import Viewer, open_viewer

# A climb of half a metre moves the payload by at least this, m.
SEEN_M = 0.2
PIXELS = 0.002  # share of pixels that change when the team moves
LAST_TICK = 29  # last recorded tick of the short run of 1.5 s, whose period is 0.05 s
LAST_S = 1.45  # its time
CUT = 0.6  # share of the log that is left
OTHER_LOOPBACK = "127.0.0.2"  # an address of this host on which the viewer does not listen


@contextmanager
def shown(folder: Path) -> Iterator[Viewer]:
    """Show a run like the command."""
    stop = threading.Event()
    with open_viewer(folder, "127.0.0.1", 0) as viewer:
        thread = threading.Thread(target=viewer.show_until, args=(stop.is_set,))
        thread.start()
        try:
            yield viewer
        finally:
            stop.set()
            thread.join()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short run."""
    folder = tmp_path_factory.mktemp("recorded")
    record_run(runs.setup(runs.SHORT), folder)
    return folder


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    """Return a browser."""
    with browser() as opened:
        yield opened


@pytest.mark.slow
@needs_browser
def test_a_recorded_run_is_shown(recorded: Path, window: Browser) -> None:
    """The slider moves the payload, in the scene and in pixels.

    No console errors, no requests to other hosts.
    """
    with shown(recorded) as viewer:
        window.open(viewer.address)
        assert wait_for(lambda: "hover" in (window.text() or ""))
        before, pixels, plots = viewer.shown, window.pixels(), window.plots()
        window.press(LAST_S, END)
        assert wait_for(lambda: viewer.shown is not None and viewer.shown.tick == LAST_TICK)
        assert wait_for(lambda: "climb" in (window.text() or ""))
        assert before is not None
        assert viewer.shown is not None
        assert np.linalg.norm(viewer.shown.payload_I - before.payload_I) > SEEN_M
        changed = np.abs(window.pixels() - pixels).max(axis=2) > 0.1
        assert changed.mean() > PIXELS
        assert len(plots) == 4
        assert wait_for(
            lambda: all(old != new for old, new in zip(plots, window.plots(), strict=True))
        )
        assert window.hosts() == {"127.0.0.1"}
        assert window.console() == []


def test_a_cut_log_is_shown(
    recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The viewer shows what a log cut at 60 % holds, and names the loss in the panel and in the terminal."""
    data = (recorded / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: round(CUT * len(data))])
    (tmp_path / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    lost = read_log(tmp_path / "run.mcap").cut
    assert "it stops before its end" in lost
    with shown(tmp_path) as viewer:
        assert lost in viewer.notice
        assert lost in capfd.readouterr().err
        viewer.playback.seek(LAST_TICK)
        assert wait_for(lambda: viewer.shown is not None and 5 < viewer.shown.tick < LAST_TICK)


def test_without_a_page_a_live_run_has_no_frame_but_the_last(
    recorded: Path, tmp_path: Path
) -> None:
    """Without a page no frame is made, which saves processor time, except the last one of the run.

    A page that connects gets the newest frame.
    """
    data, log = (recorded / "run.mcap").read_bytes(), tmp_path / "run.mcap"
    log.write_bytes(data[: round(CUT * len(data))])
    builder = SceneBuilder(setup_of(recorded), RunHistory(setup_of(recorded)))
    # The id stands for `transport run`; the viewer itself, unlike `active_runs.read`, does not look for it.
    running = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())

    def updated_tick() -> int | None:
        """Let the viewer read the log; return the tick of its newest frame, None without one."""
        viewer.update()
        return None if viewer.shown is None else viewer.shown.tick

    with Viewer(builder, port=0, tail=LogTail(log), live=running) as viewer:
        assert updated_tick() is None
        assert 0 < builder.history.last < LAST_TICK
        with connected_pages(viewer.address, 1):
            assert wait_for(lambda: updated_tick() == builder.history.last)
        with log.open("ab") as growing:
            growing.write(data[round(CUT * len(data)) :])
        assert wait_for(lambda: updated_tick() == LAST_TICK)
        assert viewer.notice.startswith("the run has ended: ")


def test_a_viewer_that_waits_ends_with_its_parent(tmp_path: Path) -> None:
    """A viewer beside a run that does not begin ends when `transport run` has ended, long before its timeout."""
    arguments = command("view", tmp_path / "none", "--port", "0", "--wait", "600")
    with subprocess.Popen(
        arguments, stdin=subprocess.PIPE, env={**os.environ, PARENT_PIPE: "1"}
    ) as viewer:
        assert viewer.stdin is not None
        # `PARENT_PIPE` says that the input is a pipe from the parent, which closes with its end.
        viewer.stdin.close()
        assert viewer.wait(PATIENCE_S) == EXIT_UNREACHABLE


@pytest.mark.slow
def test_a_run_waits_until_its_viewer_is_ready(tmp_path: Path) -> None:
    """No tick is opened before `ready`, with which `transport run --view` waits for the viewer, has returned."""
    seen: list[bool] = []

    def ready() -> None:
        assert active_runs.read(tmp_path / "run") is not None  # a viewer can open the run
        time.sleep(1.0)
        seen.append(any(True for _ in LogTail(tmp_path / "run" / "run.mcap").read()))

    setup = runs.setup(runs.SHORT)
    finished = run_processes(setup, tmp_path / "run", Console(stderr=True), ready=ready)
    assert finished.exit_code == 0
    assert seen == [False]


def test_the_command_listens_here_alone_until_ctrl_c(recorded: Path) -> None:
    """The command prints a loopback address.

    The next viewer takes the next port; Ctrl-C ends it without an error.
    """
    process = start("view", recorded, "--port", "0", cwd=recorded)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        port = int(address.removeprefix("http://127.0.0.1:").partition("/")[0])
        with socket.socket() as elsewhere:
            assert elsewhere.connect_ex((OTHER_LOOPBACK, port)) != 0
        with open_viewer(recorded, "127.0.0.1", port) as second:
            got = int(second.address.rpartition(":")[2].partition("/")[0])
            assert got > port
    finally:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, output) == (0, ""), errors
    assert "Traceback" not in errors


def test_what_cannot_be_shown_is_refused(tmp_path: Path, recorded: Path) -> None:
    """No run, no log, an empty log, an unusable address.

    Exit code 2 and one line with what was expected.
    """
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    refusals = {
        f"{tmp_path / 'nowhere'}: no such run, neither here nor in": [
            "view",
            str(tmp_path / "nowhere"),
        ],
        f"{empty / 'run.mcap'}: cannot read the log": ["view", str(empty)],
        "cannot listen on 203.0.113.1": ["view", str(recorded), "--host", "203.0.113.1"],
    }
    for text, arguments in refusals.items():
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 2
        assert result.stdout == ""
        assert result.stderr.startswith("transport: ")
        assert text in result.stderr
    (empty / "run.mcap").write_bytes((recorded / "run.mcap").read_bytes()[:300])
    assert "expected the states of a run" in CliRunner().invoke(app, ["view", str(empty)]).stderr


@pytest.mark.parametrize("arguments", [["view"], ["run", "paper", "--view", "--out"]])
def test_what_is_missing_is_named(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    """Without viser both commands name the package to install, before a run starts."""
    monkeypatch.setattr("transport.viewer.server.find_spec", lambda _: None)
    folder = recorded if arguments == ["view"] else tmp_path / "out"
    result = CliRunner().invoke(app, [*arguments, str(folder)])
    assert result.exit_code == 2
    assert (
        result.stderr
        == "transport: viser is not installed: pip install 'payload-transport[view]'\n"
    )
    assert not (tmp_path / "out").exists()
