"""Keys of a scenario for people: section, type, range, unit, default and meaning.

Type, range and default come from the schema; unit and meaning from keys.toml beside this file, which has an entry for
each key and no other. docs/keys.md is made from both (`make reference`).
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from protocol.scenario.link_sections import LinkSection
from protocol.scenario.schema import Scenario
from protocol.scenario.sections import Section

MEANINGS = Path(__file__).with_name("keys.toml")
# These sections have the keys of a link besides their own; the tables do not repeat them.
LIKE_LINKS = ("links.measurement", "links.actuation", "links.override", "links.change")
_NOUNS = {int: "integer", float: "number", str: "text", bool: "true, false"}
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}

_NO_LIMIT = 2**40  # a limit above is that of the format, not of the key


class MeaningError(ValueError):
    """An entry that is missing in keys.toml, or has no key; the text names both."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """One key of a scenario.

    Attributes:
        name: Within its section.
        type: Noun and range, such as "number >= 0".
        unit: "" for none.
        default: As TOML; "required", or "left out" for no value.
        meaning: One sentence in Markdown without a full stop.
    """

    name: str
    type: str
    unit: str
    default: str
    meaning: str


@dataclass(frozen=True, slots=True, kw_only=True)
class KeySection:
    """One section of a scenario.

    Attributes:
        path: Dotted, "" for the top level.
        is_list: It may be given several times, as `[[path]]`.
        about: Markdown in front of the keys; "" for none.
        after: Markdown behind them.
        keys: Without those of a link in sections like `[links]`.
    """

    path: str
    is_list: bool
    about: str
    after: str
    keys: tuple[Key, ...]


def schema_sections(
    section: type[Section] = Scenario, path: str = "", is_list: bool = False
) -> Iterator[tuple[str, bool, dict[str, FieldInfo]]]:
    """Yield every section of the schema: dotted path, whether it is a list of tables, and its fields by key."""
    values, inside = {}, []
    for name, field in section.model_fields.items():
        if path in LIKE_LINKS and name in LinkSection.model_fields:
            continue
        key = field.alias or name
        inner = _nested(field.annotation)
        if inner is None:
            values[key] = field
        else:
            inside.append((inner[0], f"{path}.{key}" if path else key, inner[1]))
    if values or path in LIKE_LINKS:
        yield path, is_list, values
    for inner_section, inner_path, inner_is_list in inside:
        yield from schema_sections(inner_section, inner_path, inner_is_list)


def sections() -> list[KeySection]:
    """Return every section with its keys, in the order of the schema.

    Raises: MeaningError: keys.toml lacks an entry, or has one for a key that does not exist.
    """
    entries = tomllib.loads(MEANINGS.read_text(encoding="utf-8"))
    found = []
    for path, is_list, fields in schema_sections():
        entry = entries.pop(path or "top level", None)
        if entry is None:
            raise MeaningError(f"{MEANINGS.name}: expected a section [{path or 'top level'}], got none")
        meanings = entry.get("keys", {})
        if set(meanings) != set(fields):
            wrong = ", ".join(sorted(set(meanings) ^ set(fields)))
            raise MeaningError(
                f"{MEANINGS.name}, [{path or 'top level'}]: expected the keys of the schema, wrong: {wrong}"
            )
        keys = tuple(_key(name, field, meanings[name]) for name, field in fields.items())
        about, after = str(entry.get("about", "")).strip(), str(entry.get("after", "")).strip()
        found.append(KeySection(path=path, is_list=is_list, about=about, after=after, keys=keys))
    if entries:
        raise MeaningError(f"{MEANINGS.name}: expected the sections of the schema, got also {', '.join(entries)}")
    return found


def _nested(annotation: Any) -> tuple[type[Section], bool] | None:
    """Return the section inside the type of a field, and whether the field is a list of them; None for a value."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation, False
    for argument in get_args(annotation):
        found = _nested(argument)
        if found is not None:
            return found[0], found[1] or get_origin(annotation) is list
    return None


def _key(name: str, field: FieldInfo, meaning: Mapping[str, str]) -> Key:
    """Return a key from its field and its entry in keys.toml.

    Raises: MeaningError: the schema does not give a type, nor does the entry.
    """
    kind = meaning.get("type") or type_of(field.annotation, field.metadata)
    if not kind:
        raise MeaningError(f"{MEANINGS.name}, {name}: expected a type, as a check in code decides, got none")
    return Key(
        name=name,
        type=kind,
        unit=meaning.get("unit", ""),
        default=_default(field),
        meaning=meaning["meaning"],
    )


def type_of(annotation: Any, metadata: list[Any] | tuple[Any, ...] = ()) -> str:
    """Return a type and its range as text, such as "3 numbers > 0" or "daqp, clarabel"; "" where code decides."""
    arguments = get_args(annotation)
    if type(None) in arguments:
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return type_of(inner, metadata)
    if hasattr(annotation, "__metadata__"):
        return type_of(annotation.__origin__, (*annotation.__metadata__, *metadata))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, arguments))
    if get_origin(annotation) is list:
        inner = type_of(arguments[0])
        return f"{_count(metadata)} {_plural(inner)}" if inner else ""
    return f"{_NOUNS[annotation]}{_range(metadata)}".strip() if annotation in _NOUNS else ""


def _count(metadata: list[Any] | tuple[Any, ...]) -> str:
    """Return how many entries a list has: a number where it is fixed, else "list of"."""
    for entry in metadata:
        if getattr(getattr(entry, "func", None), "__name__", "") == "_three_numbers":
            return "3"
    low = next((entry.min_length for entry in _flat(metadata) if getattr(entry, "min_length", None)), None)
    high = next((entry.max_length for entry in _flat(metadata) if getattr(entry, "max_length", None)), None)
    return str(low) if low is not None and low == high else "list of"


def _plural(text: str) -> str:
    for noun in ("number", "integer", "text"):
        if text.startswith(noun):
            return f"{noun}s{text.removeprefix(noun)}"
    return text


def _flat(metadata: list[Any] | tuple[Any, ...]) -> Iterator[Any]:
    """Yield the limits in metadata, also those inside pydantic's own fields."""
    for entry in metadata:
        if isinstance(entry, FieldInfo):
            yield from entry.metadata
        else:
            yield entry


def _range(metadata: list[Any] | tuple[Any, ...]) -> str:
    """Return the limits of a number as text, such as " > 0, < 90" or ", 0 to 1"; "" for none."""
    limits = {
        name: getattr(entry, name)
        for entry in _flat(metadata)
        for name in _SIGNS
        if getattr(entry, name, None) is not None and abs(getattr(entry, name)) < _NO_LIMIT
    }
    if limits.keys() == {"ge", "le"}:
        return f", {_number(limits['ge'])} to {_number(limits['le'])}"
    return " " + ", ".join(f"{sign} {_number(limits[name])}" for name, sign in _SIGNS.items() if name in limits)


def _number(value: float) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) and value >= 10_000 else f"{value:g}"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default is None:
        return "left out"
    return toml(field.default)


def toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return repr(value)
