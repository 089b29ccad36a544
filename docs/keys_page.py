"""Renew the tables of docs/keys.md from the sections of a scenario: part of `make reference`.

The page has headings and text; each table stands below the name of its section, in a comment.
"""

import re
import sys
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo
from tables import ROOT, table

from protocol.scenario.keys import key_of, meanings, section_in, unit_of, walk
from protocol.scenario.link_sections import LinkSection

DOCUMENT = ROOT / "docs" / "keys.md"
_TABLE = re.compile(r"(<!-- keys of (\S+) -->\n).*?(\n<!-- end of keys -->)", re.DOTALL)
_NOUNS = {int: "integer", float: "number", str: "text", bool: "true, false"}
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def page() -> str:
    """Return the page with its tables renewed.

    Raises: SystemExit: a key without a docstring, or a section without a table on the page.
    """
    left = tables()
    text = _TABLE.sub(lambda found: found[1] + left.pop(found[2]) + found[3], DOCUMENT.read_text(encoding="utf-8"))
    if left:
        raise SystemExit(f"{DOCUMENT}: expected a table of {', '.join(left)}, got none")
    return text


def tables() -> dict[str, str]:
    """Return the table of each section by its path; those of `[links]` are not repeated in sections like it."""
    rows: dict[str, list[list[str]]] = {}
    for path, key, section, field in walk():
        of_link = path.endswith(".gilbert_elliott") or LinkSection.model_fields.get(key) is not None
        is_repeated = of_link and path.startswith("links.") and path != "links.gilbert_elliott"
        if section_in(field.annotation) or is_repeated:
            continue
        meaning = meanings(section).get(key)
        if not meaning:
            raise SystemExit(f"{section.__module__}.{section.__name__}, {key}: expected a docstring, got none")
        kind = key_of(field).type or type_of(field.annotation, field.metadata)
        row = [f"`{key}`", kind, unit_of(key, field), _default(field), meaning]
        rows.setdefault(path or "scenario", []).append(row)
    columns = ["key", "type", "unit", "default", "meaning"]
    return {path: table(columns, cells) for path, cells in rows.items()}


def type_of(annotation: Any, metadata: list[Any] | tuple[Any, ...] = ()) -> str:
    """Return a type and its range as text, such as "3 numbers > 0" or "daqp, clarabel"."""
    arguments = get_args(annotation)
    if type(None) in arguments:
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return type_of(inner, metadata)
    if hasattr(annotation, "__metadata__"):
        return type_of(annotation.__origin__, (*annotation.__metadata__, *metadata))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(annotation) in (list, tuple):
        noun, limits = type_of(arguments[0]).partition(" ")[::2]
        return f"{_count(metadata)} {noun}s {limits}".strip()
    return f"{_NOUNS[annotation]}{_range(metadata)}".strip()


def _count(metadata: list[Any] | tuple[Any, ...]) -> str:
    """Return how many entries a list has: a number where it is fixed, else "list of"."""
    if any(getattr(getattr(entry, "func", None), "__name__", "") == "_three_numbers" for entry in metadata):
        return "3"
    sizes = {getattr(entry, end, None) for entry in metadata for end in ("min_length", "max_length")} - {None}
    return str(sizes.pop()) if len(sizes) == 1 else "list of"


def _range(metadata: list[Any] | tuple[Any, ...]) -> str:
    """Return the limits of a number as text, such as " > 0, < 90" or ", 0 to 1"; "" for none."""
    found = {name: value for name in _SIGNS for e in metadata if (value := getattr(e, name, None)) is not None}
    limits = {name: f"{end:,}".replace(",", " ") if end >= 10_000 else f"{end:g}" for name, end in found.items()}
    if limits.keys() == {"ge", "le"}:
        return f", {limits['ge']} to {limits['le']}"
    return " " + ", ".join(f"{sign} {limits[name]}" for name, sign in _SIGNS.items() if name in limits)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    return "left out" if field.default is None else f"`{toml(field.default)}`"


def toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


if __name__ == "__main__":
    DOCUMENT.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{DOCUMENT}\n")
