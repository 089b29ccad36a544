"""Processes of a run on this machine: their progress, their ends, and their last words."""

import io
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from transport.flight.local_processes import Child, Harness


class Process:
    """A process that has an exit code, or None while it runs, and has had some processor time."""

    def __init__(self, code: int | None = None, cpu_s: float = 0.0) -> None:
        self.code = code
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
