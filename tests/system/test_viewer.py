"""The viewer in a browser: a recorded run, a log that was cut, a run in flight that is changed; what is refused."""

import json
import math
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgpack
import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.sync.client import ClientConnection, connect

from benchmarks import readers
from protocol.scenario.file import read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.messages import FaultNote, LinkChange, Message, Plan, PlantState
from tests.support import runs
from tests.support.browser import END, RIGHT, Browser, browser, needs_browser
from tests.support.commands import PATIENCE_S, processes_of, settings, start, wait_for
from tests.support.logs import flown
from transport.cli.main import app
from transport.cli.view import viewer_of
from transport.flight.live import LiveRun
from transport.flight.memory import simulate
from transport.log.run_folder import setup_of
from transport.log.run_log import read_log
from transport.log.tail import LogTail, Unread
from transport.scene.record import Record
from transport.scene.scene import Scenes
from transport.viewer import viewer as viewer_module
from transport.viewer.clock import Clock
from transport.viewer.pace import pace
from transport.viewer.viewer import IdleProcessors, Spare, Viewer, pause_s

M = TypeVar("M", bound=Message)

# A climb of half a metre is seen.
SEEN_M = 0.2
PIXELS = 0.002  # share of those that change when the team moves
CUT = 0.6
INTERRUPTED = 130
OTHER_LOOPBACK = "127.0.0.2"  # also this host, but not where the viewer listens
# The first seconds pass while the browser opens; the test ends it.
LONG = (
    "maneuver.phase=[{name='hover',duration_s=8.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=300.0,displacement_m=[0,0,-20.0]}]"
)
DELAY_STEPS = 10  # of 10 ms
HOUR_S = 3600.0
SOON_S = 10.0  # well before a minute is over
AGENTS, VICTIM = 4, 2
WANTED = {"delay_s": 0.1, "loss": 0.0}


@contextmanager
def shown(folder: Path) -> Iterator[Viewer]:
    """A viewer that works as the command does."""
    stop = threading.Event()
    with viewer_of(folder, "127.0.0.1", 0) as viewer:
        thread = threading.Thread(target=viewer.show_until, args=(stop.is_set,))
        thread.start()
        try:
            yield viewer
        finally:
            stop.set()
            thread.join()


@contextmanager
def spectators(address: str, count: int) -> Iterator[list[ClientConnection]]:
    """As many more that look on as browsers do, who are gone without a word afterwards."""
    connections: list[ClientConnection] = []
    with ExitStack() as stack:
        for _ in range(count):
            connection = connect(**readers.target(address))
            stack.callback(connection.socket.close)
            connection.send(readers.CAMERA)
            assert connection.recv(timeout=PATIENCE_S)
            connections.append(connection)
        yield connections


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short flight."""
    folder = tmp_path_factory.mktemp("recorded")
    flown(runs.setup(runs.SHORT), folder)
    return folder


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    """A browser."""
    with browser() as opened:
        yield opened


def pictures() -> Path | None:
    """Where people want the pictures of these tests, if they do."""
    wanted = os.environ.get("VIEWER_PICTURES")
    return Path(wanted) if wanted else None


@needs_browser
def test_a_recorded_run_is_shown(recorded: Path, window: Browser) -> None:
    """The slider moves the payload, in the scene and in pixels; nobody complains, and nobody but this host is asked."""
    with shown(recorded) as viewer:
        window.open(viewer.address)
        assert wait_for(lambda: "hover" in (window.label() or ""))
        before, pixels = viewer.stage.payload_I, window.pixels(pictures(), "recorded-begin")
        window.press(1.5, END)
        assert wait_for(lambda: viewer.shown is not None and viewer.shown.tick == 29)
        assert wait_for(lambda: "climb" in (window.label() or ""))
        assert np.linalg.norm(viewer.stage.payload_I - before) > SEEN_M
        changed = np.abs(window.pixels(pictures(), "recorded-end") - pixels).max(axis=2) > 0.1
        assert changed.mean() > PIXELS
        assert window.hosts() == {"127.0.0.1"}
        assert window.complaints() == []


@needs_browser
def test_a_page_draws_when_it_may(recorded: Path, window: Browser) -> None:
    """Pictures are held back for as long as the viewer says, but not from who has just opened it or presses a key."""
    window.leave()
    for gap_s in (0.0, HOUR_S):
        window.put(pace(gap_s))
        assert wait_for(lambda: window.drawn() > 5)  # it has just been opened
    assert wait_for(lambda: stands(window))
    before = window.drawn()
    window.driver.find_element("css selector", "body").send_keys(RIGHT)
    assert wait_for(lambda: window.drawn() > before)
    assert wait_for(lambda: stands(window))
    before = window.drawn()
    window.put(pace(0.0))
    assert wait_for(lambda: window.drawn() > before + 5)
    with shown(recorded) as viewer:
        window.open(viewer.address)
        assert wait_for(lambda: window.driver.execute_script("return typeof window.setPace") == "function")
        assert window.complaints() == []


def stands(window: Browser) -> bool:
    """Whether a page has drawn nothing for half a second."""
    before = window.drawn()
    time.sleep(0.5)
    return window.drawn() == before


def test_a_cut_log_is_shown(recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Of a log cut at 60 % the viewer shows what there is, and says there and in the terminal what is lost."""
    data = (recorded / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: round(CUT * len(data))])
    (tmp_path / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    lost = read_log(tmp_path / "run.mcap").cut
    assert "it stops before its end" in lost
    with shown(tmp_path) as viewer:
        assert lost in viewer.notice
        assert lost in capfd.readouterr().err
        viewer.clock.seek(29)
        assert wait_for(lambda: viewer.shown is not None and 5 < viewer.shown.tick < 29)


def test_nothing_is_drawn_of_a_flight_while_nobody_looks(recorded: Path, tmp_path: Path) -> None:
    """Whoever comes is shown the newest there is; that the run has ended is seen in any case."""
    data, log = (recorded / "run.mcap").read_bytes(), tmp_path / "run.mcap"
    log.write_bytes(data[: round(CUT * len(data))])
    scenes = Scenes(setup_of(recorded), Record(setup_of(recorded)))
    flying = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())

    def seen() -> bool:
        viewer.work()
        return viewer.shown is not None

    with Viewer(scenes, port=0, tail=LogTail(log), live=flying) as viewer:
        assert not seen()
        assert scenes.record.last > 0
        with spectators(viewer.address, 1):
            assert wait_for(seen)
            assert viewer.shown is not None
            assert viewer.shown.tick == scenes.record.last < 29
        with log.open("ab") as growing:
            growing.write(data[round(CUT * len(data)) :])
        viewer.work()
        assert viewer.notice.startswith("the run has ended: ")
        assert viewer.shown.tick == 29


def test_a_flight_that_takes_all_is_drawn_for_who_turns_the_camera(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no processor is idle, a page left alone waits a minute for the next picture; who comes, does not."""
    monkeypatch.setattr(IdleProcessors, "count", lambda self: 0.0)
    data, log = (recorded / "run.mcap").read_bytes(), tmp_path / "run.mcap"
    log.write_bytes(data[: round(0.4 * len(data))])
    scenes = Scenes(setup_of(recorded), Record(setup_of(recorded)))
    flying = LiveRun(run="nowhere", endpoints={}, pid=os.getpid())

    def newest() -> bool:
        viewer.work()
        return viewer.shown is not None and viewer.shown.tick == scenes.record.last

    with Viewer(scenes, port=0, tail=LogTail(log), live=flying) as viewer, spectators(viewer.address, 1) as (page,):
        assert wait_for(newest)
        time.sleep(0.3)  # that it has come is told on a thread of its own
        assert newest()
        first = scenes.record.last
        log.write_bytes(data[: round(CUT * len(data))])
        assert not newest()
        assert first < scenes.record.last < 29
        page.send(readers.CAMERA)  # as it was
        time.sleep(0.3)
        assert not newest()
        page.send(msgpack.packb({**msgpack.unpackb(readers.CAMERA), "position": (0.0, -9.0, 1.0)}))
        assert wait_for(newest, SOON_S)
        monkeypatch.setattr(viewer_module, "_TURNED_S", 0.0)
        log.write_bytes(data[: round(0.8 * len(data))])
        assert not newest()
        with spectators(viewer.address, 1):
            assert wait_for(newest, SOON_S)


def test_how_often_a_flight_is_drawn() -> None:
    """Ten times a second, twice if it goes as fast as it can, and a tenth of a processor at most."""
    assert (pause_s(0.0, fast=False), pause_s(0.0, fast=True)) == (0.1, 0.5)
    for fast in (False, True):
        assert pause_s(0.2, fast=fast) == pytest.approx(2.0)


def test_a_paced_flight_is_drawn_as_often_as_leaves_it_room() -> None:
    """Less often step by step while no processor is idle, as before while some of one is, and more often after that."""
    idle, judged_s = [0.0] * 6 + [0.5] * 2 + [1.5] * 5, 2.0
    told, found = iter(idle), list[float]()
    spare = Spare(lambda: next(told))
    assert spare.gap_s(-judged_s) == 0.1  # nothing to judge by as yet
    for number in range(len(idle)):
        found.append(spare.gap_s(number * judged_s))
        assert spare.gap_s((number + 0.9) * judged_s) == found[-1]  # not looked at for long enough
    assert found == [0.2, 0.5, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.1]


def test_idle_processors(tmp_path: Path) -> None:
    """They are counted from what the kernel says of their time; where it says nothing, none is missing."""
    path = tmp_path / "stat"

    def tell(user: int, idle: int, waiting: int) -> None:
        cpus = "".join(f"cpu{k} 0 0 0 0\n" for k in range(4))
        path.write_text(f"cpu  {user} 0 0 {idle} {waiting} 0 0 0 {user} 0\n{cpus}intr 5\n")

    tell(100, 50, 10)
    idle = IdleProcessors(path)
    tell(175, 70, 15)
    assert idle.count() == pytest.approx(1.0)  # a quarter of the time of four
    tell(275, 70, 15)
    assert idle.count() == 0.0
    assert idle.count() == 0.0  # no time has passed
    path.write_text("none of this\n")
    assert idle.count() == math.inf
    assert IdleProcessors(tmp_path / "missing").count() == math.inf


@needs_browser
def test_a_run_in_flight_is_shown_and_changed(tmp_path: Path, window: Browser) -> None:
    """A slider delays every link of a run in flight, buttons kill and restart an agent, and the log has it.

    Being watched moves nothing by a bit: the same flight in one process, told of the change by its scenario, has the
    same states and plans, whoever watched this one and however many came and went.
    """
    paced = settings("clock.speed=1.0", "clock.on_agent_loss=continue", LONG)
    process = start("run", "resilient", *paced, "--no-figures", "--view", "--port", "0", "--out", "seen", cwd=tmp_path)
    folder, said = tmp_path / "seen", ""
    try:
        assert process.stderr is not None
        while not (address := re.search(r"http://127\.0\.0\.1:\d+", said)):
            line = process.stderr.readline()
            assert line, said
            said += line
        window.open(address[0])
        with spectators(address[0], 2):
            window.press(1000.0, *[RIGHT] * DELAY_STEPS)
            assert wait_for(lambda: "links change: at tick" in (window.label() or ""))
        log = Growing(folder / "run.mcap")
        assert wait_for(lambda: any(json.loads(change.settings) == WANTED for change in log.of(LinkChange)))
        window.pixels(pictures(), "live")
        assert window.complaints() == []
        window.leave()
        until = log.of(PlantState)[-1].tick + 10
        assert wait_for(lambda: log.of(PlantState)[-1].tick > until)
        window.open(address[0])
        for action, noted in (("kill", "killed"), ("restart", "restarted")):
            window.click(action, VICTIM - 1)
            assert wait_for(partial(log.notes, f"agent{VICTIM}", noted))
        assert window.complaints() == []
    finally:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == INTERRUPTED, output + errors
    assert processes_of("seen") == {}

    whole = read_log(folder / "run.mcap")
    *_, last = changes = list(whole.of(LinkChange))  # a slow browser may rest on the way
    assert json.loads(last.settings) == WANTED
    assert last.tick + 10 < until
    tables = (f"{{at_s={c.tick * 0.05!r},delay_s={json.loads(c.settings)['delay_s']!r},loss=0.0}}" for c in changes)
    unwatched = said_until(until, folder / "scenario.toml", f"links.change=[{','.join(tables)}]")
    watched = [entry.message for entry in whole.messages if entry.message.tick < until]
    assert len(list(bits(unwatched))) == until * (1 + AGENTS)
    assert sorted(bits(watched)) == sorted(bits(unwatched))


class Growing(LogTail):
    """A log that is being written, with all that has been read of it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._all: list[Message] = []

    def of(self, kind: type[M]) -> list[M]:
        """The messages of one kind until now."""
        self._all += [message for message in self.read() if not isinstance(message, Unread)]
        return [message for message in self._all if isinstance(message, kind)]

    def notes(self, target: str, what: str) -> bool:
        """Whether something is noted that was done to a process."""
        return any((note.target, note.what, note.origin) == (target, what, "person") for note in self.of(FaultNote))


class EnoughError(Exception):
    """As far as it is compared."""


def said_until(tick: int, scenario: Path, setting: str) -> list[Message]:
    """What is said before a tick of a flight in this process, nobody watching."""
    messages: list[Message] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState) and message.tick == tick:
            raise EnoughError
        messages.append(message)

    with pytest.raises(EnoughError):
        simulate(Setup.of(read_scenario(scenario, [setting]), str(scenario)), record)
    return [message for message in messages if message.tick < tick]


def bits(messages: Iterable[Message]) -> Iterator[tuple[int, str, bytes]]:
    """Tick, sender and numbers of states and plans."""
    for message in messages:
        if isinstance(message, PlantState):
            yield message.tick, message.sender, message.x.tobytes() + message.u.tobytes()
        elif isinstance(message, Plan):
            yield message.tick, message.sender, message.inputs.tobytes() + message.corrections.tobytes()


def test_the_command_listens_here_alone_until_ctrl_c(recorded: Path) -> None:
    """Its one result is an address of this host; the next viewer takes the next port; Ctrl-C ends it in order."""
    process = start("view", recorded, "--port", "0", cwd=recorded)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        port = int(address.removeprefix("http://127.0.0.1:"))
        with socket.socket() as elsewhere:
            assert elsewhere.connect_ex((OTHER_LOOPBACK, port)) != 0
        with viewer_of(recorded, "127.0.0.1", port) as second:
            assert port < int(second.address.rpartition(":")[2]) < port + 100
    finally:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, output) == (0, ""), errors
    assert "Traceback" not in errors


def test_time_stands_plays_and_follows() -> None:
    """Stopped it stays, playing it moves on at its speed and stops at the end, following it is the newest tick."""
    clock = Clock(0.05, follows=False, playing=False)
    assert clock.advance(1.0, 0, 100) == 0
    clock.toggle()
    assert clock.advance(1.0, 0, 100) == 20
    clock.set_speed(2.0)
    assert clock.advance(1.0, 0, 100) == 60
    assert clock.advance(9.0, 0, 100) == 100
    assert not clock.playing
    clock.toggle()  # from the beginning again
    assert clock.advance(0.1, 3, 100) == 4
    clock.follow(True)
    assert [clock.advance(0.1, 3, last) for last in (101, 105)] == [101, 105]
    clock.seek(50)
    assert clock.advance(1.0, 3, 110) == 50
    assert (clock.follows, clock.playing) == (False, False)


def test_what_cannot_be_shown_is_refused(tmp_path: Path, recorded: Path) -> None:
    """No run, no log, nothing in the log, no such address: one line each, with what was expected, exit code 2."""
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    refusals = {
        f"{tmp_path / 'nowhere' / 'run.mcap'}: cannot read the log": ["view", str(tmp_path / "nowhere")],
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
    assert "expected the states of a flight" in CliRunner().invoke(app, ["view", str(empty)]).stderr


@pytest.mark.parametrize("arguments", [["view"], ["run", "paper", "--view", "--out"]])
def test_what_is_missing_is_named(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    """Without viser both commands say what to install, before anything flies."""
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    folder = recorded if arguments == ["view"] else tmp_path / "out"
    result = CliRunner().invoke(app, [*arguments, str(folder)])
    assert result.exit_code == 2
    assert result.stderr == "transport: viser is not installed; pip install 'payload-transport[view]' brings it\n"
    assert not (tmp_path / "out").exists()
