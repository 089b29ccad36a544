"""The command `transport`, also as `python -m transport`.

Modules are imported by the functions that need them: from its first line on, `main` decides what a
signal does.

    until the command runs   the process ends at once: `_leave`
    while it runs            it is interrupted, and its exit code is 130: `_code_of_command`
    once its code is known   nothing; a second one ends the process at once: `_end`
"""
# ruff: noqa: E402  # Ctrl-C is decided before the other imports

import _signal  # type: ignore[import-not-found]  # built in: it takes no time, unlike `signal`
import os

EXIT_INTERRUPTED = 130  # as in protocol.wire.errors_and_exit_codes, which is imported later


def _leave(*_: object) -> None:
    """End this process at once, without any cleaning up: the handler of signals during the imports.

    There is nothing to be ended, and an exception could be dropped, or leave a module half
    imported.
    """
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__" and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _leave)

import atexit
import signal
import sys
from contextlib import suppress
from types import FrameType

from transport.protocol.network.parent_and_environment import (
    ENVIRONMENT,
    FORK_SERVER,
    ending_signals,
    wake_with_its_end,
)

TYPE_CHECKING = False  # as `typing` has it, whose import takes as long as all others
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> "NoReturn":
    """Run the command and end the process.

    SIGTERM and SIGHUP end it like Ctrl-C.
    """
    _leave_on_signals()
    if sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        # Paths are UTF-8 for Zenoh and in TOML, whatever the locale.
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONUTF8": "1"})  # noqa: S606
    code = 1
    try:
        if sys.argv[1:2] == [FORK_SERVER]:
            _serve()
        else:
            code = _code_of_command()
    except KeyboardInterrupt:  # between the command's last step and the handlers of `_end`
        code = EXIT_INTERRUPTED
    except BaseException as error:  # noqa: BLE001  # `_end` leaves no time for Python's own report
        code = _code_of_error(error)
    finally:
        while True:  # again if an interrupt comes before `_end` has its own handlers
            with suppress(KeyboardInterrupt):
                _end(code)


def _leave_on_signals() -> None:
    """End this process at once when a signal arrives."""
    for number in ending_signals():
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _leave)


def _code_of_command() -> int:
    """Run the command of the arguments and return its exit code."""
    wake_with_its_end()
    if sys.argv[1:2] == ["run"]:
        # The processes of the run are forked from this one, whose imports take over some of these.
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)

    from transport.flight.signals import raise_interrupts, take_interrupt

    try:
        from transport.cli.main import command
        from transport.cli.streams import standard_streams

        with standard_streams():
            raise_interrupts()
            command()(prog_name="transport")
    except BaseException as error:  # noqa: BLE001  # any error has an exit code
        # Code that was interrupted may have turned the interrupt into another error.
        is_interrupted = take_interrupt() or isinstance(error, KeyboardInterrupt)
        return EXIT_INTERRUPTED if is_interrupted else _code_of_error(error)
    return EXIT_INTERRUPTED if take_interrupt() else 0


def _code_of_error(error: BaseException) -> int:
    """Return the exit code of an exception that ends the command; print a bug."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    import traceback

    traceback.print_exception(error)
    return 1


def _serve() -> "NoReturn":
    """Be the fork server of another program, whose processes begin with `main`."""
    import socket

    from transport.cli.hosts.fork_server_process import serve_processes

    serve_processes(socket.socket(fileno=int(sys.argv[2])), main)
    os._exit(0)  # the processes that it forked run their exit functions, not the server


def _end(code: int) -> "NoReturn":
    """End this process without the interpreter's shutdown.

    That may wait for native threads and ignores signals. The exit code is decided: a signal changes
    nothing, and a second one ends the process at once.
    """
    received = 0

    def count(_: int, __: FrameType | None) -> None:
        nonlocal received
        received += 1
        if received > 1:
            os._exit(code)

    for number in ending_signals():
        signal.signal(number, count)
    atexit._run_exitfuncs()
    with suppress(OSError, ValueError):  # the reader of the output has left
        sys.stdout.flush()
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
