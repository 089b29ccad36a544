"""Calls of classes of the user: their errors in one line."""

import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from transport.model.arrays import Array

_PROGRAM = "transport."  # beginning of the names of the program's modules
_FOREIGN_FILE = re.compile(r"<|.*(site|dist)-packages")
_STANDARD_LIBRARY = sysconfig.get_path("stdlib")

# Characters of an error that is passed on: it travels in messages, with the name of the class.
_LONGEST_TEXT = 400


class OwnClassError(ValueError):
    """A class of the user that cannot be used, or that has failed; one line."""


def new_object(make: Callable[..., Any], methods: Sequence[str], *arguments: object) -> Any:
    """Return a new object of a class.

    Raises: OwnClassError: its constructor fails, or it lacks one of the methods.
    """
    with errors_of("the constructor"):
        instance = make(*arguments)
        for name in methods:
            if not callable(getattr(instance, name, None)):
                raise OwnClassError(f"expected the methods {', '.join(methods)}, got no {name}")
    return instance


def real_array(given: object) -> Array:
    """Return a copy of a real array, finite or not, that a method returned.

    Complex numbers and texts raise.
    """
    return np.array(given).astype(np.float64, casting="same_kind")


def _raised(call: str, words: str) -> str:
    return f"{call} raised {words}"


@contextmanager
def errors_of(call: str, wording: Callable[[str, str], str] = _raised) -> Iterator[None]:
    """Turn exceptions of a call of a class into OwnClassError, with file and line.

    What a class returns is its code as well: an object runs some when it is converted or printed, so
    this surrounds the conversion too. Output goes to standard error.

    Args:
        call: What is called.
        wording: Text of the error, from the call and the exception in words.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except (KeyboardInterrupt, OwnClassError):
        raise
    except BaseException as error:
        text = printable(wording(call, _in_words(error)))
        place = "".join(map(_shown, _place_of(error)))
        raise OwnClassError(f"{text}{place}") from error


def printable(text: str) -> str:
    """Return a text in one line of limited length that messages, files and terminals can hold."""
    # Methods of str itself: a text of the user's may be of a class with its own.
    line = " ".join(str.split(text))[:_LONGEST_TEXT]
    return "".join(map(_shown, line))


def _shown(character: str) -> str:
    """Return a character if it can be printed and encoded."""
    return character if character.isprintable() else "?"


def _in_words(error: BaseException) -> str:
    """Return an exception in one line; its type alone where its text cannot be made."""
    name = type(error).__name__
    try:
        return printable(f"{name}: " + printable(str(error)))
    except KeyboardInterrupt:
        raise
    except BaseException:  # noqa: BLE001  # the text is made by the user's code
        return printable(f"{name}, whose text cannot be made")


def _place_of(error: BaseException) -> str:
    """Return file and line of the user's code that raised an exception; empty if none did."""
    frames = list(traceback.walk_tb(error.__traceback__))
    for frame, line in reversed(frames):
        file = frame.f_code.co_filename
        if not _is_of_program(frame) and not _is_foreign(file):
            return f" ({Path(file).name}:{line})"
    return ""


def _is_of_program(frame: FrameType) -> bool:
    """Return whether a frame runs code of the program."""
    return str(frame.f_globals.get("__name__", "")).startswith(_PROGRAM)


def _is_foreign(file: str) -> bool:
    """Return whether a file of code is one of Python or of an installed package, or no file."""
    is_of_python = Path(file).is_relative_to(_STANDARD_LIBRARY)
    return is_of_python or _FOREIGN_FILE.match(file) is not None
