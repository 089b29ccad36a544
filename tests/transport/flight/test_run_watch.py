"""Watch of a run: what Ctrl-C and the end of a process do, before and from the first tick on."""

import math
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from transport.flight import run_watch
from transport.flight.run_files import RunError
from transport.flight.run_watch import RunWatch
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.names import COORDINATOR


class Child(SimpleNamespace):
    """A process of the run: its exit code, and the signals that it has received."""

    def __init__(self, name: str, code: int | None) -> None:
        super().__init__(
            name=name, code=code, how_it_ended=f"ended with exit code {code}", last_words="no file"
        )
        self.received: list[int] = []

    def signal(self, number: int) -> None:
        """Take note of a signal."""
        self.received.append(number)


def watch(
    monkeypatch: pytest.MonkeyPatch,
    *,
    started_s: float | None = None,
    interrupts: Sequence[str] = (),
    code: int | None = None,
    looks: int = 3,
    killed: bool = False,
) -> tuple[RunWatch, Child]:
    """Return the watch of a run that has ended after so many looks, and its only process."""
    coming = [*interrupts]

    @contextmanager
    def signals() -> Iterator[Any]:
        yield SimpleNamespace(next=lambda: coming.pop(0) if coming else None)

    monkeypatch.setattr(run_watch, "collected_signals", signals)
    left = [True] * (looks - 1) + [False]
    recorder: Any = SimpleNamespace(
        join=lambda _: left.pop(0),
        setup=SimpleNamespace(scenario=SimpleNamespace(has_plant=True)),
        plant_state=None,
        started_s=started_s,
        control=None,
        stops=[],
    )
    recorder.stop = recorder.stops.append
    child = Child(COORDINATOR, code)
    harness: Any = SimpleNamespace(
        child=lambda _: child,
        ended=lambda: [] if child.code is None else [child],
        logs=Path("logs"),
    )
    progress: Any = SimpleNamespace(setup=None, show=lambda *_: None, say=lambda _: None)
    faults: Any = SimpleNamespace(work=lambda: None, has_killed=lambda _: killed)
    return RunWatch(recorder, progress, harness, faults), child


def test_ctrl_c_before_the_first_tick_ends_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """No tick is lost, so there is nothing to record."""
    run, child = watch(monkeypatch, interrupts=["SIGTERM"])
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        run.until_end()
    assert child.received == []


def test_the_first_ctrl_c_ends_the_run_and_the_second_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The coordinator gets the first one as the signal that it was."""
    run, child = watch(monkeypatch, started_s=1.0, interrupts=["SIGINT"])
    run.until_end()
    assert child.received == [signal.SIGINT]

    run, child = watch(monkeypatch, started_s=1.0, interrupts=["SIGHUP", "SIGINT"])
    with pytest.raises(KeyboardInterrupt, match="SIGINT"):
        run.until_end()
    assert child.received == [signal.SIGHUP]


def test_a_recorder_alone_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run goes on without it."""
    run, _ = watch(monkeypatch, started_s=1.0, interrupts=["SIGINT"])
    run.harness = None
    run.until_end()
    assert run.recorder.stops == ["SIGINT"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("code", "exit_code"),
    [
        (codes.EXIT_USAGE, codes.EXIT_USAGE),
        (codes.EXIT_SCENARIO, codes.EXIT_SCENARIO),
        (1, codes.EXIT_UNREACHABLE),
        (-signal.SIGKILL, codes.EXIT_UNREACHABLE),
    ],
)
def test_a_process_that_ends_too_early_is_told(
    code: int, exit_code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its error and the exit code: that of a refusal is the command's own, else a peer is gone."""
    run, _ = watch(monkeypatch, code=code)
    with pytest.raises(RunError, match=r"coordinator ended .* before the run began: no file") as at:
        run.until_end()
    assert at.value.exit_code == exit_code


@pytest.mark.parametrize("is_scripted", [False, True], ids=["orderly", "killed by script"])
def test_messages_of_an_ended_process_may_still_come(
    is_scripted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For 2 s: a run may diverge, or kill a process, within its first ticks."""
    code = -signal.SIGKILL if is_scripted else codes.EXIT_DIVERGED
    now_s = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    run, _ = watch(monkeypatch, code=code, killed=is_scripted)
    run.until_end()

    run, _ = watch(monkeypatch, code=code, killed=is_scripted)
    run.first_end_s = -2.1
    with pytest.raises(RunError):
        run.until_end()


def test_an_end_after_the_first_tick_is_no_concern_of_the_watch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other processes notice it, and the coordinator decides."""
    run, child = watch(monkeypatch, started_s=1.0, code=1)
    run.until_end()
    assert run.first_end_s == math.inf
    assert child.received == []
