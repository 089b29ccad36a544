"""The signals that end a command.

They are raised as `Interrupt`, or collected while a run with processes is active. None is lost: an
interrupt that some code drops is raised again.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from transport.protocol.network.parent_and_environment import ending_signals
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED

# Pause before an interrupt is raised again, s.
_AGAIN_S = 0.005
# Process whose command the signals end.
_command_pid = 0
# Signals that were raised and not taken yet, in the order of their arrival.
_pending: list[signal.Signals] = []
# Steps that no interrupt may end, and the signals that came meanwhile.
_uninterrupted = 0
_deferred: list[signal.Signals] = []


class Interrupt(KeyboardInterrupt):
    """A received signal; it is raised again when its exception is dropped before `take_interrupt`.

    Destructors, callbacks from compiled code and some libraries drop any exception that is raised
    while they run. An exception that is still propagating or being handled is not dropped.
    """

    def __del__(self) -> None:
        if _pending:
            threading.Thread(target=_send_again, name="interrupt", daemon=True).start()


def raise_interrupts() -> None:
    """Let SIGTERM and SIGHUP end this process like Ctrl-C, by `Interrupt`."""
    global _command_pid
    _command_pid = os.getpid()
    for number in ending_signals():
        # Without job control a shell starts commands in the background with SIGINT ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise)
    sys.unraisablehook = _report_unraisable


def check_interrupt() -> None:
    """Raise Interrupt if a signal is pending, wherever its exception is."""
    if _pending:
        raise Interrupt(_pending[0].name)


def take_interrupt() -> bool:
    """Note that the command ends because of the pending signals; return whether there are any.

    To be called where an `Interrupt` is handled for good.
    """
    is_interrupted = bool(_pending)
    _pending.clear()
    return is_interrupted


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Raise a signal that comes meanwhile at the end.

    For imports: compiled modules may not survive an exception within theirs.
    """
    global _uninterrupted
    _uninterrupted += 1
    try:
        yield
    finally:
        _uninterrupted -= 1
        if _deferred and not _uninterrupted:
            first = _deferred[0]
            _deferred.clear()  # further ones say the same, and must not end what comes after it
            signal.raise_signal(first)


def leave_interrupts_to_python() -> None:
    """Restore Python's own Ctrl-C, for a debugger, which drops the exception and goes on."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _raise(number: int, _: FrameType | None) -> None:
    if os.getpid() != _command_pid:  # a forked helper of the command has nothing to wind up
        os._exit(EXIT_INTERRUPTED)
    name = signal.Signals(number)
    if _uninterrupted:
        _deferred.append(name)
        return
    _pending.append(name)
    raise Interrupt(name.name)


def _send_again() -> None:
    """Send a pending signal to the main thread, once the code that dropped it is left."""
    time.sleep(_AGAIN_S)
    if _pending:
        signal.pthread_kill(threading.main_thread().ident or 0, _pending[0])


def _report_unraisable(dropped: Any) -> None:
    """Report an exception that no caller can receive, but no interrupt: it is raised again."""
    if not isinstance(dropped.exc_value, Interrupt):
        sys.__unraisablehook__(dropped)


class CollectedSignals:
    """Received SIGINT, SIGTERM and SIGHUP, in the order of their arrival."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def note(self, number: int, _: FrameType | None = None) -> None:
        """Handle a signal."""
        self._names.append(signal.Signals(number).name)

    def next(self) -> str | None:
        """Return the name of the next signal, None if there is none; forget it."""
        return self._names.pop(0) if self._names else None


@contextmanager
def collected_signals() -> Iterator[CollectedSignals]:
    """Collect signals instead of raising them; one that was not looked at is raised at the end.

    Only in the main thread; elsewhere nothing is collected.
    """
    check_interrupt()
    received = CollectedSignals()
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    before = {number: signal.signal(number, received.note) for number in ending_signals()}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if (name := received.next()) is not None:
        signal.raise_signal(signal.Signals[name])
