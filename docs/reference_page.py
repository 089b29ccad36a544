"""Renew docs/reference/keys.md and docs/reference/commands.md from the sections of a scenario and the commands.

`make reference`.

The page of keys has headings and text; each list stands below the name of its section, in a
comment.
"""

import json
import re
from collections import Counter
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
_SEVERAL = 3  # commands with the same option, from which on it is listed once
_MOST = 10  # commands that are named one by one
_BLANKS = re.compile(r"\n{3,}")
_TAG = re.compile(r"(?<! )<(?=[a-z])")  # that a page in Markdown would take for one of HTML
_READY = re.compile(r", or name: [\w, ]+\.")  # names of ready scenarios, which docs/scenario.md has
_OPTION = re.compile(r"^\* `--.*$", re.MULTILINE)
_LIST = re.compile(r"(<!-- keys of (\S+) -->\n).*?(\n<!-- end of keys -->)", re.DOTALL)
_NOUNS = {int: "integer", float: "number", str: "text", bool: "true, false"}
_LARGE = 10_000
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def commands_page() -> str:
    """Return the page of commands: options that several share, then each command."""
    described = _descriptions()
    shared = dict(sorted(_shared(described).items()))
    lists = [f"{line} ({', '.join(names)})" if names else line for line, names in shared.items()]
    parts = [_COMMANDS_HEAD, "## Shared options\n\n" + "\n".join(lists)]
    for name, description in described.items():
        parts.append(f"## `{name}`\n\n{_with_shared(description, shared)}")
    return "\n\n".join(parts).rstrip() + "\n"


def _descriptions() -> dict[str, str]:
    """Return the help of each command in Markdown, by its name, without what the page says elsewhere."""
    root = typer.main.get_command(app)
    _load(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root), name="transport")
    text = text.replace("\b\n", "")  # marks of paragraphs that are not wrapped
    text = _TAG.sub("&lt;", text)
    text = _READY.sub(" or name.", text)

    _, *headed = re.split(r"^#+ `(transport[^`]*)`\n", text, flags=re.MULTILINE)
    named = zip(headed[::2], headed[1::2], strict=True)
    return {name: _BLANKS.sub("\n\n", _LEFT_OUT.sub("", part)).strip() for name, part in named}


def _shared(described: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the lines of options that several commands have, with the names of these commands.

    There are no names where the option has the same meaning in all commands.
    """
    commands_of: dict[str, list[str]] = {}
    for name, part in described.items():
        for line in _OPTION.findall(part):
            commands_of.setdefault(line, []).append(name.removeprefix("transport "))
    meanings_of = Counter(_flag(line) for line in commands_of)
    return {
        line: _of_group(names) if meanings_of[_flag(line)] > 1 else []
        for line, names in commands_of.items()
        if len(names) >= _SEVERAL
    }


def _flag(line: str) -> str:
    """Return the name of an option in its line, such as --set."""
    return line.split()[1].strip("`:")


def _of_group(names: Sequence[str]) -> list[str]:
    """Return names of commands, those of a group as the group."""
    groups = list(dict.fromkeys(name.partition(" ")[0] for name in names))
    return groups if len(groups) <= _MOST else ["most"]


def _with_shared(part: str, shared: Mapping[str, object]) -> str:
    """Return the description of a command with its shared options by name alone."""
    own = [line for line in _OPTION.findall(part) if line in shared]
    lines = [line for line in part.splitlines() if line not in own]
    listed = "\n".join(lines).strip()
    if own:
        names = ", ".join(f"`{_flag(line)}`" for line in own)
        listed += f"\n\n[Shared](#shared-options): {names}."
    return _BLANKS.sub("\n\n", listed)


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


def type_of(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Return a type and its range as text, such as "3 numbers > 0" or "daqp, clarabel"."""
    arguments = get_args(annotation)
    if type(None) in arguments:  # a value that may be left out
        (given,) = (argument for argument in arguments if argument is not type(None))
        return type_of(given, metadata)
    if hasattr(annotation, "__metadata__"):  # Annotated
        return type_of(annotation.__origin__, (*annotation.__metadata__, *metadata))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(annotation) in (list, tuple):
        noun, _, limits = type_of(arguments[0]).partition(" ")
        return f"{_count(metadata)} {noun}s {limits}".strip()
    return f"{_NOUNS[annotation]}{_range(metadata)}".strip()


def _count(metadata: Sequence[Any]) -> str:
    """Return how many entries a list has: a number where it is fixed, else "list of"."""
    validators = [getattr(entry, "func", None) for entry in metadata]
    if any(getattr(function, "__name__", "") == "_three_numbers" for function in validators):
        return "3"
    ends = [getattr(entry, end, None) for entry in metadata for end in ("min_length", "max_length")]
    sizes = {size for size in ends if size is not None}
    return str(sizes.pop()) if len(sizes) == 1 else "list of"


def _range(metadata: Sequence[Any]) -> str:
    """Return the limits of a number as text, such as " > 0, < 90" or ", 0 to 1"; "" for none."""
    limits = {}
    for sign in _SIGNS:
        ends = [getattr(entry, sign, None) for entry in metadata]
        given = [end for end in ends if end is not None]
        if given:
            limits[sign] = _number(given[-1])
    if limits.keys() == {"ge", "le"}:
        return f", {limits['ge']} to {limits['le']}"
    return " " + ", ".join(f"{_SIGNS[sign]} {limit}" for sign, limit in limits.items())


def _number(value: float) -> str:
    """Return a limit as text, with blanks between thousands of a large one."""
    return f"{value:,}".replace(",", " ") if value >= _LARGE else f"{value:g}"


def _default(field: FieldInfo) -> str:
    """Return a default as TOML, whose numbers, texts and lists are those of JSON."""
    if field.is_required():
        return "required"
    return "left out" if field.default is None else f"`{json.dumps(field.default)}`"


if __name__ == "__main__":
    KEYS.write_text(keys_page(), encoding="utf-8")
    COMMANDS.write_text(commands_page(), encoding="utf-8")
