"""Command groups that import a command when it is called: `--help` and other commands do not pay for its imports."""

import gc
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

_PLAIN: dict[str, Any] = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
# As in protocol.wire.exit_codes, which `--help` does not import.
_USAGE, _INTERRUPTED = 2, 130
_EXAMPLE = "\n\nExample:"

# By name of the command: "module:function" and the line in the list of commands.
Table = Mapping[str, tuple[str, str]]
# Names of commands and groups under each heading of the help.
Sections = Mapping[str, Sequence[str]]


def load(module: str) -> Any:
    """Import a module without garbage collections: they find nothing, and take a tenth of the time."""
    gc.disable()
    try:
        return import_module(module)
    finally:
        gc.enable()


class Command(TyperCommand):
    """Command whose help keeps the example on one line."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if self.help:
            self.help = self.help.replace(_EXAMPLE, f"\n\n\b{_EXAMPLE[1:]}")  # \b: the paragraph is not wrapped


class LazyGroup(TyperGroup):
    """Group whose `commands` are stand-ins with a name and one line of help until one of them is called."""

    table: ClassVar[Table] = {}
    sections: ClassVar[Sections] = {}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = {
            **{name: TyperCommand(name, short_help=line) for name, (_, line) in self.table.items()},
            **self.commands,
        }

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the command line; a usage error is one line, like every other error."""
        run = partial(super().main, args, prog_name, complete_var, False, windows_expand_args, **extra)
        if not standalone_mode:
            return run()
        try:
            code = run()
        except typer.TyperException as error:
            context = getattr(error, "ctx", None)
            path = "transport" if context is None else context.command_path
            text = " ".join(error.format_message().split()).rstrip(".")
            typer.echo(f"transport: {text[:1].lower()}{text[1:]} ({path} --help)", err=True)
            code = error.exit_code
        except typer.Abort:
            code = _INTERRUPTED
        except OSError as error:
            if error.filename is None:
                raise
            typer.echo(f"transport: {error.filename}: {error.strerror}", err=True)
            code = _USAGE
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
        found = getattr(load(module), function)
        single.command(name, cls=Command, context_settings=getattr(found, "context_settings", None))(found)
        return typer.main.get_command(single)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of the help."""
        ordered = [name for names in self.sections.values() for name in names]
        return [*ordered, *(name for name in super().list_commands(ctx) if name not in ordered)]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a list of commands under each heading, with equal columns."""
        names = self.list_commands(ctx)
        width = max(map(len, names))
        for heading, members in (self.sections or {"Commands": names}).items():
            with formatter.section(heading):
                room = formatter.width - 6 - width
                formatter.write_dl(
                    [(name.ljust(width), self.commands[name].get_short_help_str(room)) for name in members]
                )


def lazy_group(table: Table, sections: Sections | None = None, **options: Any) -> typer.Typer:
    """Return a group of the commands in a table, with further options of `typer.Typer`, such as help and epilog.

    Sections, if there are any, hold every command and group once.
    """
    group = type("Group", (LazyGroup,), {"table": table, "sections": sections or {}})
    return typer.Typer(cls=group, **_PLAIN | options)
