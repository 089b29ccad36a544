"""Command groups that import a command when it is called: `--help` and other commands do not pay for its imports."""

import gc
from collections.abc import Mapping
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

_PLAIN: dict[str, Any] = {"add_completion": False, "pretty_exceptions_enable": False, "rich_markup_mode": None}

# By name of the command: "module:function" and the line in the list of commands.
Table = Mapping[str, tuple[str, str]]


def import_function(target: str) -> Any:
    """Return the function of a text "module:function", importing the module."""
    module, _, function = target.partition(":")
    return getattr(load(module), function)


def load(module: str) -> Any:
    """Import a module without garbage collections: they find nothing, and take a tenth of the time."""
    gc.disable()
    try:
        return import_module(module)
    finally:
        gc.enable()


class LazyGroup(TyperGroup):
    """Group whose `commands` are stand-ins with a name and one line of help until one of them is called."""

    table: ClassVar[Table] = {}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = {
            **{name: TyperCommand(name, short_help=line) for name, (_, line) in self.table.items()},
            **self.commands,
        }

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and remaining arguments, with the stand-in replaced by the imported command."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, self.load(name) if name and name in self.table else command, rest

    def load(self, name: str) -> Any:
        """Import the command of a name in the table."""
        single = typer.Typer(**_PLAIN)
        single.command(name)(import_function(self.table[name][0]))
        return typer.main.get_command(single)


def lazy_group(table: Table, **options: Any) -> typer.Typer:
    """Return a group of the commands in a table, with further options of `typer.Typer`, such as help and epilog."""
    return typer.Typer(cls=type("Group", (LazyGroup,), {"table": table}), no_args_is_help=True, **_PLAIN, **options)
