"""Make docs/commands.md, every command with its options, from the commands themselves: part of `make reference`."""

import re
import sys

import typer
from tables import ROOT
from typer.cli import get_docs_for_click

from transport.cli.lazy import LazyGroup
from transport.cli.main import app

DOCUMENT = ROOT / "docs" / "commands.md"


def page() -> str:
    """Return the page."""
    root = typer.main.get_command(app)
    _load(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root), name="transport", title="Commands and options") + "\n"
    return re.sub(r"(?<! )<(?=[a-z])", "&lt;", text.replace("\b\n", ""))


def _load(group: object) -> None:
    """Put whole commands into a group and those below it, in the place of stand-ins."""
    if isinstance(group, LazyGroup):
        group.commands |= {name: group.load(name) for name in group.table}
        for command in group.commands.values():
            _load(command)


if __name__ == "__main__":
    DOCUMENT.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{DOCUMENT}\n")
