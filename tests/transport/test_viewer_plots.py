"""Plots, camera and pace of the viewer, without a browser: a live page is neither behind nor without axes."""

import os
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support import runs
from tests.support.browser import connected_pages
from tests.support.commands import PATIENCE_S, wait_for
from tests.support.logs import record_run
from transport.flight.live import LiveRun
from transport.log.run_log import LogTail
from transport.scene.history import RunHistory
from transport.scene.scene import SceneBuilder
from transport.viewer import html
from transport.viewer.plots import Plots
from transport.viewer.viewer import Viewer

NEAR_M = 1e-6
LAST = 29  # tick of a short run
PERIOD_S = 0.05


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a short run."""
    folder = tmp_path_factory.mktemp("plots")
    record_run(runs.setup(runs.SHORT), folder)
    return folder / "run.mcap"


@pytest.fixture
def builder(recorded: Path) -> SceneBuilder:
    """Return its scenes."""
    setup = runs.setup(runs.SHORT)
    history = RunHistory(setup)
    history.add(LogTail(recorded).read())
    return SceneBuilder(setup, history)


def plots(builder: SceneBuilder, tick: int, *, is_live: bool) -> list[Any]:
    """Return the plots at a tick."""
    found: list[Any] = []

    def add_uplot(data: Any, series: Any, **options: Any) -> Any:
        found.append(SimpleNamespace(data=data, series=series, **options))
        return found[-1]

    gui: Any = SimpleNamespace(add_uplot=add_uplot)
    Plots(gui, builder, is_live=is_live).show(tick)
    return found


@pytest.mark.parametrize("tick", [0, 12, LAST])
def test_plots_of_a_recorded_run_show_all_of_it(builder: SceneBuilder, tick: int) -> None:
    """At any instant the faded curves cover the whole run, the strong ones the past, within fixed axes."""
    for plot in plots(builder, tick, is_live=False):
        times_s, *curves = plot.data
        faded, strong = np.split(np.array(curves), 2)
        np.testing.assert_allclose(times_s, PERIOD_S * np.arange(LAST + 1))
        assert plot.scales["x"]["range"] == [0.0, pytest.approx(LAST * PERIOD_S)]
        assert np.isfinite(faded).all()
        np.testing.assert_array_equal(np.isfinite(strong), [times_s <= tick * PERIOD_S] * len(strong))
        low, high = plot.scales["y"]["range"]
        assert low <= faded.min() < faded.max() + NEAR_M <= high + NEAR_M
        assert high < 30.0  # not 100, the axis of no values


@pytest.mark.parametrize("tick", [0, LAST])
def test_plots_of_a_live_run_end_now(builder: SceneBuilder, tick: int) -> None:
    """The time axis is fixed and ends at the shown tick, and no axis depends on a single value."""
    for plot in plots(builder, tick, is_live=True):
        assert plot.scales["x"] == {"time": False, "auto": False, "range": [-30.0, 0.0]}
        assert plot.data[0][-1] == 0.0
        assert plot.data[0][0] == pytest.approx(-tick * PERIOD_S)
        low, high = (plot.scales["y"]["range"][end]["soft"] for end in ("min", "max"))
        assert low < high < 30.0


def test_a_frame_says_how_far_it_is_behind(builder: SceneBuilder) -> None:
    """More than a second behind an active run the panel says so; it says so by itself when no frame comes."""
    scene = builder.at(10)
    assert "296.2 s behind the run, which is at 296.70 s" in html.flight(scene, 900.0, 296.2, watched=True)
    near = html.flight(scene, 900.0, 0.1, watched=False)
    assert "behind" not in near
    assert "no new frame" not in near
    assert "no new frame for 5 s" in html.flight(scene, 900.0, 0.1, watched=True)


@pytest.fixture
def live(builder: SceneBuilder, recorded: Path) -> Iterator[Viewer]:
    """Return the viewer of a run that counts as live."""
    running = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())
    with Viewer(builder, port=0, tail=LogTail(recorded), live=running) as viewer:
        yield viewer


def shown(viewer: Viewer) -> int:
    """Return the tick of the newest frame after an update."""
    viewer.update()
    return -1 if viewer.shown is None else viewer.shown.tick


def test_a_slow_page_skips_frames(live: Viewer) -> None:
    """No frame is sent until the page has told that it shows the last one; then comes the newest, not the next."""
    with connected_pages(live.address, 1) as (page,):
        assert wait_for(lambda: shown(live) == LAST)
        live.playback.seek(3)
        assert shown(live) == LAST
        live.playback.seek(7)
        receipt = b""
        while not receipt:
            data = page.messages()
            receipt = data[data.find(b"/shown/") :].partition(b'"')[0] if b"/shown/" in data else b""
        path = f"{live.address}{receipt.decode()}"
        with urllib.request.urlopen(path, timeout=PATIENCE_S) as answer:  # noqa: S310  # loopback
            assert answer.status == 204
        assert shown(live) == 7


def test_a_hidden_page_is_not_waited_for(live: Viewer) -> None:
    """A page that shows nothing holds no frame back for more than some seconds."""
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        since = time.monotonic()
        live.playback.seek(3)
        assert wait_for(lambda: shown(live) == 3)
        assert time.monotonic() - since > 1.0


def test_the_camera_follows_the_team(live: Viewer, builder: SceneBuilder) -> None:
    """The camera moves with the UAVs and keeps its distance, but not while a user turns it, or when not asked to."""
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        (client,) = live.clients()
        places = []
        for tick in (0, LAST):
            live.view3d.show(builder.at(tick))
            if tick == 0:
                live.view3d.look_at(team=True)
            places.append((client.camera.position - builder.at(tick).uavs_I.mean(axis=0), client.camera.look_at))
        np.testing.assert_allclose(places[0][0], places[1][0], atol=NEAR_M)
        assert np.linalg.norm(places[1][1] - places[0][1]) > 0.1
        with client.atomic():  # as a page that is turned
            client.camera.position, client.camera.look_at = client.camera.position + 1.0, client.camera.look_at
        for tick, stays in ((0, True), (LAST, False)):
            before = client.camera.position.copy()
            live.view3d.show(builder.at(tick))
            assert np.array_equal(client.camera.position, before) is stays
        live.view3d.follow(False)
        before = client.camera.position.copy()
        live.view3d.show(builder.at(0))
        np.testing.assert_array_equal(client.camera.position, before)
