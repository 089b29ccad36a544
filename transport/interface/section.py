"""Sections of a scenario as the user gets them: reading reads the scenario, setting changes the whole scenario."""

import difflib
from collections.abc import Mapping
from typing import Any, Protocol

from pydantic import BaseModel

from protocol.scenario.schema import Scenario
from transport.interface.boundary import public


class Owner(Protocol):
    """The scenario that a section belongs to."""

    @property
    def validated(self) -> Scenario:
        """The scenario as a frozen pydantic model."""

    def __setitem__(self, key: str, value: Any) -> None:
        """Change the value of a dotted key."""


class Section:
    """A section of a scenario; reading an attribute reads the value, setting one changes the scenario."""

    _owner: Owner
    _key: str
    _data: BaseModel

    def __init__(self, owner: Owner, key: str, data: BaseModel) -> None:
        for name, value in (("_owner", owner), ("_key", key), ("_data", data)):
            object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Any:
        field = field_of(self._data, name)
        if field is None:
            raise AttributeError(f"{self._key or 'scenario'}: unknown key {name!r}; {hint_of(self._data, name)}")
        return shown(self._owner, self._key_of(field), getattr(self._data, field))

    @public
    def __setattr__(self, name: str, value: Any) -> None:
        field = field_of(self._data, name)
        self._owner[self._key_of(name if field is None else field)] = value
        object.__setattr__(self, "_data", _at(self._owner.validated, self._key))

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *type(self._data).model_fields]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Section) and self._data == other._data

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __repr__(self) -> str:
        return repr(self._data)

    def _key_of(self, field: str) -> str:
        """Return the dotted key of a field."""
        model = type(self._data).model_fields
        name = (model[field].alias or field) if field in model else field
        return f"{self._key}.{name}" if self._key else name


def hint_of(found: Any, name: str) -> str:
    """Return what there is instead of an unknown key."""
    if isinstance(found, list):
        return f"expected an entry from 1 to {len(found)}"
    known = (
        [info.alias or field for field, info in type(found).model_fields.items()]
        if isinstance(found, BaseModel)
        else []
    )
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known) or 'none'}"


def field_of(section: BaseModel, name: str) -> str | None:
    """Return the field of a section with a name or alias."""
    fields = type(section).model_fields
    if name in fields:
        return name
    return next((field for field, info in fields.items() if info.alias == name), None)


def _at(data: Any, key: str) -> Any:
    """Return the part of a scenario with a dotted key."""
    for part in key.split(".") if key else ():
        data = data[int(part) - 1] if isinstance(data, list) else getattr(data, field_of(data, part) or part)
    return data


def shown(owner: Owner, key: str, value: Any) -> Any:
    """Return a value of the scenario as the user gets it: sections, and lists as tuples, which cannot be changed."""
    if isinstance(value, BaseModel):
        return Section(owner, key, value)
    if isinstance(value, list):
        return tuple(shown(owner, f"{key}.{number}", part) for number, part in enumerate(value, start=1))
    if isinstance(value, Mapping):
        return {name: shown(owner, f"{key}.{name}", part) for name, part in value.items()}
    return value
