"""The command `transport`, also as `python -m transport`."""

import atexit
import io
import itertools
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EPIPE
from types import FrameType
from typing import NoReturn, TextIO

from transport.flight.signals import raise_interrupts
from transport.protocol.network.parent import ending_signals, wake_with_its_end
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNRECORDED


class _Stream(io.FileIO):
    """Raw stream of a file descriptor that leads to the null device after the first failed write.

    Attributes:
        error: That failure, if there was one.
    """

    error: OSError | None = None

    def write(self, data: object) -> int | None:  # type: ignore[override]
        try:
            return super().write(data)  # type: ignore[arg-type]
        except OSError as error:
            self.error = error
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return super().write(data)  # type: ignore[arg-type]


@contextmanager
def standard_streams() -> Iterator[None]:
    """Run a command whose output may fail at any moment.

    A reader that has left, as `head`, changes nothing. Another failure of standard output, such as
    a full disk, is told in a line, and the exit code is 10 unless the command has another one.
    Standard error may be lost.
    """
    raw = _replace("stdout", 1)
    _replace("stderr", 2)
    try:
        yield
    except SystemExit as end:
        sys.stdout.flush()
        if raw.error is None or raw.error.errno == EPIPE:
            raise
        sys.stderr.write(
            f"transport: standard output: cannot write the results ({raw.error.strerror})\n"
        )
        sys.exit(end.code or EXIT_UNRECORDED)


def _replace(name: str, number: int) -> _Stream:
    """Replace a stream of `sys`; one that is closed goes to the null device."""
    old: TextIO | None = getattr(sys, name)
    raw = _Stream(
        number if old is not None else os.open(os.devnull, os.O_WRONLY), "wb", closefd=False
    )
    buffered = name == "stdout" and not raw.isatty()
    stream = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=old.encoding if old is not None else "utf-8",
        errors="backslashreplace",  # a character that the terminal has not is no reason to end
        line_buffering=not buffered,
        write_through=not buffered,
    )
    setattr(sys, name, stream)
    return raw


def main() -> NoReturn:
    """Run the command and end the process.

    SIGTERM and SIGHUP end it like Ctrl-C, from the first import to the end.
    """
    if sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        # Paths are UTF-8 for Zenoh and in TOML, whatever the locale.
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONUTF8": "1"})  # noqa: S606
    code = 1
    if sys.argv[1:2] == ["fork-server"]:
        _serve()
    try:
        wake_with_its_end()
        raise_interrupts()  # before the imports: they take a while
        if sys.argv[1:2] == ["run"] and not {"-h", "--help"} & set(sys.argv):
            from transport.flight.fork_server import fork_server

            fork_server()  # imports for the processes of the run while this process imports for itself
        with standard_streams():
            from transport.cli.main import app

            app(prog_name="transport")
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:  # during the imports
        code = EXIT_INTERRUPTED
    except BaseException:  # noqa: BLE001  # a bug
        traceback.print_exc()
    _end(code)


def _serve() -> NoReturn:
    """Be the fork server (`transport.flight.fork_server`), whose processes begin with `main`."""
    import socket

    wake_with_its_end()
    from transport.cli.lazy import load
    from transport.cli.options import read_setup
    from transport.flight.fork_server import serve

    def prepare(arguments: list[str]) -> None:
        settings = [value for option, value in itertools.pairwise(arguments) if option == "--set"]
        read_setup(arguments[arguments.index("--scenario") + 1], settings, allow_large=True).model  # noqa: B018

    for name in (
        "transport.cli.main",
        "transport.cli.processes",
        "transport.agent.node",
        "transport.coordinator.node",
        "transport.plant.node",
    ):
        load(name)
    serve(socket.socket(fileno=int(sys.argv[2])), prepare, main)
    os._exit(0)


def _end(code: int) -> NoReturn:
    """End this process without the interpreter's shutdown, which may wait for native threads and ignores signals.

    The exit code is decided: a signal changes nothing, and a second one ends the process at once.
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
