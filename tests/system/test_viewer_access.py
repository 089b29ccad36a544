"""Access to the viewer.

Only its own page can change a live run; connections of other sites are refused.
"""

import http.client
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgpack
import pytest
from websockets.exceptions import InvalidStatus

from tests.support import runs
from tests.support.browser import Page, connected_pages, unpacked
from tests.support.commands import PATIENCE_S, wait_for
from tests.support.logs import record_run
from transport.flight.active_runs import LiveRun
from transport.log.run_log import LogTail
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import SceneBuilder
from transport.viewer.viewer import Viewer

Sent = list[tuple[str, dict[str, Any]]]


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Sent:
    """Return the requests to the run, which are not sent."""
    requests: Sent = []

    def request(
        _run: str, _to: list[str], _name: str, kind: str, content: dict[str, Any], _keys: object
    ) -> Any:
        requests.append((kind, content))
        return {"tick": 0}

    monkeypatch.setattr("transport.flight.active_runs.request", request)
    return requests


@pytest.fixture(params=["127.0.0.1", "localhost"])
def live(request: pytest.FixtureRequest, tmp_path: Path, sent: Sent) -> Iterator[Viewer]:
    """Return the viewer of a run that counts as live."""
    setup = runs.setup(runs.ticks(2))
    record_run(setup, tmp_path)
    running = LiveRun(run="nowhere", endpoints={"recorder": "", "coordinator": ""}, pid=os.getpid())
    builder = SceneBuilder(setup, RunHistory(setup))
    with Viewer(
        builder, host=request.param, port=0, tail=LogTail(tmp_path / "run.mcap"), live=running
    ) as viewer:
        yield viewer
    del sent


def kill_agent_2(page: Page) -> None:
    """Press the button as a page does that knows the widgets from its first messages."""
    page.send(update(page, "GuiButtonGroupMessage", "agent 2", {"value": "kill"}))


def update(page: Page, kind: str, label: str, updates: Any) -> bytes:
    """Return the message of a page that changes properties of a widget."""
    data = unpacked(page.first)
    while not (
        found := [
            m["uuid"] for m in messages(data) if m["type"] == kind and m["props"]["label"] == label
        ]
    ):
        data = page.messages()
    message: bytes = msgpack.packb(
        {"type": "GuiUpdateMessage", "uuid": found[0], "updates": updates}
    )
    return message


def messages(data: bytes) -> list[Any]:
    """Return the messages in a frame of viser."""
    found: list[Any] = msgpack.unpackb(data)["messages"]
    return found


def test_the_printed_link_can_change_the_run(live: Viewer, sent: Sent) -> None:
    """A WebSocket below the printed link kills an agent."""
    with connected_pages(live.address, 1) as (page,):
        kill_agent_2(page)
        assert wait_for(lambda: sent == [("fault", {"do": "kill", "target": "agent2"})])


@pytest.mark.parametrize("way", ["", "/wrong"])
def test_others_cannot_change_the_run(live: Viewer, sent: Sent, way: str) -> None:
    """Without the token page and WebSocket are refused with 403."""
    parts = urlsplit(live.address)
    address = f"{parts.scheme}://{parts.netloc}{way}"
    with pytest.raises(InvalidStatus, match="403"), connected_pages(address, 1) as (page,):
        kill_agent_2(page)
    asked = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=PATIENCE_S)
    asked.request("GET", way or "/")
    assert asked.getresponse().status == 403
    assert sent == []


def test_a_malformed_message_ends_its_page_alone(live: Viewer, sent: Sent) -> None:
    """After messages that no page sends the viewer goes on for the others."""
    bad: list[Any] = [
        "text",
        b"\xc1",
        b"",
        msgpack.packb({"type": "NoMessage"}),
        msgpack.packb([1]),
    ]
    for message in bad:
        with connected_pages(live.address, 1) as (page,):
            page.send(message)
    for kind, label, updates in (
        ("GuiDropdownMessage", "link", {"value": "no link"}),
        ("GuiSliderMessage", "delay (s)", {"value": "no number"}),
        ("GuiSliderMessage", "time (s)", {"value": float("inf")}),
        ("GuiSliderMessage", "time (s)", {"no property": 1}),
    ):
        with connected_pages(live.address, 1) as (page,):
            page.send(update(page, kind, label, updates))
    with connected_pages(live.address, 1) as (page,):
        kill_agent_2(page)
        assert wait_for(lambda: len(sent) == 1)
