"""Answers of commands: results on standard output, errors on one line of standard error."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from typing import Any, NoReturn

import orjson
import typer


class Format(StrEnum):
    """Formats of results."""

    text = "text"
    json = "json"


def fail(text: str, code: int) -> NoReturn:
    """End the command with one line of error and an exit code."""
    typer.echo(f"transport: {text}", err=True)
    raise typer.Exit(code)


@contextmanager
def exit_on(*errors: type[Exception], code: int = 1, option: str = "") -> Iterator[None]:
    """End the command with the text of an error, if one of these types is raised.

    Args:
        errors: Types that are the user's to solve; others are bugs and keep their traceback.
        code: Exit code, unless the error has one.
        option: Option that caused it, for the beginning of the line.
    """
    try:
        yield
    except errors as error:
        fail(f"{option}: {error}" if option else str(error), getattr(error, "exit_code", code))


def show_json(content: Any) -> None:
    """Write one JSON value to standard output."""
    sys.stdout.write(orjson.dumps(content, option=orjson.OPT_INDENT_2).decode() + "\n")
