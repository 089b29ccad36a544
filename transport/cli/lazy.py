"""Command groups that import a command when it is called: `--help` and other commands do not pay for its imports.

Errors of all commands become one line and an exit code here.
"""

import gc
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_origin

import typer
from typer.core import TyperCommand, TyperGroup

_PLAIN: dict[str, Any] = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
# As in protocol.wire.exit_codes, which `--help` does not import.
_USAGE = 2
_EXAMPLE = "\n\nExample:"
# Optional packages, and the extra that installs each.
_EXTRAS = {
    "cryptography": "deploy",
    "prometheus_client": "metrics",
    "pyarrow": "parquet",
    "rosbags": "ros2",
}

# A command: "module:function" below transport.cli, and its line in the list of commands.
Entry = tuple[str, str]


def load(module: str) -> Any:
    """Import a module without garbage collections: they find nothing, and take a tenth of the time."""
    gc.disable()
    try:
        return import_module(module)
    finally:
        gc.enable()


class Command(TyperCommand):
    """Command whose help keeps the example on one line, and that tells an error which the user can solve in a line."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if self.help:
            self.help = self.help.replace(
                _EXAMPLE, f"\n\n\b{_EXAMPLE[1:]}"
            )  # \b: the paragraph is not wrapped

    def invoke(self, ctx: Any) -> Any:
        """Run the command; other errors are bugs and keep their traceback."""
        from transport.protocol.scenario.errors import ScenarioError
        from transport.protocol.wire.errors import TransportError

        try:
            return super().invoke(ctx)
        except TransportError as error:
            blamed = (
                error.blaming(ctx.params.get("settings") or [])
                if isinstance(error, ScenarioError)
                else error
            )
            text, code = str(blamed), error.exit_code
        except OSError as error:
            if error.filename is not None:
                text = f"{error.filename}: {error.strerror}"
            elif _current_folder_is_gone():
                text = "expected a current folder, got one that has been removed"
            else:
                raise
            code = _USAGE
        except ModuleNotFoundError as error:
            if error.name not in _EXTRAS:
                raise
            extra = f"pip install 'payload-transport[{_EXTRAS[error.name]}]'"
            text, code = f"expected the package {error.name}, got none: {extra}", _USAGE
        typer.echo(f"transport: {text}", err=True)
        raise typer.Exit(code)


def _current_folder_is_gone() -> bool:
    """Return whether the folder in which the command was started has been removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return True
    return False


class LazyGroup(TyperGroup):
    """Group whose `commands` are stand-ins with a name and one line of help until one of them is called."""

    table: ClassVar[Mapping[str, Entry]] = {}
    sections: ClassVar[
        Mapping[str, Sequence[str]]
    ] = {}  # names of commands and groups by heading of the help

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        stand_ins = {
            name: TyperCommand(name, short_help=line) for name, (_, line) in self.table.items()
        }
        found = {**stand_ins, **self.commands}
        self.commands = {name: found[name] for names in self.sections.values() for name in names}

    def main(self, *arguments: Any, **options: Any) -> Any:
        """Run the command line; a usage error is one line, like every other error."""
        try:
            code = super().main(*arguments, **options | {"standalone_mode": False})
        except typer.TyperException as error:
            context = getattr(error, "ctx", None)
            path = "transport" if context is None else context.command_path
            text = " ".join(error.format_message().split()).rstrip(".")
            problems: list[Any] = getattr(
                error.__cause__, "errors", list
            )()  # pydantic's, without the given value
            if problems:
                given = repr(problems[0]["input"])
                text = text.replace("Input should be", "expected").replace("Value error, ", "")
                text += f", got {given}" * (given not in text)
            typer.echo(f"transport: {text[:1].lower()}{text[1:]} ({path} --help)", err=True)
            code = error.exit_code
        sys.exit(code if isinstance(code, int) else 0)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Return the arguments after the options of the group; without any, print the help instead."""
        if not args and not ctx.resilient_parsing:
            typer.echo(ctx.get_help(), err=True)
            raise typer.Exit(_USAGE)
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and remaining arguments, with the stand-in replaced by the imported command."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, self.load(name) if name and name in self.table else command, rest

    def load(self, name: str) -> Any:
        """Import the command of a name in the table."""
        module, _, function = self.table[name][0].partition(":")
        single = typer.Typer(**_PLAIN)
        found = getattr(load(f"transport.cli.{module}"), function)
        single.command(
            name, cls=Command, context_settings=getattr(found, "context_settings", None)
        )(found)
        return typer.main.get_command(single)

    def format_commands(self, _: Any, formatter: Any) -> None:
        """Write a list of commands under each heading, with equal columns."""
        width = max(map(len, self.commands))
        for heading, names in self.sections.items():
            with formatter.section(heading):
                lines = {
                    name: self.commands[name].get_short_help_str(formatter.width - 6 - width)
                    for name in names
                }
                formatter.write_dl([(name.ljust(width), line) for name, line in lines.items()])


def lazy_group(
    sections: Mapping[str, Mapping[str, Entry | typer.Typer]], **options: Any
) -> typer.Typer:
    """Return a group of commands and groups under headings, with options of `typer.Typer`, such as help and epilog."""
    entries = {name: entry for members in sections.values() for name, entry in members.items()}
    own = {
        "table": {name: entry for name, entry in entries.items() if isinstance(entry, tuple)},
        "sections": {heading: list(members) for heading, members in sections.items()},
    }
    group = typer.Typer(cls=type("Group", (LazyGroup,), own), **_PLAIN | options)
    for name, entry in entries.items():
        if isinstance(entry, typer.Typer):
            group.add_typer(entry, name=name)
    return group


def with_options(
    *options: Callable[..., Any],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command shared options, after its own.

    The annotated parameters of all `options`, but those that a `partial` has bound, become options, and their results
    the first arguments of the command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command).parameters.values())[len(options) :]
        shared = [
            {
                name: parameter
                for name, parameter in inspect.signature(option).parameters.items()
                if get_origin(parameter.annotation) is Annotated
                and name not in getattr(option, "keywords", ())
            }
            for option in options
        ]

        @wraps(command)
        def with_shared(**given: Any) -> None:
            made = [{name: given.pop(name) for name in names} for names in shared]
            command(
                *(option(**values) for option, values in zip(options, made, strict=True)), **given
            )

        parameters = [*own, *(parameter for of in shared for parameter in of.values())]
        with_shared.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_shared.__annotations__ = {
            parameter.name: parameter.annotation for parameter in parameters
        }
        return with_shared

    return decorate
