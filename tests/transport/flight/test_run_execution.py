"""End of a recorded run: its exit code and reason, and whether its folder is kept."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace
from rich.console import Console

from tests.support import runs
from transport.flight import run_execution
from transport.flight.run_execution import observe
from transport.flight.run_files import RunError
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.messages import Control

RUN = runs.setup(runs.SHORT)
LOST = "the log: cannot write it (no space)"


def end(exit_code: int, reason: str = "") -> Control:
    """Return the end of a run."""
    return replace(runs.end(3), exit_code=exit_code, reason=reason)


def observed(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    interrupt: bool = False,
    lost: str = "",
    **recorder: Any,
) -> tuple[int, str]:
    """Return exit code and reason of a run whose recorder ends in a state."""

    def recorder_of(_setup: Any, _place: Any, writer: Any, *_: Any) -> Any:
        writer.lost = lost
        state = {"control": None, "error": None, "started_s": 1.0, "received": 5} | recorder
        return SimpleNamespace(writer=writer, close=writer.close, start=lambda _: None, **state)

    def until_end() -> None:
        if interrupt:
            raise KeyboardInterrupt

    monkeypatch.setattr(run_execution, "Recorder", recorder_of)
    monkeypatch.setattr(run_execution, "RunWatch", lambda *_: SimpleNamespace(until_end=until_end))
    finished = observe(RUN, runs.place("r1"), folder, Console(quiet=True))
    return finished.exit_code, finished.reason


@pytest.mark.parametrize(
    ("recorder", "expected"),
    [
        ({"control": end(0)}, (0, "")),
        ({"control": end(codes.EXIT_DIVERGED, "far away")}, (codes.EXIT_DIVERGED, "far away")),
        (
            {"control": end(codes.EXIT_UNREACHABLE, "plant is gone")},
            (codes.EXIT_UNREACHABLE, "plant is gone"),
        ),
        ({}, (codes.EXIT_INTERRUPTED, "recording interrupted; the run may continue without it")),
    ],
)
def test_an_end_after_the_first_tick_is_told(
    recorder: dict[str, Any],
    expected: tuple[int, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code and reason are the coordinator's, or those of an interrupted recording; the folder stays."""
    assert observed(tmp_path / "a", monkeypatch, **recorder) == expected
    assert (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("recorder", "exit_code", "text"),
    [
        ({"error": "no router"}, codes.EXIT_UNREACHABLE, "no router"),
        ({"started_s": None}, codes.EXIT_UNREACHABLE, "the run ended before its first tick"),
        (
            {"control": end(codes.EXIT_UNREACHABLE, "plant is gone"), "started_s": None},
            codes.EXIT_UNREACHABLE,
            "plant is gone; the run ended before its first tick",
        ),
        ({"control": end(0), "lost": LOST}, codes.EXIT_UNRECORDED, f"{LOST}; the run completed"),
        (
            {"control": end(codes.EXIT_DIVERGED, "far away"), "lost": LOST},
            codes.EXIT_DIVERGED,
            f"{LOST}; the run completed far away",
        ),
    ],
)
def test_a_run_that_did_not_begin_or_is_not_recorded_is_an_error(
    recorder: dict[str, Any],
    exit_code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The exit code of the run goes before that of its log."""
    with pytest.raises(RunError) as caught:
        observed(tmp_path / "a", monkeypatch, **recorder)
    assert (str(caught.value), caught.value.exit_code) == (text, exit_code)
    assert (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("started_s", "received", "stays"), [(1.0, 5, True), (None, 5, False), (1.0, 0, False)]
)
def test_an_interrupted_run_without_a_tick_leaves_no_folder(
    started_s: float | None,
    received: int,
    stays: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """There is nothing to report without a tick, or without any message."""
    recorder: dict[str, Any] = {"started_s": started_s, "received": received}
    with pytest.raises(KeyboardInterrupt):
        observed(tmp_path / "a", monkeypatch, interrupt=True, **recorder)
    assert (tmp_path / "a").exists() is stays
