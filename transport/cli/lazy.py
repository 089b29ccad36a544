"""Command groups that import a command when it is called.

`--help` and other commands do not pay for its imports. Errors of all commands become one line and
an exit code here.
"""

import gc
import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_origin

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from transport.flight.signals import deferred_interrupts

_PLAIN: dict[str, Any] = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
# As in protocol.wire.errors_and_exit_codes, which `--help` does not import.
_USAGE = 2

# Beginning of the example in a docstring; after \b the paragraph is not wrapped.
_EXAMPLE = "\n\nExample:"
_UNWRAPPED_EXAMPLE = "\n\n\b\nExample:"
# Optional packages, and the extra that installs each.
_EXTRAS = {
    "cryptography": "deploy",
    "prometheus_client": "metrics",
    "pyarrow": "parquet",
    "pymavlink": "flight",
    "rosbags": "ros2",
}

# A command: "module:function" below transport.cli, or "module:TABLE" with functions by name, and its
# line in the list of commands.
Entry = tuple[str, str]


def load(module: str) -> Any:
    """Import a module without garbage collections, and leave what is imported out of later ones.

    They find nothing, and take a tenth of the time.
    """
    gc.disable()
    try:
        with deferred_interrupts():
            return import_module(module)
    finally:
        gc.freeze()
        gc.enable()


class Command(TyperCommand):
    """Command that tells an error which the user can solve in one line.

    Its help keeps the example on one line.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if self.help:
            self.help = self.help.replace(_EXAMPLE, _UNWRAPPED_EXAMPLE)

    def build_parsers(self) -> None:
        """Build the parsers of the options, which are otherwise built when the command is called."""
        for parameter in self.params:
            if isinstance(parameter, TyperArgument | TyperOption):
                parameter.get_runtime_param()

    def invoke(self, ctx: Any) -> Any:
        """Run the command; other errors are bugs and keep their traceback."""
        from transport.protocol.wire.errors_and_exit_codes import TransportError

        try:
            return super().invoke(ctx)
        except TransportError as error:
            text = _blamed(error, ctx.params.get("settings") or [])
            code = error.exit_code
        except OSError as error:
            text = _file_problem(error)
            code = _USAGE
            if not text:
                raise
        except ModuleNotFoundError as error:
            if error.name not in _EXTRAS:
                raise
            extra = f"pip install 'payload-transport[{_EXTRAS[error.name]}]'"
            text = f"expected the package {error.name}, got none: {extra}"
            code = _USAGE
        typer.echo(f"transport: {text}", err=True)
        raise typer.Exit(code)


def _blamed(error: Exception, settings: Sequence[str]) -> str:
    """Return the text of an error, which names the settings that caused it."""
    from transport.protocol.scenario.sections.scenario_errors import ScenarioError

    return str(error.blaming(settings) if isinstance(error, ScenarioError) else error)


def _file_problem(error: OSError) -> str:
    """Return the text of an error that the user can solve; empty for another one."""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if _current_folder_is_gone():
        return "expected a current folder, got one that has been removed"
    return ""


def _current_folder_is_gone() -> bool:
    """Return whether the folder in which the command was started has been removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return True
    return False


class LazyGroup(TyperGroup):
    """Group whose commands are stand-ins until they are called.

    A stand-in has a name and one line of help.
    """

    table: ClassVar[Mapping[str, Entry]] = {}
    # Names of commands and groups by heading of the help.
    sections: ClassVar[Mapping[str, Sequence[str]]] = {}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._loaded: dict[str, Any] = {}
        commands: dict[str, Any] = {
            name: TyperCommand(name, short_help=line) for name, (_, line) in self.table.items()
        }
        commands |= self.commands
        self.commands = {name: commands[name] for names in self.sections.values() for name in names}

    def main(self, *arguments: Any, **options: Any) -> Any:
        """Run the command line; a usage error is one line, like every other error."""
        if os.environ.get("_TRANSPORT_COMPLETE"):
            from transport.cli.setting_words import rejoin_settings

            rejoin_settings()
        try:
            code = super().main(*arguments, **options | {"standalone_mode": False})
        except typer.TyperException as error:
            context = getattr(error, "ctx", None)
            path = "transport" if context is None else context.command_path
            text = _usage_problem(error)
            typer.echo(f"transport: {text[:1].lower()}{text[1:]} ({path} --help)", err=True)
            code = error.exit_code

        sys.exit(code if isinstance(code, int) else 0)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Return the arguments after the options of the group.

        Without any arguments the help is printed instead.
        """
        if not args and not ctx.resilient_parsing:
            typer.echo(ctx.get_help(), err=True)
            raise typer.Exit(_USAGE)
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and remaining arguments.

        A stand-in is replaced by the imported command.
        """
        name, command, rest = super().resolve_command(ctx, args)
        if name and name in self.table:
            command = self.load(name)
        return name, command, rest

    def load(self, name: str) -> Any:
        """Import the command of a name in the table, once."""
        if name in self._loaded:
            return self._loaded[name]

        module, _, function_name = self.table[name][0].partition(":")
        function = getattr(load(f"transport.cli.{module}"), function_name)
        if isinstance(function, dict):
            function = function[name]
        settings = getattr(function, "context_settings", None)

        single = typer.Typer(**_PLAIN)
        single.command(name, cls=Command, context_settings=settings)(function)
        self._loaded[name] = typer.main.get_command(single)
        return self._loaded[name]

    def format_commands(self, _: Any, formatter: Any) -> None:
        """Write a list of commands under each heading, with equal columns."""
        width = max(map(len, self.commands))
        most = formatter.width - 6 - width
        for heading, names in self.sections.items():
            lines = [
                (name.ljust(width), self.commands[name].get_short_help_str(most)) for name in names
            ]
            with formatter.section(heading):
                formatter.write_dl(lines)


def _usage_problem(error: Any) -> str:
    """Return a usage error in one line, with the value that was given."""
    text = " ".join(error.format_message().split()).rstrip(".")
    problems: list[Any] = getattr(error.__cause__, "errors", list)()  # pydantic's
    if not problems:
        return text

    text = text.replace("Input should be", "expected").replace("Value error, ", "")
    given = repr(problems[0]["input"])
    return text if given in text else f"{text}, got {given}"


def lazy_group(
    sections: Mapping[str, Mapping[str, Entry | typer.Typer]], **options: Any
) -> typer.Typer:
    """Return a group of commands and groups under headings.

    `options` are those of `typer.Typer`, such as help and epilog.
    """
    entries = {name: entry for members in sections.values() for name, entry in members.items()}
    attributes = {
        "table": {name: entry for name, entry in entries.items() if isinstance(entry, tuple)},
        "sections": {heading: list(members) for heading, members in sections.items()},
    }
    group_class = type("Group", (LazyGroup,), attributes)
    group = typer.Typer(cls=group_class, **_PLAIN | options)

    for name, entry in entries.items():
        if isinstance(entry, typer.Typer):
            group.add_typer(entry, name=name)
    return group


def with_options(
    *options: Callable[..., Any],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command shared options, after its own.

    The annotated parameters of all `options`, but those that a `partial` has bound, become options,
    and their results the first arguments of the command.
    """
    shared = [_parameters_of(option) for option in options]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        # Typer reads the options from the signature: those of the command itself, without its
        # first parameters, which take the results, and then all shared ones.
        parameters = list(inspect.signature(command).parameters.values())[len(options) :]
        for by_name in shared:
            parameters += by_name.values()

        @wraps(command)
        def with_shared(**given: Any) -> None:
            results = []
            for option, by_name in zip(options, shared, strict=True):
                arguments = {name: given.pop(name) for name in by_name}
                results.append(option(**arguments))
            command(*results, **given)

        with_shared.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_shared.__annotations__ = {
            parameter.name: parameter.annotation for parameter in parameters
        }
        return with_shared

    return decorate


def _parameters_of(option: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the annotated parameters of shared options that a `partial` has not bound."""
    bound = getattr(option, "keywords", ())
    return {
        name: parameter
        for name, parameter in inspect.signature(option).parameters.items()
        if get_origin(parameter.annotation) is Annotated and name not in bound
    }
