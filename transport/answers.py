"""How commands read their scenario and answer: the formats of results, and the one line of a refusal."""

import sys
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NoReturn

import typer

if TYPE_CHECKING:
    from protocol.setup import Setup

EXIT_SCENARIO = 3


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
    from protocol.scenario_file import ScenarioError, find_scenario, read_scenario
    from protocol.setup import Setup

    try:
        path = find_scenario(scenario)
        return Setup.of(read_scenario(path, settings or []), str(path))
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)


def show_json(content: Any) -> None:
    """Write one JSON value to standard output."""
    import orjson

    sys.stdout.write(orjson.dumps(content, option=orjson.OPT_INDENT_2).decode() + "\n")
