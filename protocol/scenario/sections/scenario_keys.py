"""Keys of sections, as their fields describe them: paths, units, ranges, labels, meanings."""

import ast
import inspect
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import inf
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from transport.model.section import Key


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of keys with the same ending, and the magnitudes that they may have."""

    symbol: str  # SI; empty for none
    least: float  # apart from zero
    most: float

    @property
    def range(self) -> tuple[float, float]:
        """Smallest magnitude apart from zero, and largest."""
        return self.least, self.most


# By the ending of the key; the longest one that fits counts. Beyond these ranges, far wider than
# anything that flies, float64 overflows or loses all digits somewhere.
UNITS: Mapping[str, Unit] = {
    "": Unit("", 1e-12, 1e12),
    "_s": Unit("s", 1e-9, 1e9),  # decades, still countable in ticks and nanoseconds
    "_hz": Unit("1/s", 1e-9, 1e9),
    "_m": Unit("m", 1e-12, 1e6),
    "_mps": Unit("m/s", 1e-12, 1e4),
    "_mps2": Unit("m/s²", 1e-6, 1e4),
    "_rad": Unit("rad", 1e-12, 1e4),
    "_rads": Unit("rad/s", 1e-12, 1e4),
    "_rads2": Unit("rad/s²", 1e-12, 1e6),
    "_deg": Unit("deg", 1e-12, 1e12),
    "_kg": Unit("kg", 1e-9, 1e6),
    "_kgm2": Unit("kg m²", 1e-12, 1e9),
    "_kgps": Unit("kg/s", 1e-12, 1e12),
    "_N": Unit("N", 1e-12, 1e12),
    "_N_s": Unit("N/s", 1e-12, 1e12),
    "_Nm": Unit("N m", 1e-12, 1e12),
    "_Nm_s": Unit("N m/s", 1e-12, 1e12),
}

_SECONDS = "_s"
# Ranges of times below this one, s, tell milliseconds from seconds.
_LONGEST_S = 60.0


def key_of(field: FieldInfo) -> Key:
    """Return the properties of a key in the annotation of its field."""
    return next((entry for entry in field.metadata if isinstance(entry, Key)), Key())


def ending_of(name: str) -> str:
    """Return the ending of a key that tells its unit."""
    return max((ending for ending in UNITS if name.endswith(ending)), key=len)


def unit_of(name: str, field: FieldInfo) -> str:
    """Return the unit of a key, SI; empty for none."""
    given = key_of(field).unit
    return UNITS[ending_of(name)].symbol if given is None else given


def section_in(annotation: Any) -> type[BaseModel] | None:
    """Return the class of a field's section, or of the sections in its list; None for a value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation

    inner = (section_in(argument) for argument in get_args(annotation))
    return next((section for section in inner if section is not None), None)


def names_of(section: type[BaseModel]) -> dict[str, str]:
    """Return the fields of a section by their keys, different where a key is a Python keyword."""
    return {field.alias or name: name for name, field in section.model_fields.items()}


def walk(
    section: type[BaseModel], path: str = ""
) -> Iterator[tuple[str, str, type[BaseModel], FieldInfo]]:
    """Yield every key and section below a section.

    Each has the dotted path and the class of the section around it, and its own name and field, in
    the order path, name, class, field.
    """
    for key, name in names_of(section).items():
        field = section.model_fields[name]
        yield path, key, section, field

        inner = section_in(field.annotation)
        if inner is not None:
            yield from walk(inner, _joined(path, key))


def is_list(section: type[BaseModel], path: Iterable[str]) -> bool:
    """Return whether a key below a section is that of a list; its path may have numbers of entries."""
    key = ".".join(part for part in path if not part.isdecimal())
    field = fields(section).get(key)
    return field is not None and _has_entries(field.annotation)


def _has_entries(annotation: Any) -> bool:
    """Return whether a field is a list, or may be one."""
    if get_origin(annotation) in (list, tuple):
        return True
    return any(_has_entries(argument) for argument in get_args(annotation))


@cache
def fields(section: type[BaseModel]) -> Mapping[str, FieldInfo]:
    """Return all keys and sections below a section by dotted key, without numbers of list entries."""
    return {_joined(path, key): field for path, key, _, field in walk(section)}


def short_names(section: type[BaseModel]) -> dict[str, str]:
    """Return the dotted keys below a section that have a short name in Python, by that name."""
    keys: dict[str, str] = {}
    for key, field in fields(section).items():
        short = key_of(field).short
        if short:
            # Links from and to the plant have the keys of `links`, which come first, again.
            keys.setdefault(short, key)
    return keys


def meanings(section: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each key of a section: the docstring of its field.

    Python keeps no docstrings of fields, so they are read from the source, for the page of keys and the
    help of `transport link set` only. Pydantic reads them the same way (`use_attribute_docstrings`), but
    as classes are made: 40 ms at every start, a sixth of the import of all sections.
    """
    sections = [owner for owner in section.__mro__ if issubclass(owner, BaseModel)][:-1]
    texts: dict[str, str] = {}
    for owner in reversed(sections):
        texts |= _docstrings(owner)
    return {key: texts[name] for key, name in names_of(section).items() if name in texts}


def _docstrings(section: type[BaseModel]) -> dict[str, str]:
    """Return the docstrings of the fields that a class itself declares."""
    (declared,) = ast.parse(inspect.getsource(section)).body
    texts: dict[str, str] = {}
    for field, text in pairwise(getattr(declared, "body", [])):
        if not (isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)):
            continue
        if isinstance(text.value, ast.Constant):
            texts[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    return texts


def out_of_range(
    value: object, place: str = "", within: tuple[float, float] = (0.0, inf)
) -> Iterator[tuple[str, str]]:
    """Yield field, and expected with got, of each number of a section or list out of its range."""
    if isinstance(value, BaseModel):
        yield from _section_out_of_range(value, place)
    elif isinstance(value, list | tuple):
        for number, entry in enumerate(value, start=1):
            yield from out_of_range(entry, f"{place}.{number}", within)
    elif isinstance(value, float) and value != 0.0:
        least, most = within
        if abs(value) > most:
            yield place, milliseconds(place, value, most) or _too_large(value, most)
        elif not abs(value) >= least:
            yield place, f"expected a magnitude of at least {least:g}, got {value:g}"


def milliseconds(key: str, value: float, most: float) -> str:
    """Return expected and got of a time above its range that milliseconds explain; else nothing."""
    seconds = value / 1000.0
    name = key.rstrip(".0123456789")  # of a list, without the number of the entry
    if ending_of(name) != _SECONDS or most > _LONGEST_S:
        return ""
    if not 0.0 < seconds <= most:
        return ""
    return f"expected seconds, at most {most:g}, got {value:g}: did you mean {seconds:g}?"


def _too_large(value: float, most: float) -> str:
    return f"expected a magnitude of at most {most:g}, got {value:g}"


def _section_out_of_range(section: BaseModel, place: str) -> Iterator[tuple[str, str]]:
    """Yield the numbers out of their ranges among the given keys of a section."""
    for key, name in names_of(type(section)).items():
        if name in section.model_fields_set:
            own = key_of(type(section).model_fields[name]).within
            within = UNITS[ending_of(key)].range if own is None else own
            yield from out_of_range(getattr(section, name), _joined(place, key), within)


def _joined(path: str, key: str) -> str:
    """Return the dotted key of a key within a section; the scenario itself has an empty path."""
    return f"{path}.{key}".lstrip(".")
