"""Definition of an experiment: its points, how it is drawn, and checks of its options."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from transport.experiments.cases import Point
from transport.experiments.errors import refused
from transport.experiments.quantities import Axis

T = TypeVar("T", str, float)

# Label of points to which a column does not apply.
NONE = "none"

SMALLEST = math.ulp(0.0)  # lower bound of numbers that must be positive


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A sweep and how it is drawn.

    It is drawn as curves, a map, curves over team size, a row for each variant, or curves of shared plans.
    """

    name: str  # of the command
    points: tuple[Point, ...]
    x: Axis  # horizontal
    y: Axis | None = None  # vertical axis of a map
    drawn_as: Literal["curves", "map", "scaling", "variants", "sharing"] = "curves"
    # Column that tells the curves of a scenario apart, and names of its values in the figure. Points labelled `NONE`
    # belong to all curves.
    curves: str | None = None
    legend: Mapping[str | float, str] = field(default_factory=dict)
    timed: bool = False  # whether processor time and messages are measured as well


def check_numbers(option: str, values: Sequence[float], expected: str, low: float, below: float = math.inf) -> None:
    """Refuse numbers of an option that are outside [low, below) or given twice.

    Raises: ExperimentError: with option, expected and got.
    """
    for value in values:
        if not low <= value < below:
            raise refused(option, expected, f"{value:g}")
    distinct(option, values)


def distinct(option: str, values: Sequence[T]) -> Sequence[T]:
    """Return the values of an option.

    Raises: ExperimentError: a value is given twice.
    """
    for value in values:
        if values.count(value) > 1:
            raise refused(option, "each value once", f"{value} {values.count(value)} times")
    return values
