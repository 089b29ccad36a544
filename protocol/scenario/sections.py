"""Base of the sections of a scenario, and sections built from the controller's classes of settings."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model
from pydantic_core import PydanticCustomError

from mpc.settings import NotNegative


class Section(BaseModel):
    """Part of a scenario: unknown keys are refused, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def _three_numbers(value: list[float]) -> list[float]:
    if len(value) != 3:
        raise PydanticCustomError("shape", "expected 3 numbers")
    return value


Vector = Annotated[list[float], AfterValidator(_three_numbers)]
NotNegativeVector = Annotated[list[NotNegative], AfterValidator(_three_numbers)]


class SettingsSection(Section):
    """A section with the fields, limits and defaults of a class of settings: see `like`."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


S = TypeVar("S", bound=SettingsSection)


def like(settings: type) -> Callable[[type[S]], type[S]]:
    """Return a decorator that gives a section the fields of a class of settings; a tuple is a list in a file."""

    def filled(section: type[S]) -> type[S]:
        hints = get_type_hints(settings, include_extras=True)
        fields: dict[str, Any] = {}
        for field in dataclasses.fields(settings):
            hint, default = hints[field.name], cast(Any, field.default)
            if get_origin(hint) is tuple:
                count = len(get_args(hint))
                size = AfterValidator(_three_numbers) if count == 3 else Field(min_length=count, max_length=count)
                hint = Annotated[list[get_args(hint)[0]], size]  # type: ignore[misc]
                default = list(default)
            fields[field.name] = hint, ... if default is dataclasses.MISSING else default
        return create_model(
            section.__name__, __base__=section, __module__=section.__module__, __doc__=section.__doc__, **fields
        )

    return filled
