"""Keys of a scenario, as its sections describe them: paths, units, ranges, labels, meanings."""

import ast
import inspect
from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import inf
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from transport.mpc.settings import Key
from transport.protocol.scenario.schema import Scenario

# Unit, smallest magnitude apart from zero, and largest, by the ending of the key; the longest one that fits counts.
# Beyond these ranges, far wider than anything that flies, float64 overflows or loses all digits somewhere.
UNITS: Mapping[str, tuple[str, float, float]] = {
    "": ("", 1e-12, 1e12),
    "_s": ("s", 1e-9, 1e9),  # decades, still countable in ticks and nanoseconds
    "_hz": ("1/s", 1e-9, 1e9),
    "_m": ("m", 1e-12, 1e6),
    "_mps": ("m/s", 1e-12, 1e4),
    "_mps2": ("m/s²", 1e-6, 1e4),
    "_rad": ("rad", 1e-12, 1e4),
    "_rads": ("rad/s", 1e-12, 1e4),
    "_rads2": ("rad/s²", 1e-12, 1e6),
    "_deg": ("deg", 1e-12, 1e12),
    "_kg": ("kg", 1e-9, 1e6),
    "_kgm2": ("kg m²", 1e-12, 1e9),
    "_kgps": ("kg/s", 1e-12, 1e12),
    "_N": ("N", 1e-12, 1e12),
    "_N_s": ("N/s", 1e-12, 1e12),
    "_Nm": ("N m", 1e-12, 1e12),
    "_Nm_s": ("N m/s", 1e-12, 1e12),
}


def key_of(field: FieldInfo) -> Key:
    """Return what the annotation of a field tells about its key."""
    return next((entry for entry in field.metadata if isinstance(entry, Key)), Key())


def ending_of(name: str) -> str:
    """Return the ending of a key that tells its unit."""
    return max((ending for ending in UNITS if name.endswith(ending)), key=len)


def unit_of(name: str, field: FieldInfo) -> str:
    """Return the unit of a key, SI; empty for none."""
    given = key_of(field).unit
    return UNITS[ending_of(name)][0] if given is None else given


def section_in(annotation: Any) -> type[BaseModel] | None:
    """Return the class of the section, or of the sections in a list, that a field has; None for a value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(section_in, get_args(annotation))), None)


def names_of(section: type[BaseModel]) -> dict[str, str]:
    """Return the fields of a section by their keys, which differ where a key is a word of Python."""
    return {field.alias or name: name for name, field in section.model_fields.items()}


def walk(
    section: type[BaseModel] = Scenario, path: str = ""
) -> Iterator[tuple[str, str, type[BaseModel], FieldInfo]]:
    """Yield every key and section: the dotted path of the section around it, its name, that class, its field."""
    for key, name in names_of(section).items():
        field = section.model_fields[name]
        yield path, key, section, field
        if (inner := section_in(field.annotation)) is not None:
            yield from walk(inner, f"{path}.{key}".lstrip("."))


def fields() -> dict[str, FieldInfo]:
    """Return the fields of all keys and sections of a scenario by dotted key, without the numbers of list entries."""
    return {f"{path}.{key}".lstrip("."): field for path, key, _, field in walk()}


def short_names() -> dict[str, str]:
    """Return the dotted keys that have a short name in Python, by that name."""
    found: dict[str, str] = {}
    for (
        key,
        field,
    ) in (
        fields().items()
    ):  # links from and to the plant have the keys of `links`, which come first, again
        found.setdefault(key_of(field).short, key)
    return {short: key for short, key in found.items() if short}


def meanings(section: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each key of a section: the docstring of its field, which pydantic would always read."""
    found: dict[str, str] = {}
    for owner in reversed(
        [owner for owner in section.__mro__ if issubclass(owner, BaseModel)][:-1]
    ):
        (body,) = ast.parse(inspect.getsource(owner)).body
        for field, text in pairwise(getattr(body, "body", [])):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                found[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    return {key: found[name] for key, name in names_of(section).items() if name in found}


def out_of_range(
    value: object, place: str = "", within: tuple[float, float] = (0.0, inf)
) -> Iterator[tuple[str, str]]:
    """Yield field, and expected and got, of each number given in a section or list that is beyond its range."""
    if isinstance(value, BaseModel):
        for key, name in names_of(type(value)).items():
            if name in value.model_fields_set:
                limits = key_of(type(value).model_fields[name]).within or UNITS[ending_of(key)][1:]
                yield from out_of_range(getattr(value, name), f"{place}.{key}".lstrip("."), limits)
    elif isinstance(value, list | tuple):
        for number, entry in enumerate(value, start=1):
            yield from out_of_range(entry, f"{place}.{number}", within)
    elif isinstance(value, float) and value != 0.0 and not within[0] <= abs(value) <= within[1]:
        bound = f"most {within[1]:g}" if abs(value) > within[1] else f"least {within[0]:g}"
        yield place, f"expected a magnitude of at {bound}, got {value:g}"
