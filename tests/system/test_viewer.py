"""The viewer in a browser.

Recorded, cut and live runs, whole frames, commands, and what is refused.
"""

import json
import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from typer.testing import CliRunner

from tests.support import runs
from tests.support.browser import (
    END,
    RIGHT,
    Browser,
    Drawing,
    browser,
    connected_pages,
    needs_browser,
)
from tests.support.commands import PATIENCE_S, command, processes_of, settings, start, wait_for
from tests.support.logs import Growing, bits, messages_until, record_run
from transport.cli.main import app
from transport.flight import live
from transport.flight.live import LiveRun
from transport.flight.run import simulate as run_processes
from transport.log.run_log import LogTail, read_log, setup_of
from transport.model.arrays import Array
from transport.protocol.network.parent import PARENT_PIPE
from transport.protocol.wire.exit_codes import EXIT_UNREACHABLE
from transport.protocol.wire.messages import LinkChange, PlantState, Target
from transport.scene.history import RunHistory
from transport.scene.scene import SceneBuilder
from transport.viewer.playback import Playback
from transport.viewer.viewer import Viewer, open_viewer

# A climb of half a metre moves the payload by at least this, m.
SEEN_M = 0.2
PIXELS = 0.002  # share of pixels that change when the team moves
LAST_S = 1.45  # last recorded instant of the short run of 1.5 s
CUT = 0.6
INTERRUPTED = 130
OTHER_LOOPBACK = "127.0.0.2"  # an address of this host on which the viewer does not listen
# The first seconds pass while the browser opens; the test ends the run.
LONG = (
    "maneuver.phase=[{name='hover',duration_s=8.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=900.0,displacement_m=[0,0,-60.0]}]"
)
# Fast enough that a rod of an older frame would miss its ends by decimetres.
SIDEWAYS = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='sideways',duration_s=600.0,displacement_m=[600.0,0,-60.0]}]"
)
SLOWLY = "clock.speed=0.1"  # real time has to keep up on a busy machine: 0.5 s a tick
DRAWINGS = 12
FRESH = 3  # browsers
BROWSER_S = 600.0  # for a page that is drawn without a graphics processor on a busy machine; the runs last longer
ROD_M = 1e-3  # poses and points have single precision, at some hundred metres
ARROW_M = 0.5  # of the arrow along x of the handle, whose scale is 0.6, from its middle
DELAY_STEPS = 10  # of 0.01 s, from those of the run
LATE = ("links.delay_s=0.2", "links.loss=0.3")
AGENTS, VICTIM = 4, 2
WANTED = {"delay_s": 0.3, "loss": 0.3}


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
        assert wait_for(lambda: viewer.shown is not None and viewer.shown.tick == 29)
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
        viewer.playback.seek(29)
        assert wait_for(lambda: viewer.shown is not None and 5 < viewer.shown.tick < 29)


def test_no_frame_of_a_live_run_without_a_browser(recorded: Path, tmp_path: Path) -> None:
    """A browser that connects gets the newest frame; the end of the run is shown in any case."""
    data, log = (recorded / "run.mcap").read_bytes(), tmp_path / "run.mcap"
    log.write_bytes(data[: round(CUT * len(data))])
    builder = SceneBuilder(setup_of(recorded), RunHistory(setup_of(recorded)))
    running = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())

    def seen() -> bool:
        viewer.update()
        return viewer.shown is not None

    with Viewer(builder, port=0, tail=LogTail(log), live=running) as viewer:
        assert not seen()
        assert builder.history.last > 0
        with connected_pages(viewer.address, 1):
            assert wait_for(seen)
            assert viewer.shown is not None
            assert viewer.shown.tick == builder.history.last < 29
        with log.open("ab") as growing:
            growing.write(data[round(CUT * len(data)) :])
        assert wait_for(lambda: seen() and viewer.shown is not None and viewer.shown.tick == 29)
        assert viewer.notice.startswith("the run has ended: ")


@contextmanager
def live_run(folder: Path, *settings_: str) -> Iterator[str]:
    """Run `resilient` with the viewer beside it, without end; yield the viewer's address."""
    arguments = ("--no-figures", "--view", "--port", "0", "--out", folder.name)
    process = start("run", "resilient", *settings(*settings_), *arguments, cwd=folder.parent)
    try:
        yield page_of(process)
    finally:
        process.send_signal(signal.SIGINT)
        result, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == INTERRUPTED, result + errors
    assert processes_of(folder.name) == {}


def page_of(run: subprocess.Popen[str]) -> str:
    """Return the address of the viewer that a run has begun."""
    output = ""
    assert run.stderr is not None
    while not (address := re.search(r"http://127\.0\.0\.1:\d+/\S+", output)):
        line = run.stderr.readline()
        assert line, output
        output += line
    return address[0]


def test_a_viewer_that_waits_ends_with_its_parent(tmp_path: Path) -> None:
    """A viewer beside a run that does not begin ends when `transport run` has ended, long before its timeout."""
    arguments = command("view", tmp_path / "none", "--port", "0", "--wait", "600")
    with subprocess.Popen(
        arguments, stdin=subprocess.PIPE, env={**os.environ, PARENT_PIPE: "1"}
    ) as viewer:
        assert viewer.stdin is not None
        viewer.stdin.close()
        assert viewer.wait(PATIENCE_S) == EXIT_UNREACHABLE


@pytest.mark.slow
def test_a_run_waits_until_its_viewer_is_ready(tmp_path: Path) -> None:
    """No tick is opened before `ready`, with which `transport run --view` waits for the viewer, has returned."""
    seen: list[bool] = []

    def ready() -> None:
        assert live.read(tmp_path / "run") is not None  # a viewer can open the run
        time.sleep(1.0)
        seen.append(any(True for _ in LogTail(tmp_path / "run" / "run.mcap").read()))

    setup = runs.setup(runs.SHORT)
    finished = run_processes(setup, tmp_path / "run", Console(stderr=True), ready=ready)
    assert finished.exit_code == 0
    assert seen == [False]


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_frames_of_a_live_run_are_whole(tmp_path: Path, window: Browser, mode: str) -> None:
    """In every drawing of a moving team, each rod ends at its attachment to the payload and at its UAV."""
    with live_run(tmp_path / "whole", f"clock.mode={mode}", SLOWLY, SIDEWAYS) as address:
        window.open(address)
        assert wait_for(lambda: "sideways" in (window.text() or ""), BROWSER_S), window.text()
        drawings: list[Drawing] = []

        def moved() -> bool:
            drawings.append(window.drawing())
            # The view follows the team: seen from the world, it moves.
            first, last = (
                np.linalg.inv(drawings[k].poses["/world"]) @ drawings[k].poses["/world/payload"]
                for k in (0, -1)
            )
            return len(drawings) >= DRAWINGS and bool(
                np.linalg.norm((last - first)[:3, 3]) > SEEN_M
            )

        assert wait_for(moved, BROWSER_S)
        window.leave()
    attachments = np.array([uav.rho for uav in setup_of(tmp_path / "whole").system.uavs])
    for number, drawing in enumerate(drawings):
        if folder := os.environ.get("VIEWER_IMAGES"):
            (Path(folder) / f"{mode}-{number + 1:02}.png").write_bytes(drawing.image)
        assert rod_error_m(drawing, attachments) < ROD_M


def rod_error_m(drawing: Drawing, attachments: Array) -> float:
    """Return the largest distance of a rod's ends from attachment and UAV in a drawing.

    Args:
        drawing: One drawing of a page.
        attachments: Attachments of the rods, (N, 3), payload frame, m.
    """
    errors = []
    for i, rho in enumerate(attachments):
        ends = drawing.points[f"/world/rod{i + 1}/rod"]
        attachment = (drawing.poses["/world/payload"] @ np.append(rho, 1.0))[:3]
        errors.append(ends - [attachment, drawing.poses[f"/world/uav{i + 1}"][:3, 3]])
    return float(np.linalg.norm(errors, axis=-1).max())


@pytest.mark.slow
@needs_browser
def test_fresh_browsers_show_the_team(tmp_path: Path) -> None:
    """The first drawing of the team in a browser that was just started has all of it in its view.

    It stays there while the team moves and the page tells where its camera is.
    """
    parts = ["/world/payload", *(f"/world/uav{i + 1}" for i in range(AGENTS))]
    with live_run(tmp_path / "fresh", SLOWLY, SIDEWAYS) as address:
        for _ in range(FRESH):
            with browser() as fresh:
                fresh.open(address)
                for _ in range(DRAWINGS // FRESH):
                    drawing = fresh.drawing()
                    assert [name for name in parts if not drawing.sees(name)] == []


@pytest.mark.slow
@needs_browser
def test_a_live_run_is_shown_and_changed(tmp_path: Path, window: Browser) -> None:
    """A slider and a button delay all links, buttons kill and restart an agent, and the log holds all.

    The viewer does not change the run: in one process, with the changes in its scenario, the same
    run has bitwise the same plant states and plans, however many browsers were connected.
    """
    folder = tmp_path / "seen"
    with live_run(
        folder, "clock.speed=1.0", "clock.on_agent_loss=continue", LONG, *LATE
    ) as address:
        window.open(address)
        assert wait_for(lambda: window.values() >= {(1.0, 0.2), (100.0, 30.0)}, BROWSER_S), (
            window.values()
        )
        with connected_pages(address, 2):
            window.press(1.0, *[RIGHT] * DELAY_STEPS)
            window.click("Set")
            assert wait_for(lambda: "links change: at tick" in (window.text() or ""), BROWSER_S)
            assert wait_for(lambda: "12 of 12 links impaired" in (window.text() or ""), BROWSER_S)
        log = Growing(folder / "run.mcap")
        assert wait_for(
            lambda: any(json.loads(change.settings) == WANTED for change in log.of(LinkChange))
        )
        assert window.console() == []
        window.leave()
        until = log.of(PlantState)[-1].tick + 10
        assert wait_for(lambda: log.of(PlantState)[-1].tick > until)
        window.open(address)
        for action, noted in (("kill", "killed"), ("restart", "restarted")):

            def is_done(action: str = action, noted: str = noted) -> bool:
                window.click(
                    action, VICTIM - 1
                )  # a slow browser may not react to the first click on a new page
                return wait_for(partial(log.notes, f"agent{VICTIM}", noted), timeout_s=10.0)

            assert wait_for(is_done)
        assert window.console() == []

    whole = read_log(folder / "run.mcap")
    (change,) = whole.of(LinkChange)
    assert json.loads(change.settings) == WANTED
    assert change.tick + 10 < until
    table = f"{{at_s={change.tick * 0.05!r},delay_s=0.3,loss=0.3}}"
    unwatched = messages_until(until, folder / "scenario.toml", f"links.change=[{table}]")
    watched = [entry.message for entry in whole.messages if entry.message.tick < until]
    assert len(list(bits(unwatched))) == until * (1 + AGENTS)
    assert sorted(bits(watched)) == sorted(bits(unwatched))


@pytest.mark.slow
@needs_browser
def test_a_live_run_is_sent_to_targets(tmp_path: Path, window: Browser) -> None:
    """The handle, keys and the numbers of a page send the payload to targets, one after the other."""
    folder = tmp_path / "sent"
    hover = "maneuver.phase=[{name='hover',duration_s=900.0,displacement_m=[0,0,0]}]"
    with live_run(folder, "clock.speed=1.0", hover) as address:
        window.open(address)
        log = Growing(folder / "run.mcap")

        view = window.driver.find_element("css selector", "canvas")

        def is_dragged() -> bool:
            x, y = window.drawing().place("/world/target", np.array([ARROW_M, 0.0, 0.0]))
            right, down = round(x * view.size["width"] / 2), round(-y * view.size["height"] / 2)
            pull: Any = ActionChains(window.driver, duration=400)
            pull.move_to_element_with_offset(view, right, down)
            pull.click_and_hold().move_by_offset(25, 0).move_by_offset(25, 10).pause(
                1.0
            ).release().perform()
            return wait_for(lambda: len(log.of(Target)) > 0, 15.0)

        assert wait_for(is_dragged)
        expected = log.of(Target)[-1].points[0]
        assert expected[0] > 0.1
        assert expected[1:].tolist() == [0.0, -10.0]
        for key, step in ((Keys.ARROW_UP, [0.0, -0.5, 0.0]), (Keys.PAGE_UP, [0.0, 0.0, -0.5])):
            known, expected = len(log.of(Target)), expected + step
            keys: Any = ActionChains(window.driver).key_down(Keys.SHIFT)
            keys.send_keys(key).key_up(Keys.SHIFT).perform()
            assert wait_for(lambda known=known: len(log.of(Target)) > known, BROWSER_S)  # type: ignore[misc]
            assert np.allclose(log.of(Target)[-1].points, [expected])
        known = len(log.of(Target))
        window.type("x, y, z (m)", "1.25, -0.5")
        window.click("Go there")
        assert wait_for(lambda: "expected three numbers, got" in (window.text() or ""), BROWSER_S)
        window.type("x, y, z (m)", "1.25, -0.75 -10")
        window.click("Go there")  # at once: what is typed may come later than the click
        assert wait_for(lambda: len(log.of(Target)) > known, BROWSER_S)
        expected = np.array([1.25, -0.75, -10.0])
        assert [np.round(target.points[0], 6).tolist() for target in log.of(Target)[known:]] == [
            expected.tolist()
        ]
        place = "target (1.25, -0.75, -10) m"
        for said in (f"{place}: arrives at t = ", f"{place}: since t = "):
            assert wait_for(partial(window.shows, said), BROWSER_S), window.text()
        assert window.console() == []


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


def test_playback_pauses_plays_and_follows() -> None:
    """Paused playback stays, playing advances at its speed and stops at the end, following shows the newest tick."""
    playback = Playback(0.05, follows=False)
    assert playback.advance(1.0, 0, 100) == 0
    playback.toggle()
    assert playback.advance(1.0, 0, 100) == 20
    playback.speed = 2.0
    assert playback.advance(1.0, 0, 100) == 60
    assert playback.advance(9.0, 0, 100) == 100
    assert not playback.playing
    playback.toggle()  # from the beginning again
    assert playback.advance(0.1, 3, 100) == 4
    playback.follow(True)
    assert [playback.advance(0.1, 3, last) for last in (101, 105)] == [101, 105]
    playback.seek(50)
    assert playback.advance(1.0, 3, 110) == 50
    assert (playback.follows, playback.playing) == (False, False)


def test_what_cannot_be_shown_is_refused(tmp_path: Path, recorded: Path) -> None:
    """No run, no log, an empty log, an unusable address.

    Exit code 2 and one line with what was expected.
    """
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    refusals = {
        f"{tmp_path / 'nowhere' / 'run.mcap'}: cannot read the log": [
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
