"""The file of an active run: what was written is read; any other content is ignored."""

import os
import queue
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import transport
from tests.support.commands import wait_for
from transport.flight import active_runs
from transport.flight.active_runs import LiveRun
from transport.interface.setting_arguments import ArgumentError
from transport.protocol.scenario.links.link_changes import PERFECT
from transport.protocol.wire.errors_and_exit_codes import TransportError

HERE = LiveRun(
    "hover", {"coordinator": "tcp/127.0.0.1:7447", "agent1": "tcp/127.0.0.1:7448"}, os.getpid()
)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """A run is active from `write` to `remove`."""
    folder = tmp_path / "run"
    folder.mkdir()
    active_runs.write(folder, HERE)
    assert active_runs.read(folder) == HERE
    assert active_runs.newest_folder(tmp_path) == folder
    active_runs.remove(folder)
    active_runs.remove(folder)
    assert active_runs.read(folder) is None
    assert active_runs.newest_folder(tmp_path) is None
    assert list(folder.iterdir()) == []


def test_the_file_of_a_killed_run_is_ignored(tmp_path: Path) -> None:
    """A run whose process is gone is not active."""
    ended = subprocess.Popen(["true"])
    ended.wait()
    active_runs.write(tmp_path, LiveRun(HERE.run, HERE.endpoints, ended.pid))
    assert active_runs.read(tmp_path) is None


def test_a_process_that_nobody_has_waited_for_has_ended(tmp_path: Path) -> None:
    """It still has its id and an entry in the table of processes."""
    ended = subprocess.Popen(["true"])
    active_runs.write(tmp_path, LiveRun(HERE.run, HERE.endpoints, ended.pid))
    assert wait_for(lambda: psutil.Process(ended.pid).status() == psutil.STATUS_ZOMBIE)
    assert active_runs.read(tmp_path) is None
    ended.wait()


def test_the_newest_run_below_a_folder_goes_before_those_elsewhere(tmp_path: Path) -> None:
    """Links to runs are not runs of their own; without one below it is the newest of this user."""
    began_s = {"runs/old": 1e9, "runs/new": 2e9, "elsewhere/run": 3e9}
    for name, at_s in began_s.items():
        folder = tmp_path / name
        folder.mkdir(parents=True)
        active_runs.write(folder, HERE)
        os.utime(folder / "live.json", (at_s, at_s))
    parent = tmp_path / "runs"
    (parent / "latest").symlink_to("new")
    (parent / "foreign").symlink_to(tmp_path / "elsewhere" / "run")
    assert active_runs.newest_folder(parent) == parent / "new"

    for name in ("old", "new"):
        active_runs.remove(parent / name)
    assert active_runs.newest_folder(parent) == tmp_path / "elsewhere" / "run"


def test_a_process_is_asked_at_its_own_endpoint_with_the_keys_of_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Keys that are given go before those; a run without keys has none."""
    asked: list[tuple[Any, ...]] = []

    def request(*given: Any) -> dict[str, Any]:
        asked.append(given)
        return {}

    monkeypatch.setattr(active_runs, "request", request)
    keyed = LiveRun(HERE.run, HERE.endpoints, HERE.pid, "/own")
    keyed.ask("agent1", "health", {})
    keyed.ask("coordinator", "status", {}, Path("given"))
    HERE.ask("agent1", "health", {})
    agent1, coordinator = (HERE.endpoints[name] for name in ("agent1", "coordinator"))
    assert asked == [
        ("hover", [agent1], "agent1", "health", {}, Path("/own")),
        ("hover", [coordinator], "coordinator", "status", {}, Path("given")),
        ("hover", [agent1], "agent1", "health", {}, None),
    ]


def test_a_run_that_has_ended_says_so(tmp_path: Path) -> None:
    """Requests to it name the run, not the keys that went with it, also where a new run has its folder."""
    run = LiveRun(HERE.run, HERE.endpoints, HERE.pid, str(tmp_path / "keys"))
    active_runs.write(tmp_path, run)
    active = transport.active(tmp_path)
    active_runs.remove(tmp_path)
    for _ in range(2):
        requests: tuple[Callable[[], object], ...] = (
            lambda: active.target(0.0, 0.0, -10.0),
            lambda: active.path([[0.0, 0.0, -10.0]]),
            active.land,
        )
        for request in requests:
            with pytest.raises(TransportError, match=f"the run in {tmp_path} has ended"):
                request()
        active_runs.write(tmp_path, LiveRun("another", HERE.endpoints, HERE.pid))

    ended = subprocess.Popen(["true"])
    ended.wait()
    dead = LiveRun(HERE.run, HERE.endpoints, ended.pid, str(tmp_path / "keys"))
    with pytest.raises(TransportError, match="run hover has ended"):
        dead.ask("coordinator", "target", {})


def test_an_active_run_is_asked_for_what_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each request reaches the coordinator with the keys of docs/reference/protocol.md, no others."""
    asked: list[tuple[str, str, Mapping[str, Any]]] = []

    def ask(_: LiveRun, name: str, what: str, given: Mapping[str, Any]) -> dict[str, Any]:
        asked.append((name, what, given))
        return {"tick": 7}

    monkeypatch.setattr(LiveRun, "ask", ask)
    active_runs.write(tmp_path, HERE)
    active = transport.active(tmp_path)
    timed, untimed = tmp_path / "timed.csv", tmp_path / "untimed.csv"
    timed.write_text("t,x,y,z\n0,1,2,-3\n4,5,6,-7\n", encoding="ascii")
    untimed.write_text("x,y,z\n1,2,-3\n", encoding="ascii")

    assert active.target(1.0, 2.0, -3.0) == {"tick": 7}
    active.target(1.0, 2.0, -3.0, speed=0.5, to=[2, 3])
    array: Any = np.array([[1.0, 2.0, -3.0], [4.0, 5.0, -6.0]])
    active.path(array, times=[0.0, 2.5])
    active.path(timed, to=(1,))
    active.path(str(untimed), speed=2.0)
    active.land()
    active.land(3.0, 4.0, speed=0.25)
    for place in ({"x": 3.0}, {"y": 4.0}):
        with pytest.raises(ArgumentError, match="x, y: expected both or none"):
            active.land(**place)

    assert asked == [
        ("coordinator", "target", given)
        for given in (
            {"points_m": [[1.0, 2.0, -3.0]]},
            {"points_m": [[1.0, 2.0, -3.0]], "speed_mps": 0.5, "to": [2, 3]},
            {"points_m": [[1.0, 2.0, -3.0], [4.0, 5.0, -6.0]], "times_s": [0.0, 2.5]},
            {"points_m": [[1.0, 2.0, -3.0], [5.0, 6.0, -7.0]], "times_s": [0.0, 4.0], "to": [1]},
            {"points_m": [[1.0, 2.0, -3.0]], "speed_mps": 2.0},
            {"land": True},
            {"land": True, "land_at_m": [3.0, 4.0], "speed_mps": 0.25},
        )
    ]


@pytest.mark.parametrize(
    ("command", "request_", "answer", "result"),
    [
        (
            lambda to: to.link((1, 3), {"loss": 0.5}),
            ("coordinator", "link", {"from": "agent1", "to": "agent3", "settings": {"loss": 0.5}}),
            {"tick": 7},
            "links change: at tick 7",
        ),
        (
            lambda to: to.link(None, {"delay_s": 0.1}),
            ("coordinator", "link", {"from": "", "to": "", "settings": {"delay_s": 0.1}}),
            {"tick": 7},
            "links change: at tick 7",
        ),
        (
            lambda to: to.cut([[1, 2], [3]]),
            (
                "coordinator",
                "link",
                {"groups": [["agent1", "agent2"], ["agent3"]], "settings": {"loss": 1.0}},
            ),
            {"tick": 7},
            "links change: at tick 7",
        ),
        (
            lambda to: to.clear(),
            ("coordinator", "link", {"all": True, "settings": PERFECT}),
            {"tick": 7},
            "links change: at tick 7",
        ),
        (
            lambda to: to.target(np.array([1.0, 2.0, -3.0]), (2,)),
            ("coordinator", "target", {"points_m": [[1.0, 2.0, -3.0]], "to": [2]}),
            {"point_m": [1.0, 2.0, -3.0], "t_s": 4.0, "ends_s": 9.5},
            "target (1, 2, -3) m, told to agent2: arrives at t = 9.5 s, in 5.5 s",
        ),
        (
            lambda to: to.land(),
            ("coordinator", "target", {"land": True}),
            {"point_m": [1.0, 2.0, 0.0], "t_s": 4.0, "ends_s": 9.5},
            "landing (1, 2, 0) m: arrives at t = 9.5 s, in 5.5 s",
        ),
        (
            lambda to: to.fault("kill", "agent2"),
            ("recorder", "fault", {"do": "kill", "target": "agent2"}),
            {"tick": 7},
            "kill agent2: at tick 7",
        ),
        (
            lambda to: to.land(),
            ("coordinator", "target", {"land": True}),
            TransportError("too late"),
            "too late",
        ),
    ],
)
def test_commands_of_a_page_are_requests_whose_results_are_told(
    command: Callable[[active_runs.Commands], None],
    request_: tuple[str, str, Any],
    answer: Mapping[str, Any] | TransportError,
    result: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sentence about each, marked where the request is refused; without agents a target is told to all."""
    asked: list[tuple[str, str, Any]] = []
    told: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()

    def ask(_: LiveRun, *given: Any) -> Mapping[str, Any]:
        asked.append(given)
        if isinstance(answer, TransportError):
            raise answer
        return answer

    monkeypatch.setattr(LiveRun, "ask", ask)
    command(active_runs.Commands(HERE, lambda *given: told.put(given)))
    assert told.get(timeout=20.0) == (result, isinstance(answer, TransportError))
    assert asked == [request_]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"run": 5}',
        *(
            b'{"run": "hover", "endpoints": {}, "pid": %s}' % pid
            for pid in (b'"x"', b"2147483648", b"1e30", b"0", b"-1", b"99999999999999999999999")
        ),
    ],
)
def test_other_content_is_ignored(content: bytes, tmp_path: Path) -> None:
    """A file that does not describe a run is none of an active run."""
    (tmp_path / "live.json").write_bytes(content)
    assert active_runs.read(tmp_path) is None


def test_a_folder_that_vanishes_is_no_active_run(tmp_path: Path) -> None:
    """A folder that is removed while active runs are looked for is passed over."""
    for name in ("kept", "vanishing"):
        (tmp_path / name).mkdir()
        active_runs.write(tmp_path / name, HERE)

    class Vanishing(type(tmp_path)):  # type: ignore[misc]
        """Path whose folder named "vanishing" is gone once its file has been read."""

        def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
            if self.parent.name == "vanishing" and self.name == "live.json":
                raise FileNotFoundError(2, "No such file or directory", str(self))
            return super().stat(follow_symlinks=follow_symlinks)  # type: ignore[no-any-return]

        def exists(self) -> bool:
            return True

    newest = active_runs.newest_folder(Vanishing(tmp_path))
    assert newest is not None
    assert newest.name == "kept"
