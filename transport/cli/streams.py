"""Standard output and error of a command, either of which may fail at any moment."""

import io
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EPIPE
from typing import TextIO

from transport.protocol.wire.errors_and_exit_codes import EXIT_UNRECORDED


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
    Standard error may be lost. A warning is one line, like an error.
    """
    output = _replace("stdout", 1)
    _replace("stderr", 2)
    warnings.showwarning = _one_line
    try:
        yield
    except SystemExit as end:
        sys.stdout.flush()
        if output.error is None or output.error.errno == EPIPE:
            raise
        reason = output.error.strerror
        sys.stderr.write(f"transport: standard output: cannot write the results ({reason})\n")
        sys.exit(end.code or EXIT_UNRECORDED)


def _one_line(message: Warning | str, *_: object, **__: object) -> None:
    """Write a warning; the line of code that gives it says nothing to a user."""
    sys.stderr.write(f"transport: warning: {message}\n")


def _replace(name: str, number: int) -> _Stream:
    """Replace a stream of `sys`; one that is closed goes to the null device."""
    old: TextIO | None = getattr(sys, name)
    descriptor = number if old is not None else os.open(os.devnull, os.O_WRONLY)
    raw = _Stream(descriptor, "wb", closefd=False)
    is_buffered = name == "stdout" and not raw.isatty()
    stream = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=old.encoding if old is not None else "utf-8",
        errors="backslashreplace",  # a character that the terminal has not is no reason to end
        line_buffering=not is_buffered,
        write_through=not is_buffered,
    )
    setattr(sys, name, stream)
    return raw
