"""Processes of a run on this machine: their progress, their ends, and their last words."""

import io
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from transport.flight import local_processes
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


class Process:
    """A process that has an exit code, or None while it runs, and has had some processor time."""

    def __init__(self, code: int | None = None, cpu_s: float = 0.0, obeys: int = 0) -> None:
        self.code = code
        self.obeys = obeys  # signal at which it ends, beside SIGKILL
        self.received: list[int] = []
        self.cpu_s = cpu_s
        self.state: str = psutil.STATUS_RUNNING

    def wait(self, timeout_s: float) -> int:
        """Return the exit code."""
        if self.code is None:
            raise psutil.TimeoutExpired(timeout_s)
        return self.code

    def cpu_times(self) -> Any:
        """Return its processor time, half of it in the system."""
        return SimpleNamespace(user=self.cpu_s / 2.0, system=self.cpu_s / 2.0)

    def status(self) -> str:
        """Return its state."""
        return self.state

    def send_signal(self, number: int) -> None:
        """End by SIGKILL, or by the signal that it obeys."""
        self.received.append(number)
        if number in (signal.SIGKILL, self.obeys):
            self.code = -number


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
    monkeypatch.setattr(Harness, "wait", lambda *_: None)
    stays, ends = Process(), Process(obeys=signal.SIGTERM)
    children = [child(tmp_path, stays, name="agent1"), child(tmp_path, ends, name="plant")]
    said: list[str] = []
    Harness("r1", tmp_path / "scenario.toml", {}, tmp_path, children=children).end(said.append)
    assert said == ["agent1 did not end: running; it was killed"]
    assert stays.received == [signal.SIGTERM, signal.SIGCONT, signal.SIGKILL]
    assert ends.received == [signal.SIGTERM]
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
        with pytest.raises(HarnessError, match=f"{key}: cannot listen on 127.0.0.1"):
            reserved_ports("127.0.0.1", [port]).__enter__()
    with pytest.raises(HarnessError, match=r"network\.host: cannot listen on 192"):
        reserved_ports("192.0.2.1", [0]).__enter__()


def test_a_folder_of_keys_may_have_any_name() -> None:
    """The setting is TOML, which has no surrogate pairs."""
    assert keys_setting('a "b" \U0001f511') == 'network.keys="a \\"b\\" \U0001f511"'
