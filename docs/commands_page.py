"""Make docs/commands.md, every command with its options, from the commands themselves: part of `make reference`."""

import sys
from collections.abc import Iterator

import typer
from tables import ROOT, table
from typer.core import TyperArgument, TyperCommand, TyperOption

from transport.cli.lazy import LazyGroup
from transport.cli.main import app

DOCUMENT = ROOT / "docs" / "commands.md"
HEAD = """\
# Commands and options

Made by `make reference` from the commands; `transport COMMAND --help` shows the same. Exit codes and examples:
[command-line.md](command-line.md).
"""


def page() -> str:
    """Return the page."""
    root = typer.main.get_command(app)
    if not isinstance(root, LazyGroup):
        raise SystemExit(f"transport: expected a group of commands, got {type(root).__name__}")
    return HEAD + "".join(f"\n{_command(name, command)}" for name, command in _commands("transport", root))


def _commands(name: str, group: LazyGroup) -> Iterator[tuple[str, TyperCommand]]:
    """Yield every command below a group with its whole name."""
    for own, stand_in in group.commands.items():
        found = group.load(own) if own in group.table else stand_in
        if isinstance(found, LazyGroup):
            yield from _commands(f"{name} {own}", found)
        elif isinstance(found, TyperCommand):
            yield f"{name} {own}", found


def _command(name: str, command: TyperCommand) -> str:
    first, *rest = (command.help or "").replace("\b\n", "").strip().split("\n\n")
    rows = [row for parameter in command.params if (row := _row(parameter)) is not None]
    parts = [f"## {name}", first.strip(), *map(_paragraph, rest)]
    if rows:
        parts.append(table(["option", "default", "meaning"], rows))
    return "\n\n".join(parts) + "\n"


def _paragraph(text: str) -> str:
    """Return a paragraph of a help text; examples are command lines."""
    lines = [line.strip() for line in text.strip().splitlines()]
    if not lines[0].startswith(("Example:", "Examples:")):
        return "\n".join(lines)
    commands = [line.removeprefix("Examples:").removeprefix("Example:").strip() for line in lines]
    return "\n".join(["```", *(line for line in commands if line), "```"])


def _row(parameter: object) -> list[str] | None:
    """Return name, default and meaning of an option or argument; None for one that is not shown."""
    if isinstance(parameter, TyperArgument):
        name = f"`{parameter.metavar or str(parameter.name).upper()}`"
    elif isinstance(parameter, TyperOption) and not parameter.hidden:
        value = f" {parameter.metavar}" if parameter.metavar else ""
        name = ", ".join(f"`{option}{value}`" for option in (*parameter.opts, *parameter.secondary_opts))
    else:
        return None
    given = getattr(parameter.default, "value", parameter.default)  # of an enumeration
    default = f"`{given}`" if isinstance(given, str | int | float) else ""
    if isinstance(given, bool):
        default = f"`{parameter.opts[0]}`" if given else ""
    if parameter.required:
        default = "required"
    meaning = " ".join((parameter.help or "").split()) + _range(parameter)
    return [cell.replace("|", "\\|") for cell in (name, default, meaning.replace("<", "&lt;"))]


def _range(parameter: TyperArgument | TyperOption) -> str:
    """Return the limits of a number as text; "" for none."""
    low, high = (getattr(parameter, end, None) for end in ("min", "max"))
    if low is not None and high is not None:
        return f" ({low:g} to {high:g})"
    return f" (>= {low:g})" if low is not None else f" (<= {high:g})" if high is not None else ""


if __name__ == "__main__":
    DOCUMENT.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{DOCUMENT}\n")
