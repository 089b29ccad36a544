"""How commands read their scenario and answer: the formats of results, and the one line of a refusal."""

import sys
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from protocol.wire.exit_codes import EXIT_SCENARIO

if TYPE_CHECKING:
    from protocol.scenario.setup import Setup


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


def read_setup(scenario: str, settings: list[str] | None) -> "Setup":
    """The run that a command is about; a scenario that is refused ends the command.

    Args:
        scenario: File, or name of a ready one.
        settings: Changes, KEY=VALUE.
    """
    from protocol.scenario.file import ScenarioError, find_scenario

    try:
        path = find_scenario(scenario)
        return _setup(path, tuple(settings or ()), _written(path))
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)


def _written(path: Path) -> tuple[int, ...]:
    """What changes when a file is written anew; nothing where there is none."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


@lru_cache(maxsize=1)
def _setup(path: Path, settings: tuple[str, ...], _: tuple[int, ...]) -> "Setup":
    """A file's run, remembered until the file is written anew."""
    from protocol.scenario.file import read_scenario
    from protocol.scenario.setup import Setup

    return Setup.of(read_scenario(path, settings), str(path))


def show_json(content: Any) -> None:
    """Write one JSON value to standard output."""
    import orjson

    sys.stdout.write(orjson.dumps(content, option=orjson.OPT_INDENT_2).decode() + "\n")
