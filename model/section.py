"""Base of all sections of a scenario: frozen values with keys, whose properties stand beside them."""

from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Interval, Len
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError

# Magnitudes of lags and times of computation, s: longer ones are milliseconds.
LAG_S = (1e-9, 2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """Properties of a key beside type and range, in the annotation of its field."""

    # Unit in SI; None where the ending of the name tells (`protocol.scenario.sections.scenario_keys.UNITS`).
    unit: str | None = None
    # Smallest magnitude apart from zero, and largest: others are taken for a wrong unit and refused.
    # None: by the ending.
    within: tuple[float, float] | None = None
    label: str = ""  # name on the axis of a figure; empty: the words of the key
    shown: str = ""  # unit in figures, where it is not `unit`
    short: str = ""  # name as a keyword argument in Python, if it has one
    type: str = ""  # type and range in words, where a check in code decides
    option: str = ""  # of a key of a link: option of `transport link set`


class Section(BaseModel):
    """Part of a scenario: unknown keys are refused, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def as_tuple(value: Any) -> Any:
    """Return a list as a tuple, and any other value as it is."""
    return tuple(value) if isinstance(value, list) else value


def _three_numbers(value: tuple[float, ...]) -> tuple[float, ...]:
    if len(value) != 3:
        raise PydanticCustomError("shape", "expected 3 numbers")
    return value


def _growing(value: tuple[float, ...]) -> tuple[float, ...]:
    if not value[0] < value[1]:
        raise PydanticCustomError("range", "expected smallest < largest")
    return value


def _checked_inertia(value: list[Any]) -> list[Any]:
    """Return an inertia that has three principal moments or three rows of three numbers."""
    rows = [row for row in value if isinstance(row, list)]
    are_moments = len(value) == 3 and not rows
    are_rows = len(value) == len(rows) == 3 and all(len(row) == 3 for row in rows)
    if not are_moments and not are_rows:
        raise ValueError(f"expected 3 principal moments or 3 rows of 3 numbers, got {value}")
    return value


Positive = Annotated[float, Interval(gt=0.0)]
NotNegative = Annotated[float, Interval(ge=0.0)]
Vector = Annotated[tuple[float, ...], BeforeValidator(as_tuple), AfterValidator(_three_numbers)]
PositiveVector = Annotated[
    tuple[Positive, ...], BeforeValidator(as_tuple), AfterValidator(_three_numbers)
]
NotNegativeVector = Annotated[
    tuple[NotNegative, ...], BeforeValidator(as_tuple), AfterValidator(_three_numbers)
]
Pair = Annotated[tuple[NotNegative, ...], BeforeValidator(as_tuple), Len(2, 2)]
Range = Annotated[Pair, AfterValidator(_growing)]
Inertia = Annotated[
    list[float] | list[list[float]],
    AfterValidator(_checked_inertia),
    Key(type="3 numbers or 3 rows of 3"),
]
