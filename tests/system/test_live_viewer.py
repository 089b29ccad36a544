"""The viewer of a live run in a browser: whole frames, commands and targets."""

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from tests.support.browser import (
    RIGHT,
    Browser,
    Drawing,
    browser,
    connected_pages,
    needs_browser,
)
from tests.support.commands import PATIENCE_S, processes_of, settings, start, wait_for
from tests.support.live_log import LiveLog
from tests.support.same_flight import before, flight_bits, simulated_before
from transport.log.run_folder import setup_of
from transport.log.run_log import read_log
from transport.model.arrays import Array
from transport.protocol.wire.messages import LinkChange, PlantState, Target

# Way of the payload over the compared drawings, m; by then an older rod misses its ends by centimetres.
SEEN_M = 0.1
INTERRUPTED = 130
# The first seconds pass while the browser opens; the test ends the run.
LONG = (
    "maneuver.phase=[{name='hover',duration_s=8.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=900.0,displacement_m=[0,0,-60.0]}]"
)
SIDEWAYS = (
    "maneuver.phase=[{name='hover',duration_s=0.1,displacement_m=[0,0,0]},"
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
WANTED = {"delay_s": 0.3}  # of the moved slider alone


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    """Return a browser."""
    with browser() as opened:
        yield opened


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
        log = LiveLog(folder / "run.mcap")
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
                # A slow browser may not react to the first click on a new page.
                window.click(action, VICTIM - 1)
                return wait_for(
                    partial(log.has_fault_by_hand, f"agent{VICTIM}", noted), timeout_s=10.0
                )

            assert wait_for(is_done)
        assert window.console() == []

    whole = read_log(folder / "run.mcap")
    (change,) = whole.of(LinkChange)
    assert json.loads(change.settings) == WANTED
    assert change.tick + 10 < until
    table = f"{{at_s={change.tick * 0.05!r},delay_s=0.3}}"
    unwatched = simulated_before(until, folder / "scenario.toml", f"links.change=[{table}]")
    watched = before(until, (entry.message for entry in whole.messages))
    assert len(flight_bits(unwatched)) == until * (1 + AGENTS)
    assert flight_bits(watched) == flight_bits(unwatched)


@pytest.mark.slow
@needs_browser
def test_a_live_run_is_sent_to_targets(tmp_path: Path, window: Browser) -> None:
    """The handle, keys and the numbers of a page send the payload to targets, one after the other."""
    folder = tmp_path / "sent"
    hover = "maneuver.phase=[{name='hover',duration_s=900.0,displacement_m=[0,0,0]}]"
    with live_run(folder, "clock.speed=1.0", hover) as address:
        window.open(address)
        log = LiveLog(folder / "run.mcap")

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
        window.type("x, y, down (m)", "1.25, -0.5")
        window.click("Go there")
        assert wait_for(
            lambda: "expected three numbers x, y, down, got" in (window.text() or ""), BROWSER_S
        )
        window.type("x, y, down (m)", "1.25, -0.75 -10")
        window.click("Go there")  # at once: what is typed may come later than the click
        assert wait_for(lambda: len(log.of(Target)) > known, BROWSER_S)
        expected = np.array([1.25, -0.75, -10.0])
        assert [np.round(target.points[0], 6).tolist() for target in log.of(Target)[known:]] == [
            expected.tolist()
        ]
        place = "target x 1.25, y -0.75, down -10 m"
        for said in (f"{place}: arrives at t = ", f"{place}: since t = "):
            assert wait_for(partial(window.shows, said), BROWSER_S), window.text()
        assert window.console() == []
