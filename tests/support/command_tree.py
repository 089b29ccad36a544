"""The commands of the command line, imported and by their names."""

from collections.abc import Iterator, Sequence

from typer.core import TyperCommand, TyperGroup

from transport.cli.lazy import LazyGroup
from transport.cli.main import command

Command = TyperCommand | TyperGroup


def root() -> LazyGroup:
    """Return the command line as users have it."""
    group = command()
    assert isinstance(group, LazyGroup)
    return group


def below(group: TyperGroup) -> dict[str, Command]:
    """Return the commands of a group by name."""
    assert isinstance(group, LazyGroup)
    found: dict[str, Command] = {}
    for name, stand_in in group.commands.items():
        command = group.load(name) if name in group.table else stand_in
        assert isinstance(command, TyperCommand | TyperGroup)
        found[name] = command
    return found


def command_of(words: Sequence[str]) -> tuple[Command, list[str], list[str]]:
    """Return the command or group that words name, the names on the way to it, and the remaining words."""
    found: Command = root()
    names: list[str] = []
    rest = list(words)
    while isinstance(found, TyperGroup) and rest and rest[0] in found.commands:
        names.append(rest.pop(0))
        found = below(found)[names[-1]]
    return found, names, rest


def every_command(group: TyperGroup) -> Iterator[Command]:
    """Yield a group and all commands below it."""
    yield group
    for one in below(group).values():
        yield from every_command(one) if isinstance(one, TyperGroup) else (one,)
