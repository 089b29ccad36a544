"""Renew docs/reference/keys.md and docs/reference/commands.md from the sections of a scenario and the commands.

`make reference`.

The page of keys has headings and text; each list stands below the name of its section, in a
comment.
"""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args, get_origin

import typer
from pydantic.fields import FieldInfo
from tables import ROOT
from typer.cli import get_docs_for_click

from transport.cli.lazy import LazyGroup
from transport.cli.main import app
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.protocol.scenario.sections.scenario_keys import (
    key_of,
    meanings,
    section_in,
    unit_of,
    walk,
)
from transport.protocol.scenario.sections.schema import Scenario

KEYS, COMMANDS = (
    ROOT / "docs" / "reference" / "keys.md",
    ROOT / "docs" / "reference" / "commands.md",
)
_COMMANDS_HEAD = """\
# Commands and options

Made by `make reference` from the help texts. Every command explains itself, with an example, by `-h` or
`--help`. Arguments come before options."""
# Parts of a command's description that its name, arguments and sections say.
_LEFT_OUT = re.compile(
    r"\*\*Usage\*\*:\n\n```console\n(?:.*\n)*?```\n|\*\*Commands\*\*:\n\n(?:\* .*\n)+"
    r"|\*\*(?:Arguments|Options)\*\*:\n+|^\* `--help`: .*\n|^Example: .*\n(?:\S.*\n)*",
    re.MULTILINE,
)
_MOST = 10  # commands that are named one by one
_READY = re.compile(r", or name: [\w, ]+\.")  # names of ready scenarios, which docs/scenario.md has
_OPTION = re.compile(r"^\* `--.*$", re.MULTILINE)
_LIST = re.compile(r"(<!-- keys of (\S+) -->\n).*?(\n<!-- end of keys -->)", re.DOTALL)
_NOUNS = {int: "integer", float: "number", str: "text", bool: "true, false"}
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def commands_page() -> str:
    """Return the page of commands: options that several share, then each command."""
    root = typer.main.get_command(app)
    _load(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root), name="transport")
    text = _READY.sub(" or name.", re.sub(r"(?<! )<(?=[a-z])", "&lt;", text.replace("\b\n", "")))
    parts = re.split(r"^#+ `(transport[^`]*)`\n", text, flags=re.MULTILINE)
    described = {
        name: re.sub(r"\n{3,}", "\n\n", _LEFT_OUT.sub("", part)).strip()
        for name, part in zip(parts[1::2], parts[2::2], strict=True)
    }
    shared = dict(sorted(_shared(described).items()))
    sections = [f"## `{name}`\n\n{_with_shared(part, shared)}" for name, part in described.items()]
    lists = "\n".join(
        f"{line} ({', '.join(names)})" if names else line for line, names in shared.items()
    )
    return (
        "\n\n".join(
            [
                _COMMANDS_HEAD,
                f"## Shared options\n\n{lists}",
                *sections,
                "",
            ]
        ).rstrip()
        + "\n"
    )


def _shared(described: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the options in several commands; with the names of these where others have another meaning."""
    of_option: dict[str, list[str]] = {}
    for name, part in described.items():
        for line in _OPTION.findall(part):
            of_option.setdefault(line, []).append(name.removeprefix("transport "))
    shared = {line: names for line, names in of_option.items() if len(names) > 2}
    flags = [line.split()[1] for line in of_option]
    return {
        line: [] if flags.count(line.split()[1]) == 1 else _of_group(names)
        for line, names in shared.items()
    }


def _of_group(names: Sequence[str]) -> list[str]:
    """Return names of commands, those of a group as the group."""
    groups = list(dict.fromkeys(name.partition(" ")[0] for name in names))
    return groups if len(groups) <= _MOST else ["most"]


def _with_shared(part: str, shared: Mapping[str, object]) -> str:
    """Return the description of a command with its shared options by name."""
    own = [line for line in _OPTION.findall(part) if line in shared]
    for line in own:
        part = (
            part.replace(f"{line}\n", "", 1) if f"{line}\n" in part else part.replace(line, "", 1)
        )
    names = ", ".join(f"`{line.split()[1].strip('`:')}`" for line in own)
    listed = part.strip() + (f"\n\n[Shared](#shared-options): {names}." if names else "")
    return re.sub(r"\n{3,}", "\n\n", listed)


def _load(group: object) -> None:
    """Put whole commands into a group and those below it, in the place of stand-ins."""
    if isinstance(group, LazyGroup):
        group.commands |= {name: group.load(name) for name in group.table}
        for command in group.commands.values():
            _load(command)


def keys_page() -> str:
    """Return the page of keys with its lists renewed.

    Those of `[links]` are not repeated in sections like it.

    Raises: SystemExit: a key without a docstring, or a section without a list on the page.
    """
    rows: dict[str, list[str]] = {}
    for path, key, section, field in walk(Scenario):
        of_link = path.endswith(".gilbert_elliott") or LinkSection.model_fields.get(key) is not None
        is_repeated = of_link and path.startswith("links.") and path != "links.gilbert_elliott"
        if section_in(field.annotation) or is_repeated:
            continue
        meaning = meanings(section).get(key)
        if not meaning:
            raise SystemExit(
                f"{section.__module__}.{section.__name__}, {key}: expected a docstring, got none"
            )
        kind = key_of(field).type or type_of(field.annotation, field.metadata)
        facts = [kind, unit_of(key, field), _default(field)]
        row = f"- `{key}` ({'; '.join(filter(None, facts))}): {meaning}"
        rows.setdefault(path or "scenario", []).append(row)

    def renewed(found: re.Match[str]) -> str:
        return "\n".join([found[1], *rows.pop(found[2]), found[3]])

    text = _LIST.sub(renewed, KEYS.read_text(encoding="utf-8"))
    if rows:
        raise SystemExit(f"{KEYS}: expected a list of {', '.join(rows)}, got none")
    return text


def type_of(annotation: Any, metadata: tuple[Any, ...] | list[Any] = ()) -> str:
    """Return a type and its range as text, such as "3 numbers > 0" or "daqp, clarabel"."""
    arguments = get_args(annotation)
    if type(None) in arguments:
        return type_of(
            next(argument for argument in arguments if argument is not type(None)), metadata
        )
    if hasattr(annotation, "__metadata__"):
        return type_of(annotation.__origin__, (*annotation.__metadata__, *metadata))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(annotation) in (list, tuple):
        noun, limits = type_of(arguments[0]).partition(" ")[::2]
        return f"{_count(metadata)} {noun}s {limits}".strip()
    return f"{_NOUNS[annotation]}{_range(metadata)}".strip()


def _count(metadata: tuple[Any, ...] | list[Any]) -> str:
    """Return how many entries a list has: a number where it is fixed, else "list of"."""
    if any(
        getattr(getattr(entry, "func", None), "__name__", "") == "_three_numbers"
        for entry in metadata
    ):
        return "3"
    sizes = {
        getattr(entry, end, None) for entry in metadata for end in ("min_length", "max_length")
    } - {None}
    return str(sizes.pop()) if len(sizes) == 1 else "list of"


def _range(metadata: tuple[Any, ...] | list[Any]) -> str:
    """Return the limits of a number as text, such as " > 0, < 90" or ", 0 to 1"; "" for none."""
    found = {
        name: value
        for name in _SIGNS
        for e in metadata
        if (value := getattr(e, name, None)) is not None
    }
    limits = {
        name: f"{end:,}".replace(",", " ") if end >= 10_000 else f"{end:g}"
        for name, end in found.items()
    }
    if limits.keys() == {"ge", "le"}:
        return f", {limits['ge']} to {limits['le']}"
    return " " + ", ".join(
        f"{sign} {limits[name]}" for name, sign in _SIGNS.items() if name in limits
    )


def _default(field: FieldInfo) -> str:
    """Return a default as TOML, whose numbers, texts and lists are those of JSON."""
    if field.is_required():
        return "required"
    return "left out" if field.default is None else f"`{json.dumps(field.default)}`"


if __name__ == "__main__":
    KEYS.write_text(keys_page(), encoding="utf-8")
    COMMANDS.write_text(commands_page(), encoding="utf-8")
