"""Processes of a run on this machine: their progress, their ends, and their last words."""

import io
import os
import signal
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from transport.flight import local_processes
from transport.flight.fork_server import Start
from transport.flight.local_processes import (
    Child,
    Harness,
    HarnessError,
    ToStart,
    free_udp_ports,
    keys_setting,
    reserved_ports,
)
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.parent_and_environment import PARENT_PIPE, STANDBY
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE


class Process:
    """A process that has an exit code, or None while it runs, and has had some processor time."""

    def __init__(self, code: int | None = None, cpu_s: float = 0.0, obeys: int = 0) -> None:
        self.code = code
        self.obeys = obeys  # signal at which it ends, beside SIGKILL
        self.received: list[int] = []
        self.cpu_s = cpu_s
        self.state: str = psutil.STATUS_RUNNING
        self.error: psutil.Error | None = None  # raised by all but `wait`

    def wait(self, timeout_s: float) -> int:
        """Return the exit code."""
        if self.code is None:
            raise psutil.TimeoutExpired(timeout_s)
        return self.code

    def cpu_times(self) -> Any:
        """Return its processor time, half of it in the system."""
        self._fail()
        return SimpleNamespace(user=self.cpu_s / 2.0, system=self.cpu_s / 2.0)

    def status(self) -> str:
        """Return its state."""
        self._fail()
        return self.state

    def send_signal(self, number: int) -> None:
        """End by SIGKILL, or by the signal that it obeys."""
        self._fail()
        self.received.append(number)
        if number in (signal.SIGKILL, self.obeys):
            self.code = -number

    def _fail(self) -> None:
        if self.error is not None:
            raise self.error


def child(folder: Path, process: Process, output: str = "", name: str = "plant") -> Child:
    """Return a child with some output."""
    log = folder / f"{name}.log"
    log.write_text(output, encoding="utf-8")
    stand_in: Any = process
    return Child(name, stand_in, io.BytesIO(), log)


def test_a_process_is_starting_while_it_works_and_has_not_worked_for_too_long(
    tmp_path: Path,
) -> None:
    """It has had processor time since the last question, runs, is not stopped, and is within its time."""
    process = Process()
    plant = child(tmp_path, process)
    cpu_times_s: Iterator[tuple[float, bool]] = iter(
        [(0.0, False), (1.0, True), (1.0, False), (2.0, True), (10.0, True), (10.5, False)]
    )
    for process.cpu_s, expected in cpu_times_s:
        assert plant.is_starting(10.0) is expected

    for code, state in ((None, psutil.STATUS_STOPPED), (0, psutil.STATUS_RUNNING)):
        process.code, process.state = code, state
        process.cpu_s += 1.0
        assert not plant.is_starting(100.0)

    harness = Harness("r1", tmp_path / "scenario.toml", {}, tmp_path)
    assert not harness.is_starting("agent1", 100.0)  # it is started elsewhere
    place = Endpoints(listen=["tcp/127.0.0.1:7001"], connect=[])
    begins = child(tmp_path, Process(cpu_s=2.0))
    own = Harness("r1", tmp_path / "scenario.toml", {"plant": place}, tmp_path, children=[begins])
    assert [own.is_starting("plant", longest_s) for longest_s in (2.0, 2.0)] == [True, False]


def test_a_process_that_has_gone_meanwhile_is_no_error(tmp_path: Path) -> None:
    """It is neither stopped nor starting, and takes no signal; without its log it has no words."""
    process = Process(cpu_s=1.0)
    process.state = psutil.STATUS_STOPPED
    plant = child(tmp_path, process, "transport: no\n")
    assert plant.is_stopped
    process.error = psutil.NoSuchProcess(1)
    assert not plant.is_stopped
    assert not plant.is_starting(10.0)
    assert plant.signal(signal.SIGTERM)
    process.error, process.code = None, 0
    assert not plant.is_stopped
    assert not plant.signal(signal.SIGTERM)
    assert process.received == []

    plant.log.write_bytes(b"transport: \xff\n")
    assert plant.last_words == "\ufffd"
    plant.log.unlink()
    assert (plant.last_words, plant.last_output_s) == ("", 0.0)

    class Gone(io.BytesIO):
        def close(self) -> None:
            raise BrokenPipeError

    plant.stdin = Gone()
    plant.close()


@pytest.mark.parametrize("standby", [True, False])
def test_a_child_has_a_new_log_and_the_end_of_a_pipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, standby: bool
) -> None:
    """Which ends with the parent, or if the start fails; it is told whether it waits for a line."""
    given: dict[str, str] = {}
    taken: list[Start] = []
    pipes: list[int] = []
    problem: OSError | None = None

    def start(starts: Sequence[Start], extra: Mapping[str, str]) -> list[Process]:
        given.update(extra)
        taken.extend(starts)
        for one in starts:
            os.write(one.output, " ".join(one.arguments).encode())
            pipes.append(os.dup(one.stdin))
        if problem is not None:
            raise problem
        return [Process() for _ in starts]

    monkeypatch.setattr(local_processes, "fork_server", lambda: SimpleNamespace(start=start))
    log = tmp_path / "agent2.log"
    log.write_text("of an earlier run")
    wanted = [ToStart("agent2", ["agent", "--id", "2"], log, 3)]
    (agent,) = local_processes.start_children(wanted, standby=standby)
    for closed in (taken[0].stdin, taken[0].output):
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(closed)
    assert given == {PARENT_PIPE: "1", STANDBY: "1" if standby else ""}
    assert (agent.name, agent.incarnation, log.read_text()) == ("agent2", 3, "agent --id 2")
    agent.stdin.write(b"go")
    assert os.read(pipes[0], 10) == b"go"
    agent.close()
    problem = OSError("no process left")
    with pytest.raises(OSError, match="no process left"):
        local_processes.start_children(wanted, standby=standby)
    assert [os.read(pipe, 10) for pipe in pipes] == [b"", b""]
    for pipe in pipes:
        os.close(pipe)


def test_the_first_process_that_has_ended_comes_first(tmp_path: Path) -> None:
    """By the times of their last outputs, whatever the order of their starts; running ones are left out."""
    children = []
    for name, code, at_s in (("agent1", 4, 30.0), ("plant", None, 10.0), ("agent2", 1, 20.0)):
        children.append(child(tmp_path, Process(code), name=name))
        os.utime(children[-1].log, (at_s, at_s))
    harness = Harness("r1", tmp_path / "scenario.toml", {}, tmp_path, children=children)
    assert [ended.name for ended in harness.ended()] == ["agent2", "agent1"]


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (
            '{"event": "a"}\ntransport: first\ntransport: no such file\n{"event": "b"}\n\n',
            "no such file",
        ),
        ('{"event": "a"}\n', ""),
        ("", ""),
    ],
)
def test_the_last_words_are_the_newest_line_that_is_no_event(
    output: str, words: str, tmp_path: Path
) -> None:
    """It is the error of a process, without the name of the command."""
    assert child(tmp_path, Process(1), output).last_words == words


def test_a_process_tells_how_it_ended(tmp_path: Path) -> None:
    """By the name of the signal, or by the exit code."""
    assert child(tmp_path, Process(-signal.SIGSEGV)).how_it_ended == "was killed by SIGSEGV"
    assert child(tmp_path, Process(3)).how_it_ended == "ended with exit code 3"


def test_processes_that_stay_are_killed_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was stopped is continued, as it would ignore SIGTERM; all inputs are closed."""
    waits: list[tuple[object, float, bool]] = []

    def wait(processes: object, timeout_s: float) -> None:
        waits.append((processes, timeout_s, children[0].stdin.closed))

    monkeypatch.setattr("psutil.wait_procs", wait)
    stays, ends = Process(), Process(obeys=signal.SIGTERM)
    children = [child(tmp_path, stays, name="agent1"), child(tmp_path, ends, name="plant")]
    said: list[str] = []
    Harness("r1", tmp_path / "scenario.toml", {}, tmp_path, children=children).end(said.append)
    assert said == ["agent1 did not end: running; it was killed"]
    assert stays.received == [signal.SIGTERM, signal.SIGCONT, signal.SIGKILL]
    assert ends.received == [signal.SIGTERM]
    assert waits == [([stays, ends], 5.0, False)] * 2
    assert all(one.stdin.closed for one in children)


def test_each_start_of_a_process_has_its_own_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process is that of its last start."""

    def start_children(wanted: list[ToStart]) -> list[Child]:
        return [
            Child(one.name, Process(), io.BytesIO(), one.log, one.incarnation) for one in wanted
        ]

    monkeypatch.setattr(local_processes, "start_children", start_children)
    place = Endpoints(listen=["tcp/127.0.0.1:7001"], connect=[])
    logs, mesh = tmp_path / "run" / "logs", dict.fromkeys(("agent1", "agent2"), place)
    harness = Harness("r1", tmp_path / "scenario.toml", mesh, logs)
    harness.start(mesh)
    harness.start(["agent2"], 2)
    names = [one.log.relative_to(logs).name for one in harness.children]
    assert names == ["agent1.log", "agent2.log", "agent2-2.log"]
    assert (harness.child("agent1").incarnation, harness.child("agent2").incarnation) == (0, 2)
    assert logs.is_dir()


def test_a_process_that_has_ended_cannot_begin(tmp_path: Path) -> None:
    """Nor can one whose input has gone; one that waits gets a line."""

    class Broken(io.BytesIO):
        def write(self, _: Any) -> int:
            raise BrokenPipeError

    waits = child(tmp_path, Process())
    assert waits.go()
    assert waits.stdin.getvalue() == b"\n"  # type: ignore[attr-defined]
    assert not child(tmp_path, Process(0)).go()
    waits.stdin = Broken()
    assert not waits.go()


class Taken:
    """Sockets of a host on which a port is taken, and any port is 100, 200, ..."""

    def __init__(self, taken: int) -> None:
        self._taken = taken
        self._any = iter(range(100, 10**6, 100))

    def __call__(self, **_: Any) -> Any:
        """Return a new socket."""
        bound: list[int] = []

        def bind(address: tuple[str, int]) -> None:
            port = address[1] or next(self._any)
            if port % 100 == self._taken % 100 and (port == self._taken or self._taken < 100):
                raise OSError
            bound.append(port)

        close: Any = SimpleNamespace(bind=bind, getsockname=lambda: ("127.0.0.1", bound[0]))
        return nullcontext(close)


def test_successive_free_ports_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them are free: if the last is taken, others are tried, at most a hundred times."""
    stand_in = SimpleNamespace(SOCK_DGRAM=socket.SOCK_DGRAM, socket=Taken(102))
    monkeypatch.setattr(local_processes, "socket", stand_in)
    assert free_udp_ports(2) == 100
    stand_in.socket = Taken(102)
    assert free_udp_ports(3) == 200
    stand_in.socket = Taken(2)
    with pytest.raises(HarnessError, match="found no 3 successive free UDP ports"):
        free_udp_ports(3)


def test_a_port_that_is_taken_is_named() -> None:
    """Or the address, if it is not one of this machine; port 0 is any."""
    with reserved_ports("127.0.0.1", [0, 0]) as (first, second):
        assert 0 not in {first, second}
        assert first != second
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        key = f"network.base_port: expected free ports, got {port}, which is taken"
        with pytest.raises(HarnessError, match=f"{key}: cannot listen on 127.0.0.1") as refused:
            reserved_ports("127.0.0.1", [port]).__enter__()
        assert refused.value.exit_code == EXIT_UNREACHABLE
    with pytest.raises(HarnessError, match=r"network\.host: cannot listen on 192"):
        reserved_ports("192.0.2.1", [0]).__enter__()


@pytest.mark.parametrize(("platform", "is_kept"), [("linux", True), ("darwin", False)])
def test_a_reserved_port_is_left_to_one_that_names_it(
    platform: str, monkeypatch: pytest.MonkeyPatch, *, is_kept: bool
) -> None:
    """On Linux it is kept from all that do not share addresses; elsewhere it would be from Zenoh, too."""
    monkeypatch.setattr(local_processes, "sys", SimpleNamespace(platform=platform))
    with reserved_ports("127.0.0.1", [0]) as (port,):
        taken = pytest.raises(OSError, match="in use") if is_kept else nullcontext()
        with socket.socket() as other, taken:
            other.bind(("127.0.0.1", port))
        with socket.socket() as shared:
            shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            shared.bind(("127.0.0.1", port))
            shared.listen()


def test_a_folder_of_keys_may_have_any_name() -> None:
    """The setting is TOML, which has no surrogate pairs."""
    assert keys_setting('a "b" \U0001f511') == 'network.keys="a \\"b\\" \U0001f511"'
