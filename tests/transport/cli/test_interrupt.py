"""An interrupt ends the command `transport` with its exit code, wherever the command is at that moment."""

import ctypes
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec

import pytest
from typer.testing import CliRunner

from tests.support import runs
from transport.cli.lazy import load
from transport.cli.main import app
from transport.flight import memory
from transport.flight.run_execution import Finished
from transport.flight.signals import (
    Interrupt,
    collected_signals,
    raise_interrupts,
    take_interrupt,
)
from transport.protocol.network.parent_and_environment import python
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED
from transport.protocol.wire.messages import Message

P = ParamSpec("P")

# Stands in for the module with the commands; ends as if the interrupt came while it is imported or
# while it works.
_PROGRAM = """
import signal, sys, time, types
class Commands(types.ModuleType):
    def __getattr__(self, name):
        {code}
sys.modules["transport.cli.main"] = Commands("commands")
from transport.__main__ import main
main()
"""

# Commands that turn an interrupt into another error, as some libraries do, or drop it.
_TURNED = "exec('try: signal.raise_signal(15)\\nexcept BaseException: raise ValueError')"
_DROPPED = "[exec('try: signal.raise_signal(15)\\nexcept BaseException: pass'), time.sleep(20)]"


@pytest.mark.parametrize(
    "code",
    [
        pytest.param("raise KeyboardInterrupt", id="in a module"),
        pytest.param("exec('raise KeyboardInterrupt')", id="in a text, as dataclasses run them"),
        pytest.param("import signal; signal.raise_signal(signal.SIGTERM)", id="by SIGTERM"),
        pytest.param(f"return lambda **_: {_TURNED}", id="turned into another error"),
        pytest.param(f"return lambda **_: {_DROPPED}", id="dropped"),
        pytest.param(f"return lambda **_: sys.exit({EXIT_INTERRUPTED})", id="in a command"),
    ],
)
def test_the_exit_code_is_that_of_the_table(code: str, tmp_path: Path) -> None:
    """Started like the command, as a module.

    Only then CPython would end by the interrupt it remembers.
    """
    (tmp_path / "program.py").write_text(_PROGRAM.format(code=code))
    path = {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path.cwd())])}
    result = subprocess.run(
        python("program"),
        env={**os.environ, **path},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (EXIT_INTERRUPTED, "", "")


@pytest.mark.parametrize("moment", ["while the run ends", "while the report is made"])
def test_the_command_tells_what_is_kept(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted run names its log and the command that reports it, in one line."""
    folder = tmp_path / "run"

    def simulate(*_: Any) -> Finished:
        folder.mkdir()
        (folder / "run.mcap").touch()
        if moment == "while the run ends":
            raise KeyboardInterrupt
        return Finished(folder, 0, "")

    def report(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.local_run.simulate", simulate)
    monkeypatch.setattr("transport.cli.commands.plot.report", report)
    result = CliRunner().invoke(app, ["run", "paper", "--no-figures", "--out", str(folder)])
    assert result.exit_code == EXIT_INTERRUPTED
    (line,) = result.stderr.splitlines()
    assert line.startswith("transport: interrupted")
    assert line.endswith(f"; kept {folder}/run.mcap, report it with: transport plot {folder}")


def test_a_run_interrupted_before_its_log_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a log the command says that nothing is recorded."""

    def simulate(*_: Any) -> Finished:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.local_run.simulate", simulate)
    result = CliRunner().invoke(
        app, ["run", "paper", "--no-figures", "--out", str(tmp_path / "run")]
    )
    assert (result.exit_code, result.stderr) == (
        EXIT_INTERRUPTED,
        "transport: interrupted; nothing is recorded\n",
    )


# The interrupt comes within milliseconds; without it a test fails after this time, s.
PATIENCE_S = 20.0


def as_a_command(test: Callable[P, None]) -> Callable[P, None]:
    """Run a test with the signal handlers of a command, and restore those of the tests behind it.

    A signal that is still to be sent again is awaited at once: within pytest it would end the
    session, and with the handlers of the tests the process.
    """

    @wraps(test)
    def run(*arguments: P.args, **named: P.kwargs) -> None:
        numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
        handlers = {number: signal.getsignal(number) for number in numbers}
        hook = sys.unraisablehook
        try:
            test(*arguments, **named)
        finally:
            settle()
            for number, handler in handlers.items():
                signal.signal(number, handler)
            sys.unraisablehook = hook

    return run


def settle() -> None:
    """Wait until no signal is pending or on its way."""
    is_settled = False
    while not is_settled:
        with suppress(Interrupt):
            take_interrupt()
            gc.collect()
            time.sleep(0.001)
            is_settled = all(thread.name != "interrupt" for thread in threading.enumerate())
            is_settled = is_settled and not take_interrupt()


@contextmanager
def interrupted(match: str = "SIGTERM") -> Iterator[None]:
    """Expect that the body ends by an interrupt, and take it as a command does.

    Taken at once: an interrupt that was dropped on its way is sent again some milliseconds later,
    and would end the test behind the body.
    """
    with pytest.raises(Interrupt, match=match):  # noqa: PT012  # the body is the caller's
        try:
            yield
        finally:
            take_interrupt()


def in_a_destructor() -> None:
    """Receive SIGTERM while an object is destroyed: Python drops the exception."""

    class Destroyed:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    Destroyed()


def in_a_callback() -> None:
    """Receive SIGTERM in a callback from compiled code, which drops the exception."""
    prototype = ctypes.CFUNCTYPE(None)
    prototype(lambda: signal.raise_signal(signal.SIGTERM))()


def in_a_library() -> None:
    """Receive SIGTERM in code that catches everything."""
    with suppress(BaseException):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("receive", [in_a_destructor, in_a_callback, in_a_library])
@as_a_command
def test_a_dropped_interrupt_is_raised_again(
    receive: Callable[[], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """An interrupt that some code drops is raised again behind it, and nothing is printed."""
    raise_interrupts()
    with interrupted():
        receive()
        threading.Event().wait(PATIENCE_S)
    assert capsys.readouterr().err == ""


@as_a_command
def test_an_import_is_interrupted_behind_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled modules import others while they are imported, and crash where these raise."""
    (tmp_path / "signalled.py").write_text(
        "import signal; signal.raise_signal(15); signal.raise_signal(2); IS_WHOLE = True"
    )
    (tmp_path / "quiet.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    raise_interrupts()
    with interrupted():
        load("signalled")
    assert sys.modules.pop("signalled").IS_WHOLE
    load("quiet")  # the second one is not left for it
    with interrupted():
        signal.raise_signal(signal.SIGTERM)


@as_a_command
def test_a_taken_interrupt_is_not_raised_again() -> None:
    """A command that has handled its interrupt ends undisturbed; a second signal interrupts it."""
    raise_interrupts()
    try:
        signal.raise_signal(signal.SIGTERM)
    except Interrupt:
        assert take_interrupt()
    gc.collect()
    assert not take_interrupt()
    with interrupted():
        signal.raise_signal(signal.SIGTERM)


@as_a_command
def test_a_suppressed_interrupt_ends_a_run_in_memory() -> None:
    """A run in memory ends at the next message when a callback suppresses the interrupt."""
    recorded = 0

    def record(_: Message) -> None:
        nonlocal recorded
        recorded += 1
        if recorded == 3:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)

    raise_interrupts()
    with interrupted():
        memory.simulate(runs.setup(runs.SHORT), record)
    assert recorded < 100, "the run went on"


@as_a_command
def test_collected_signals_are_looked_at_or_raised() -> None:
    """Signals that come while a run is watched are handed over once; the others are raised at its end."""
    raise_interrupts()
    with collected_signals() as received:
        signal.raise_signal(signal.SIGTERM)
        assert received.next() == "SIGTERM"
        assert received.next() is None
    with interrupted(), collected_signals():
        signal.raise_signal(signal.SIGTERM)
        time.sleep(0.0)


@as_a_command
def test_a_run_does_not_begin_with_a_pending_interrupt() -> None:
    """A signal whose exception is held somewhere is raised before signals are collected."""
    raise_interrupts()
    held = None
    try:
        signal.raise_signal(signal.SIGTERM)
    except Interrupt as error:
        held = error
    with interrupted(), collected_signals():
        pytest.fail("the run began")
    assert held is not None


@as_a_command
def test_a_forked_helper_ends_silently() -> None:
    """A process that the command has forked ends by a signal with its exit code, without an exception."""
    raise_interrupts()
    pid = os.fork()
    if pid == 0:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == EXIT_INTERRUPTED


@as_a_command
def test_signals_the_user_ignores_stay_ignored() -> None:
    """A command in the background of a shell without job control, or started with nohup, ends by SIGTERM only."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    raise_interrupts()
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)]
    assert handlers == [signal.SIG_IGN] * 2
    with interrupted():
        signal.raise_signal(signal.SIGTERM)
