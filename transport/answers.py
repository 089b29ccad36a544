"""How commands answer: the formats of results, and the one line of a refusal."""

import sys
from enum import StrEnum
from typing import Any, NoReturn

import typer


class Format(StrEnum):
    """How results are printed."""

    text = "text"
    json = "json"


def fail(text: str, code: int) -> NoReturn:
    """End the command with one line for the user.

    Args:
        text: What was expected and what came.
        code: Exit code.
    """
    typer.echo(f"transport: {text}", err=True)
    raise typer.Exit(code)


def show_json(content: Any) -> None:
    """Write one JSON value to standard output."""
    import orjson

    sys.stdout.write(orjson.dumps(content, option=orjson.OPT_INDENT_2).decode() + "\n")
