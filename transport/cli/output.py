"""Answers of commands: results on standard output, errors on one line of standard error."""

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from typing import Any, NoReturn

import orjson
import typer

from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE, TransportError

# Columns of tables in a file or pipe, where no terminal says how many there are.
_FILE_WIDTH = 120


class Format(StrEnum):
    """Formats of results."""

    text = "text"
    json = "json"


def fail(text: str, code: int = EXIT_USAGE) -> NoReturn:
    """End the command with one line of error and an exit code."""
    typer.echo(f"transport: {text}", err=True)
    raise typer.Exit(code)


@contextmanager
def blame(option: str, *errors: type[Exception]) -> Iterator[None]:
    """Name an option in front of an error that it has caused.

    That is an error which the user can solve, one of a file, or one of the given types.
    """
    solvable: tuple[type[Exception], ...] = (TransportError, *errors)
    try:
        yield
    except OSError as error:
        fail(f"{option}: cannot write {error.filename} ({error.strerror or error})")
    except solvable as error:
        fail(f"{option}: {error}", getattr(error, "exit_code", EXIT_USAGE))


def show(output: Format, content: Any, *shown: Any, width: int = 0) -> None:
    """Print a result as one JSON value, or as texts and tables of at least a width."""
    if output is Format.json:
        sys.stdout.write(orjson.dumps(content, option=orjson.OPT_INDENT_2).decode() + "\n")
        sys.stdout.flush()
        return
    from rich.console import Console  # no process of a run needs it

    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        width = max(width, _FILE_WIDTH)
    console.width = max(console.width, width)
    for part in shown:
        if isinstance(part, str):
            typer.echo(part)
        else:
            console.print(part)


def facts(content: Iterable[tuple[str, Any]]) -> Any:
    """Return a table with a row for each name and value."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for name, value in content:
        table.add_row(Text(name, "cyan"), _cell(value))
    return table


def rows(content: Sequence[Mapping[str, Any]], *left: str) -> Any:
    """Return a table with a column for each key of the rows.

    The columns in `left` are aligned to the left.
    """
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in content[0]:
        table.add_column(name, justify="left" if name in left else "right")
    for row in content:
        table.add_row(*map(_cell, row.values()))
    return table


def _cell(value: Any) -> Any:
    """Return a value as text.

    Numbers have four digits, entries of lists follow one another, none is "-".
    """
    from rich.text import Text

    if isinstance(value, Text):
        return value
    if value is None:
        return Text("-")
    if isinstance(value, float):
        return Text(f"{value:.4g}")
    if isinstance(value, list | tuple):
        return Text(" ".join(map(str, value)))
    return Text(str(value))
