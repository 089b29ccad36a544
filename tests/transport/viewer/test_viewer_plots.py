"""Plots, camera and pace of the viewer, without a browser.

A live page is neither behind nor without axes.
"""

import gzip
import json
import os
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from tests.support import runs
from tests.support.browser import connected_pages
from tests.support.commands import PATIENCE_S, wait_for
from tests.support.logs import record_run
from transport.flight.active_runs import LiveRun
from transport.log.run_log import LogTail
from transport.protocol.scenario.links.link_changes import PERFECT
from transport.protocol.wire.messages import LinkChange
from transport.scene.history import RunHistory
from transport.scene.lines_meshes_and_labels import Label
from transport.scene.scene_at_tick import SceneBuilder
from transport.scene.uav_and_link_colours import OFF_COLOUR
from transport.viewer import panel_values, server
from transport.viewer.camera import ASPECT, FIELD_OF_VIEW
from transport.viewer.link_controls import ALL_LINKS, LinkControls, groups_of
from transport.viewer.plots import Plots, rounded_range
from transport.viewer.server import Page, Receipts, ViewerError
from transport.viewer.timeline import TimelineEvent, events_around, events_of
from transport.viewer.viewer import Viewer, may_send

NEAR_M = 1e-6
LAST = 29  # tick of a short run
PERIOD_S = 0.05
STAYS = 0.02  # movement in the view of a team that is followed: that of UAVs within the team
PERFECT_VALUES: dict[str, Any] = dict(PERFECT)
RANGE_ROUNDING = 1e-6  # ends are whole multiples of a step of double precision


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


class Gui:
    """Widgets that keep what they are given."""

    def __init__(self) -> None:
        self.plots: list[Any] = []

    def add_uplot(self, data: Any, series: Any, **options: Any) -> Any:
        """Keep a plot."""
        self.plots.append(SimpleNamespace(data=data, series=series, **options))
        return self.plots[-1]


@pytest.mark.parametrize("tick", [0, 12, LAST])
def test_plots_of_an_active_run_end_at_the_shown_tick(builder: SceneBuilder, tick: int) -> None:
    """The time axis is fixed and ends at the shown tick, and no axis depends on a single value."""
    gui = Gui()
    Plots(gui, builder, whole=False).show(tick)
    assert len(gui.plots) == 4
    for plot in gui.plots:
        assert plot.scales["x"] == {"time": False, "auto": False, "range": [-30.0, 0.0]}
        times_s, *curves, line = plot.data
        assert np.isfinite(plot.data).all()
        np.testing.assert_allclose(np.unique(times_s), PERIOD_S * np.arange(-tick, 1), atol=NEAR_M)
        assert len(plot.series) == 2 + len(curves)
        low, high = plot.scales["y"]["range"]
        assert low < high < 30.0
        assert line[0] < low
        assert line[-1] > high


@pytest.mark.parametrize("tick", [0, 12, LAST])
def test_plots_of_a_recorded_run_show_all_of_it(builder: SceneBuilder, tick: int) -> None:
    """Axis and curves hold the whole recorded time, with a line at the shown tick.

    Both axes are named.
    """
    gui = Gui()
    Plots(gui, builder, whole=True).show(tick)
    for plot in gui.plots:
        assert plot.scales["x"]["range"] == [0.0, pytest.approx(LAST * PERIOD_S)]
        times_s, *_, line = plot.data
        np.testing.assert_allclose(np.unique(times_s), PERIOD_S * np.arange(LAST + 1), atol=NEAR_M)
        assert times_s[np.argmax(line > 0.0)] == pytest.approx(tick * PERIOD_S)
        horizontal, vertical = plot.axes
        assert horizontal["label"] == "time (s)"
        assert vertical["label"]


def test_a_dead_agent_uses_no_plan(builder: SceneBuilder) -> None:
    """An agent without a report has no age of a plan: its curve leaves the axis while it is dead."""
    for tick in range(10, 20):
        del builder.history.reports[2, tick]
    gui = Gui()
    Plots(gui, builder, whole=True).show(LAST)
    ages = gui.plots[2]
    times_s, *curves = ages.data
    is_dead = (times_s > 9.5 * PERIOD_S) & (times_s < 19.5 * PERIOD_S)
    assert (curves[1] > ages.scales["y"]["range"][1]).tolist() == is_dead.tolist()
    np.testing.assert_allclose(curves[0][times_s > 0.5 * PERIOD_S], PERIOD_S)  # all plans are fresh


def test_an_axis_fits_its_curves(builder: SceneBuilder) -> None:
    """It grows with them, and shrinks once they need less than 30 % of it."""
    gui = Gui()
    plots = Plots(gui, builder, whole=True)
    ranges = []
    for highest in (5.0, 1.6, 1.4, 4.9):
        plots._set_range(0, np.array([[0.0, highest, np.nan]]))
        ranges.append(gui.plots[0].scales["y"]["range"])
    assert ranges == [[0.0, 5.0], [0.0, 5.0], [0.0, 1.5], [0.0, 5.0]]
    plots._set_range(0, np.array([[-1.0, 2.0]]))
    assert gui.plots[0].scales["y"]["range"] == [-1.0, 2.0]


def test_values_of_a_tick_have_the_units_of_their_axes(builder: SceneBuilder) -> None:
    """Payload error, m; power of ten of the cost; the oldest plan of each agent, s; thrust of each UAV, N."""
    tick = 20
    reports, state = builder.history.reports, builder.history.plant_states[tick]
    reports[2, tick] = structs.replace(reports[2, tick], plan_ages=(1, 3, 2))
    error_m, decade, ages_s, thrusts_N = Plots(Gui(), builder, whole=True)._values(tick)
    scene = builder.at(tick)
    np.testing.assert_allclose(error_m, [scene.error_m])
    np.testing.assert_allclose(10.0**decade, [scene.cost])
    np.testing.assert_allclose(ages_s, [PERIOD_S, 3 * PERIOD_S, PERIOD_S, PERIOD_S])
    np.testing.assert_allclose(thrusts_N, state.u[::4])


def test_a_long_run_is_plotted_at_some_hundred_ticks(builder: SceneBuilder) -> None:
    """At the same ones whatever the last is: multiples of the spacing, as far as recorded; of an active run 30 s."""
    history = SimpleNamespace(first=7, last=1000, plant_states=range(7, 2000))
    some: Any = SimpleNamespace(
        setup=builder.setup, hover_N=builder.hover_N, history=history, at=builder.at
    )
    gui = Gui()
    plots = Plots(gui, some, whole=True)
    assert plots._ticks(50) == [*range(8, 1000, 4), 1000]
    assert gui.plots[0].scales["x"]["range"] == pytest.approx([7 * PERIOD_S, 1000 * PERIOD_S])

    active = Plots(gui, some, whole=False)
    assert active._ticks(900) == [*range(300, 900, 2), 900]
    assert active._ticks(100) == [*range(7, 100), 100]
    active.show_whole()
    assert active._ticks(900) == plots._ticks(50)
    assert gui.plots[-1].axes[0]["label"] == "time (s)"


@given(low=st.floats(-1e6, 1e6), length=st.floats(1e-6, 1e6))
def test_ranges_are_round(low: float, length: float) -> None:
    """A range holds its values, is at most three times as long, and has at most seven steps."""
    high = low + length
    first, last = rounded_range(low, high)
    slack = RANGE_ROUNDING * max(abs(low), abs(high), length)
    assert first <= low + slack
    assert last >= high - slack
    assert last - first <= 3.0 * length + slack


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


def test_a_run_is_viewed_before_its_first_tick(recorded: Path) -> None:
    """The viewer of an active run starts without any message, and shows the first when it comes."""
    setup = runs.setup(runs.SHORT)
    history = RunHistory(setup)
    running = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())
    tail = LogTail(recorded.parent / "none.mcap")
    with (
        Viewer(SceneBuilder(setup, history), port=0, tail=tail, live=running) as viewer,
        connected_pages(viewer.address, 1),
    ):
        assert wait_for(lambda: len(viewer._server.get_clients()) == 1)
        assert shown(viewer) == -1
        # The team is in its initial state until then.
        payload = viewer.view3d._frames["payload"]
        assert payload.visible
        np.testing.assert_allclose(payload.position, viewer.view3d._drawing.start_I, atol=NEAR_M)
        history.add(LogTail(recorded).read())
        assert wait_for(lambda: shown(viewer) == LAST)


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


def frames_sent(pages: Sequence[Page], shows: Mapping[int, float], duration_s: float) -> int:
    """Return how many frames a viewer sends that has one every 0.1 s.

    Pages show a frame after a time, s, by their place; the others show none.
    """
    sent = 0
    sent_s = 0.0
    for now_s in np.arange(0.0, duration_s, 0.1):
        for place, shows_after_s in shows.items():
            if pages[place].unshown and now_s >= sent_s + shows_after_s:
                pages[place].shows_newest(now_s)
        if may_send(pages, float(now_s)):
            sent += 1
            sent_s = float(now_s)
            for page in pages:
                page.send(sent, sent_s)
    return sent


def page() -> Page:
    """Return a page without a connection."""
    return Page(client=None, receipt=None)


def test_what_a_page_cannot_show_is_dropped() -> None:
    """Frames do not gather in the queue of a slow page: it gets ever fewer, at last one in 30 s.

    A page beside it that shows frames at once gets all of them after the first two seconds.
    """
    assert frames_sent([page()], {0: 0.05}, 60.0) == 600
    assert frames_sent([page()], {0: 1.0}, 60.0) == pytest.approx(60, abs=6)
    hidden = page()
    frames_sent([hidden], {}, 60.0)
    assert hidden.unshown <= 5
    assert frames_sent([page(), page()], {0: 0.05}, 60.0) > 570


def test_a_receipt_of_an_older_frame_does_not_count() -> None:
    """A page shows the newest frame once it tells so; other addresses are no receipts."""
    receipts = Receipts()
    receipts.pages[3] = page()
    for frame in (1, 2):
        receipts.pages[3].send(frame, 0.0)
    shown = []
    for path in ("/shown/3/1", "/shown/4/2", "/shown/3/2x", "/shown/3/2"):
        taken = receipts.take(path)
        shown.append((taken, receipts.pages[3].unshown))
    assert shown == [(True, 2), (True, 2), (False, 2), (True, 0)]


def test_the_lag_of_a_page_is_the_time_to_its_receipt() -> None:
    """A receipt that comes twice changes nothing."""
    one = page()
    one.send(1, 2.0)
    for now_s in (2.5, 9.0):
        one.shows_newest(now_s)
        assert one.lag_s == 0.5


def test_an_address_that_cannot_be_used_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that is in use can: viser takes the next free one."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        server._check_address("127.0.0.1", taken.getsockname()[1])
    for host, port in (("192.0.2.1", 0), ("127.0.0.1", 70_000)):
        with pytest.raises(ViewerError, match=f"cannot listen on {host}:{port}"):
            server._check_address(host, port)
    monkeypatch.setattr(server, "find_spec", lambda _: None)
    with pytest.raises(ViewerError, match="viser is not installed"):
        server.require_viser()


def test_only_changes_by_a_browser_are_passed_on() -> None:
    """Those of the program itself would be sent back to it."""
    values: list[int] = []
    for client, value in ((None, 1), (4, 2)):
        event = SimpleNamespace(client_id=client, target=SimpleNamespace(value=value))
        server.from_browser(values.append)(event)
    assert values == [2]


def test_the_viewer_tells_how_far_behind_it_is(live: Viewer) -> None:
    """The age of what is shown of an active run: of the newest entry of its log, and the page's delay."""
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        assert live._tail is not None
        # As while the run goes on: that of the log has ended.
        live._is_over = False
        live.playback.follow(True)
        live._tail.newest_ns = time.time_ns() - 3_000_000_000
        (only,) = live._guard.receipts.pages.values()
        only.lag_s = 0.5
        behind_s = live._behind_s()
        assert behind_s is not None
        assert 3.5 <= behind_s < 3.5 + PATIENCE_S
        scene = live.shown
        assert scene is not None
        assert "3.5 s ago" in panel_values.flight(scene, 10.0, 3.5)
        assert "ago" not in panel_values.flight(scene, 10.0)
        live.playback.seek(3)  # the past is shown as such
        assert live._behind_s() is None


@pytest.mark.parametrize(
    ("outcome", "reason", "text"),
    [("completed", "", "completed"), ("aborted", "by hand", "aborted, by hand")],
)
def test_the_end_of_a_run_closes_its_controls(
    outcome: Any, reason: str, text: str, live: Viewer, builder: SceneBuilder
) -> None:
    """It is told on top, as a warning if it has a reason; playback stays where it is, and nothing is behind."""
    told: list[tuple[str, bool]] = []
    closed: list[bool] = []
    panel: Any = live._panel
    panel.set_notice = lambda words, warning: told.append((words, warning))
    panel.close_controls = lambda: closed.append(True)
    live._tail = None
    builder.history.control = None
    live.update()
    assert (live.shown, live.playback.follows, told) == (None, True, [])  # no page waits for it

    builder.history.control = structs.replace(runs.end(LAST), outcome=outcome, reason=reason)
    for _ in range(2):
        live.update()
    assert told == [(f"the run has ended: {text}", bool(reason))]
    assert (closed, live.playback.follows) == ([True], False)
    assert live.shown is not None
    live.playback.follow(True)
    live._tail = LogTail(Path("none"))
    assert live._behind_s() is None


def test_a_page_that_has_gone_is_not_waited_for(live: Viewer) -> None:
    """Neither its receipt nor its delay counts; nor is a run ahead of the clock behind by less than nothing."""
    client: Any = SimpleNamespace(client_id=3, gui=SimpleNamespace(add_html=lambda _: None))
    live._add_page(client)
    assert list(live._guard.receipts.pages) == [3]
    assert live._tail is not None
    live._tail.newest_ns = time.time_ns() + 10**12
    assert live._behind_s() == 0.0
    live._remove_page(client)
    assert live._guard.receipts.pages == {}


@pytest.mark.parametrize(
    ("is_over", "paced", "pause_s"), [(False, False, 0.5), (False, True, 0.1), (True, False, 0.1)]
)
def test_an_unpaced_run_has_fewer_frames(
    is_over: bool, paced: bool, pause_s: float, live: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It needs the processors itself, until it has ended."""
    pauses_s: list[float] = []
    ends = iter([False, True])
    monkeypatch.setattr(live, "update", lambda: None)
    clock = SimpleNamespace(sleep=pauses_s.append, monotonic=time.monotonic, time=time.time)
    monkeypatch.setattr("transport.viewer.viewer.time", clock)
    live._is_over, live._paced = is_over, paced
    live.show_until(lambda: next(ends))
    assert pauses_s == [pause_s]


def test_the_result_of_a_request_ends(live: Viewer) -> None:
    """The sentence about a request is on top of the panel for some seconds."""
    for refused in (True, False):
        live._show_result("a result", refused)
        assert live._panel._notice.content == panel_values.notice("a result", warning=refused)
    live._show_result("agent 2 killed at tick 8", False)
    ends_s = live._result_ends_s
    live._end_result(ends_s - 0.1)
    assert live.notice == "agent 2 killed at tick 8"
    live._end_result(ends_s)
    assert live.notice == "live"

    live._is_over = True  # the end matters more
    live._set_notice("the run has ended", warning=False)
    live._show_result("agent 2 killed at tick 9", False)
    assert live.notice == "the run has ended"
    live._end_result(np.inf)
    assert live.notice == "the run has ended"


def seen_points(client: Any, position_I: Any) -> Any:
    """Return positions in the view of a page, (k, 2): -1..1 is seen.

    Args:
        client: The page as the server knows it.
        position_I: Positions in the frame of the cameras, (k, 3), m.
    """
    camera = client.camera
    forwards = camera.look_at - camera.position
    depth_m = np.linalg.norm(forwards)
    forwards = forwards / depth_m
    right = np.cross(forwards, camera.up_direction)
    right = right / np.linalg.norm(right)
    upwards = np.cross(right, forwards)
    offset_m = np.asarray(position_I) - camera.position
    slope = np.tan(FIELD_OF_VIEW / 2.0)
    height_m = slope * (offset_m @ forwards)
    return np.column_stack(
        [offset_m @ right / (camera.aspect * height_m), offset_m @ upwards / height_m]
    )


def shown_team(viewer: Viewer) -> Any:
    """Return the positions of payload and UAVs as the cameras see them, (1 + N, 3), m."""
    scene = viewer.shown
    assert scene is not None
    (world,) = (viewer.view3d._world,)
    return np.vstack([scene.payload_I, scene.uavs_I]) + world.position


@pytest.mark.parametrize("team", [True, False])
def test_a_page_shows_the_whole_team(live: Viewer, builder: SceneBuilder, team: bool) -> None:
    """A page sees all UAVs and the payload wherever its first message says that its camera is.

    With `team` the team stays in its place of the view; `whole path` has room for all of its way.
    """
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        (client,) = live._server.get_clients().values()
        live.view3d.look_at(team=team)
        camera_I = client.camera.position.copy()
        places = []
        for tick in (0, 12, LAST):
            live.view3d.show(builder.at(tick))
            places.append(seen_points(client, shown_team(live)))
        assert np.abs(places).max() < 1.0
        np.testing.assert_array_equal(client.camera.position, camera_I)
        moved = np.abs(places[0] - places[-1])[1:].mean()
        assert bool(moved < STAYS) is team


def test_a_diverged_run_leaves_the_view_as_it_is(live: Viewer, builder: SceneBuilder) -> None:
    """What is farther away than the size of the maneuver, or no number, makes nothing else a dot."""
    drawing = live.view3d._drawing
    state = builder.history.plant_states[LAST]
    for far_m in (1e6, np.nan):
        builder._positions.clear()
        builder.history.plant_states[LAST] = structs.replace(state, x=state.x + far_m)
        points_I = live.view3d._path_points()
        assert (points_I <= drawing.high + drawing.size).all()
        assert (points_I >= drawing.low - drawing.size).all()


def test_the_view_holds_what_was_flown_outside_of_the_reference(
    live: Viewer, builder: SceneBuilder
) -> None:
    """Half the size of the maneuver beyond its box; the view of the team has room for its arrows."""
    drawing = live.view3d._drawing
    state = builder.history.plant_states[LAST]
    beyond_m = drawing.high[0] - state.x[0] + drawing.size / 2.0
    builder._positions.clear()
    x = state.x.copy()
    x[0] += beyond_m
    builder.history.plant_states[LAST] = structs.replace(state, x=x)
    points_I = live.view3d._path_points()
    assert points_I[:, 0].max() >= x[0]
    np.testing.assert_allclose(points_I[:, 1:].min(axis=0), drawing.low[1:], atol=0.1)

    live.view3d.shown = None
    anchor_I = live.view3d._anchor_I
    assert live.view3d._team_points()[:, 2].min() == pytest.approx(anchor_I[2] - 1.2, abs=1e-6)


@pytest.mark.parametrize(("size", "aspect"), [((200, 100), 2.0), ((0, 0), ASPECT)])
def test_the_camera_of_a_page_fits_its_window(
    size: tuple[int, int], aspect: float, live: Viewer
) -> None:
    """As far as the page has told its size."""
    camera = SimpleNamespace(image_width=size[0], image_height=size[1])
    live.view3d.place_camera(SimpleNamespace(camera=camera, atomic=nullcontext))
    expected = live.view3d._camera(aspect)
    np.testing.assert_array_equal(camera.position, expected.position_I)
    np.testing.assert_array_equal(camera.look_at, expected.look_at_I)


def test_layers_and_released_uavs_are_hidden(live: Viewer, builder: SceneBuilder) -> None:
    """A layer is shown and hidden as a whole, others stay; the frame of a released UAV has no pose."""
    view = live.view3d
    for is_shown in (False, True):
        view.show_layer("names", is_shown)
        assert {node.visible for node in view._layers["names"]} == {is_shown}
        assert {node.visible for node in view._layers["reference"]} == {True}
    for released in ((2,), ()):
        view.show(replace(builder.at(LAST), released=released))
        assert view._frames["uav2"].visible is not bool(released)
        assert view._frames["uav1"].visible


def test_a_released_uav_needs_no_room(live: Viewer, builder: SceneBuilder) -> None:
    """The view of the team has room for the payload, and for each UAV on its rod with its arrow."""
    assert len(live.view3d._team_points()) == 1 + 2 * 4
    live.view3d.look_at(team=True)
    live.view3d.show(replace(builder.at(LAST), released=(2,)))
    room_I = live.view3d._team_points()
    assert len(room_I) == 1 + 2 * 3
    # Each where it is drawn: the world is moved by the middle of all.
    scene = live.view3d.shown
    assert scene is not None
    bodies_I = np.vstack([scene.payload_I, np.delete(scene.uavs_I, 1, axis=0)])
    np.testing.assert_allclose(room_I[:4], bodies_I + live.view3d._world.position, atol=NEAR_M)


def test_a_page_that_connects_late_shows_the_team(live: Viewer, builder: SceneBuilder) -> None:
    """The camera of a page is set to the view, not shifted from where its first message says."""
    live.view3d.show(builder.at(LAST))
    with connected_pages(live.address, 1) as (_,):
        assert wait_for(lambda: len(live._server.get_clients()) == 1 and shown(live) == LAST)
        (client,) = live._server.get_clients().values()

        def sees_all() -> bool:
            shown(live)
            return bool(np.abs(seen_points(client, shown_team(live))).max() < 1.0)

        assert wait_for(sees_all)


def test_a_user_may_turn_the_camera(live: Viewer, builder: SceneBuilder) -> None:
    """No frame moves the camera of a page, whether it follows the team or not."""
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        (client,) = live._server.get_clients().values()
        with client.atomic():
            client.camera.position = client.camera.position + 1.0
        turned_I = client.camera.position.copy()
        for tick in (0, LAST):
            live.view3d.show(builder.at(tick))
        np.testing.assert_array_equal(client.camera.position, turned_I)


def test_the_slider_has_the_recorded_time(live: Viewer) -> None:
    """The time slider ends at the last recorded instant, 1.45 s of a run of 1.5 s."""
    with connected_pages(live.address, 1):
        assert wait_for(lambda: shown(live) == LAST)
        slider = live._panel._timeline._slider
        assert (slider.min, slider.max) == (0.0, pytest.approx(LAST * PERIOD_S))


def test_a_page_has_the_title_of_its_run(live: Viewer) -> None:
    """The title of the tab names scenario and state, packed or not."""
    for encoding in ("identity", "gzip"):
        request = urllib.request.Request(  # noqa: S310  # loopback
            live.address, headers={"Accept-Encoding": encoding}
        )
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:  # noqa: S310
            body = answer.read()
        text = (gzip.decompress(body) if encoding == "gzip" else body).decode()
        assert "<title>paper, active run</title>" in text


def test_events_are_on_the_slider_and_lead_to_their_time(recorded: Path) -> None:
    """Scripted changes of links and changes of the roster are events.

    Each is a mark of the slider and a button that shows its tick.
    """
    setup = runs.setup(runs.SHORT, "links.change=[{at_s=0.5,delay_s=0.1}]")
    history = RunHistory(setup)
    history.add(LogTail(recorded).read())
    assert events_of(history) == [TimelineEvent(10, "links between agents: delay_s 0.1")]
    with Viewer(SceneBuilder(setup, history), port=0, notice="it is cut") as viewer:
        assert viewer._panel._notice.content == panel_values.notice("it is cut", warning=True)
        assert "recorded run" in viewer._guard._title.decode()
        assert shown(viewer) == 0
        timeline = viewer._panel._timeline
        assert [mark.value for mark in timeline._slider._marks] == [pytest.approx(0.5)]
        assert [button.label for button in timeline._buttons if button.visible] == [
            "0.50 s: links between agents: delay_s 0.1"
        ]
        timeline._go_to(0, None)
        assert shown(viewer) == 10


def test_links_that_change_together_are_one_event(builder: SceneBuilder) -> None:
    """A cut between groups is one event; changes at other ticks or to other values are their own."""
    pairs = [("agent1", "agent3"), ("agent3", "agent1")]
    for number, (source, target) in enumerate(pairs, start=1):
        builder.history.add([change(number, 5, source, target, loss=1.0)])
    builder.history.add([change(3, 6, "agent1", "agent3", loss=0.0)])
    assert events_of(builder.history) == [
        TimelineEvent(5, "2 links: loss 1.0"),
        TimelineEvent(6, "links from agent1 to agent3: loss 0.0"),
    ]


def test_events_around_a_tick() -> None:
    """The list holds as many events as it has room for, half of them before the shown instant."""
    events = [TimelineEvent(tick, str(tick)) for tick in range(0, 100, 10)]
    assert [event.tick for event in events_around(events, 50, 4)] == [40, 50, 60, 70]
    assert [event.tick for event in events_around(events, 0, 4)] == [0, 10, 20, 30]
    assert [event.tick for event in events_around(events, 1000, 4)] == [60, 70, 80, 90]
    assert events_around([], 5, 4) == []


def change(number: int, tick: int, source: str, target: str, **settings: Any) -> LinkChange:
    """Return a change of links by the coordinator."""
    return LinkChange(
        sender="coordinator", incarnation=0, sequence=number, tick=tick, number=number,
        source=source, target=target, settings=json.dumps(settings),
    )  # fmt: skip


def test_sliders_of_links_show_the_values_in_force(live: Viewer, builder: SceneBuilder) -> None:
    """Sliders move to the new values after every change, of this page or of another client.

    So they do when another link is chosen, and when all links are cleared.
    """
    links = live._panel._links
    assert links is not None

    def values() -> tuple[float, int]:
        links.show()
        return links._delay.value, links._loss.value

    assert values() == (0.0, 0)
    builder.history.add([change(1, 5, "", "", delay_s=0.3, loss=0.2)])
    assert values() == (0.3, 20)
    builder.history.add([change(2, 6, "agent1", "agent2", loss=1.0)])
    assert values() == (0.3, 20)
    links._chosen.value = "1 to 2"
    links._show_values()
    assert values() == (0.3, 100)
    assert "12 of 12 links impaired; cut: 1 to 2" in links._state.content
    builder.history.add([change(3, 7, "", "", **PERFECT_VALUES)])
    assert values() == (0.0, 0)


class Widget:
    """A widget that keeps its value and calls what a user's action is to call."""

    def __init__(self, value: Any = None) -> None:
        self.value = self.content = value
        self.said: list[tuple[str, str]] = []
        self._acts: Callable[[Any], None] = lambda _: None

    def __enter__(self) -> "Widget":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def on_click(self, acts: Callable[[Any], None]) -> None:
        """Keep what a click is to do."""
        self._acts = acts

    on_update = on_click

    def act(self, value: Any = None) -> None:
        """Set the value as a user does, or click."""
        self.value = value
        client = SimpleNamespace(add_notification=self._notified)
        self._acts(SimpleNamespace(client=client))

    def _notified(self, *text: str, auto_close_seconds: float) -> None:
        """Note a notification, which has to end."""
        assert auto_close_seconds > 0.0
        title, body = text
        self.said.append((title, body))


class LinkGui:
    """Widgets of links, by label."""

    def __init__(self) -> None:
        self.widgets: dict[str, Widget] = {}

    def _add(self, label: str, value: Any = None) -> Widget:
        self.widgets[label] = Widget(value)
        return self.widgets[label]

    def add_folder(self, label: str, **_: Any) -> Widget:
        """Add a folder."""
        return self._add(label)

    def add_dropdown(self, label: str, options: Sequence[str]) -> Widget:
        """Add a list whose first option is chosen."""
        return self._add(label, options[0])

    def add_slider(self, label: str, low: float, high: float, step: float, value: float) -> Widget:
        """Add a slider, which has a value from the first."""
        assert low <= value <= high
        assert step > 0.0
        return self._add(label, value)

    def add_button(self, label: str) -> Widget:
        """Add a button."""
        return self._add(label)

    def add_text(self, label: str, value: str, **_: Any) -> Widget:
        """Add a line of text."""
        return self._add(label, value)

    def add_html(self, text: str) -> Widget:
        """Add a text."""
        return self._add("", text)


class Requested:
    """Requests of a page, in place of those to a live run."""

    def __init__(self) -> None:
        self.sent: list[tuple[Any, ...]] = []

    def link(self, ends: tuple[int, int] | None, settings: Mapping[str, Any]) -> None:
        """Keep a change of links."""
        self.sent.append(("link", ends, settings))

    def cut(self, groups: Sequence[Sequence[int]]) -> None:
        """Keep a cut between groups."""
        self.sent.append(("cut", groups))

    def clear(self) -> None:
        """Keep that all links are cleared."""
        self.sent.append(("clear",))


@pytest.fixture
def links_of_page(builder: SceneBuilder) -> tuple[LinkControls, dict[str, Widget], list[Any]]:
    """Return the controls of links, their widgets, and what they request."""
    gui, requested = LinkGui(), Requested()
    commands: Any = requested
    return LinkControls(gui, builder.history, commands), gui.widgets, requested.sent


def test_buttons_of_links_request_what_the_widgets_show(
    links_of_page: tuple[LinkControls, dict[str, Widget], list[Any]],
) -> None:
    """A slider in per cent sets a loss from 0 to 1, of one link or of all."""
    _, widgets, sent = links_of_page
    for chosen, ends in ((ALL_LINKS, None), ("2 to 1", (2, 1))):
        widgets["link"].act(chosen)
        widgets["delay (s)"].value = 0.25
        widgets["loss (%)"].value = 20
        widgets["Set"].act()
        assert sent.pop() == ("link", ends, {"delay_s": 0.25, "loss": pytest.approx(0.2)})

    cut, groups = widgets["Cut between groups"], widgets["groups"]
    cut.act()
    assert sent.pop() == ("cut", [[1, 2], [3, 4]])
    groups.value = "1 | 3"
    cut.act()
    assert sent.pop() == ("cut", [[1], [3], [2, 4]])
    widgets["Clear all links"].act()
    assert sent.pop() == ("clear",)

    groups.value = "9"
    cut.act()
    ((title, text),) = cut.said
    assert title == "Links"
    assert text.startswith("groups: expected")
    assert sent == []


def test_a_delay_beyond_the_slider_is_shown_at_its_end(
    builder: SceneBuilder, links_of_page: tuple[LinkControls, dict[str, Widget], list[Any]]
) -> None:
    """By a script or another client a delay may exceed what the slider holds, 1 s."""
    links, widgets, _ = links_of_page
    for number, (delay_s, seen_s) in enumerate(((3.0, 1.0), (0.4, 0.4)), start=1):
        builder.history.add([change(number, 4 + number, "", "", delay_s=delay_s)])
        links.show()
        assert widgets["delay (s)"].value == seen_s


@pytest.mark.parametrize(
    ("text", "groups"),
    [
        ("1, 2", [[1, 2], [3, 4]]),
        ("1 2 | 3", [[1, 2], [3], [4]]),
        ("1|2|3|4", [[1], [2], [3], [4]]),
        ("1,2/3", [[1, 2], [3], [4]]),
        ("2", [[2], [1, 3, 4]]),
    ],
)
def test_groups_of_agents(text: str, groups: list[list[int]]) -> None:
    """Groups are numbers between bars or slashes; agents that are not named are a further group."""
    assert groups_of(text, [1, 2, 3, 4]) == groups


@pytest.mark.parametrize("text", ["", "1, 2, 3, 4", "1, 1", "5", "a", "1 | 2 | 2"])
def test_other_groups_are_refused(text: str) -> None:
    """One group, unknown agents, and an agent in two groups are refused with what was expected."""
    with pytest.raises(ValueError, match="groups: expected"):
        groups_of(text, [1, 2, 3, 4])


def test_dead_agents_are_drawn_as_off(live: Viewer, builder: SceneBuilder) -> None:
    """The UAV of an agent off the roster is grey and named off; back on it, it is as before."""
    scene = builder.at(LAST)
    view = live.view3d
    view.show(scene)
    looks = []
    for members in ({1, 3, 4}, {1, 2, 3, 4}):
        view.show(replace(scene, members=frozenset(members)))
        nodes = view._parts["uav2"]
        looks.append([node.text if isinstance(part, Label) else node.color for node, part in nodes])
    assert "UAV2 off" in looks[0]
    assert OFF_COLOUR in looks[0]
    assert "UAV2" in looks[1]
    assert OFF_COLOUR not in looks[1]


def test_lines_have_the_linear_colours_that_viser_draws(
    live: Viewer, builder: SceneBuilder
) -> None:
    """Those of the reference, grey 150 of 255 on the screen: 255 (150 / 255)^2.2 = 79; none are black."""
    live.view3d.show(builder.at(LAST))
    reference = live.view3d._lines["/world/inertial/reference of payload"]
    assert set(reference.colors.ravel().tolist()) == {79}
    actual = live.view3d._lines["/world/inertial/actual paths"]
    assert actual.colors[0].tolist() == [[0, 0, 0]] * 2
    assert actual.points.shape == actual.colors.shape


def test_only_sliders_that_were_moved_are_sent() -> None:
    """A slider that cannot show the value in force leaves it as it is, unless it is moved."""
    setup = runs.setup(runs.SHORT, "links.delay_s=2.0", "links.loss=0.004")
    gui, requested, history = LinkGui(), Requested(), RunHistory(setup)
    commands: Any = requested
    controls = LinkControls(gui, history, commands)
    delay, loss, button = (gui.widgets[label] for label in ("delay (s)", "loss (%)", "Set"))
    assert (delay.value, loss.value) == (1.0, 0)
    button.act()
    assert button.said == [("Links", "no slider has been moved")]
    assert requested.sent == []

    loss.value = 50
    button.act()
    assert requested.sent.pop() == ("link", None, {"loss": 0.5})

    history.add([change(1, 5, "", "", loss=0.5)])
    controls.show()
    delay.value = 0.3
    button.act()
    assert requested.sent.pop() == ("link", None, {"delay_s": 0.3})


def test_a_change_of_all_links_is_one_event(builder: SceneBuilder) -> None:
    """So it is when they are cleared, those of the plant included; other changes are their own."""
    for number, (source, target) in enumerate([("", ""), ("plant", ""), ("", "plant")], start=1):
        builder.history.add([change(number, 5, source, target, **PERFECT_VALUES)])
    builder.history.add([change(4, 6, "plant", "", loss=0.1), change(5, 6, "", "plant", loss=0.1)])
    assert events_of(builder.history) == [
        TimelineEvent(5, "all links cleared"),
        TimelineEvent(6, "links from plant: loss 0.1"),
        TimelineEvent(6, "links to plant: loss 0.1"),
    ]
