"""Plots, camera and pace of the viewer, without a browser.

A live page is neither behind nor without axes.
"""

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
from transport.viewer.panel import Plots
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


@pytest.mark.parametrize("tick", [0, 12, LAST])
def test_plots_end_at_the_shown_tick(builder: SceneBuilder, tick: int) -> None:
    """The time axis is fixed and ends at the shown tick, and no axis depends on a single value."""
    plots: list[Any] = []

    def add_uplot(data: Any, series: Any, **options: Any) -> Any:
        plots.append(SimpleNamespace(data=data, series=series, **options))
        return plots[-1]

    gui: Any = SimpleNamespace(add_uplot=add_uplot)
    Plots(gui, builder).show(tick)
    assert len(plots) == 4
    for plot in plots:
        assert plot.scales["x"] == {"time": False, "auto": False, "range": [-30.0, 0.0]}
        times_s, *curves = plot.data
        np.testing.assert_allclose(times_s, PERIOD_S * np.arange(-tick, 1), atol=NEAR_M)
        assert len(plot.series) == 1 + len(curves)
        assert np.isfinite(curves).all()
        low, high = (plot.scales["y"]["range"][end]["soft"] for end in ("min", "max"))
        assert low < high < 30.0


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
    """No frame is sent until the page has told that it shows the last one.

    Then comes the newest, not the next.
    """
    with connected_pages(live.address, 1) as (page,):
        assert wait_for(lambda: shown(live) == LAST)
        live.playback.seek(3)
        assert shown(live) == LAST
        live.playback.seek(7)
        receipt = b""
        while not receipt:
            data = page.messages()
            receipt = (
                data[data.find(b"/shown/") :].partition(b'"')[0] if b"/shown/" in data else b""
            )
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
        (client,) = live._server.get_clients().values()
        places = []
        for tick in (0, LAST):
            live.view3d.show(builder.at(tick))
            if tick == 0:
                live.view3d.look_at(team=True)
            places.append(
                (
                    client.camera.position - builder.at(tick).uavs_I.mean(axis=0),
                    client.camera.look_at,
                )
            )
        np.testing.assert_allclose(places[0][0], places[1][0], atol=NEAR_M)
        assert np.linalg.norm(places[1][1] - places[0][1]) > 0.1
        with client.atomic():  # as a page that is turned
            client.camera.position, client.camera.look_at = (
                client.camera.position + 1.0,
                client.camera.look_at,
            )
        for tick, stays in ((0, True), (LAST, False)):
            before = client.camera.position.copy()
            live.view3d.show(builder.at(tick))
            assert np.array_equal(client.camera.position, before) is stays
        live.view3d.look_at(team=False)
        before = client.camera.position.copy()
        live.view3d.show(builder.at(0))
        np.testing.assert_array_equal(client.camera.position, before)
