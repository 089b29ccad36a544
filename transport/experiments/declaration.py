"""Declaration of an experiment: its points, its options with their checks, and how it is drawn.

The function of an experiment is declared with its options; the command line and its help are made from the declaration.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.errors import refused
from transport.experiments.quantities import Axis

# Label of points to which a column does not apply.
NONE = "none"

# Maneuver with --quick.
QUICK_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)

_SMALLEST = math.ulp(0.0)  # lower bound of numbers that must be positive


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A sweep and how it is drawn.

    It is drawn as curves, a map, curves over team size, a row for each variant, or curves of shared plans or of errors.
    """

    name: str  # of the command
    points: tuple[Point, ...]
    x: Axis  # horizontal
    y: Axis | None = None  # vertical axis of a map
    drawn_as: Literal["curves", "map", "scaling", "variants", "sharing", "tracking"] = "curves"
    # Column that tells the curves of a scenario apart, and names of its values in the figure. Points labelled `NONE`
    # belong to all curves.
    curves: str | None = None
    legend: Mapping[str | float, str] = field(default_factory=dict)
    timed: bool = False  # whether processor time and messages are measured as well


@dataclass(frozen=True, slots=True)
class Range:
    """Range of a number, low <= number < below, and its description."""

    expected: str
    low: float = _SMALLEST
    below: float = math.inf

    def check(self, option: str, *values: float) -> None:
        """Refuse a number outside the range.

        Raises: ExperimentError: with option, expected and got.
        """
        for value in values:
            if not self.low <= value < self.below:
                raise refused(option, self.expected, f"{value:g}")


@dataclass(frozen=True, slots=True)
class Values:
    """An option of an experiment: one value, or several if its default is a list."""

    default: Any
    metavar: str = ""  # empty: not an option of the command
    help: str = ""
    quick: Any = None  # default with --quick, where it differs
    within: Range | None = None
    least: int | None = None  # smallest value, checked by the command line

    @property
    def kind(self) -> type:
        """Type of a value."""
        return type(self.default[0] if isinstance(self.default, list) else self.default)

    def checked(self, name: str, given: Any, *, quick: bool) -> Any:
        """Return the values given, or the default.

        Raises: ExperimentError: a value is outside the range, or given twice.
        """
        default = self.quick if quick and self.quick is not None else self.default
        found = given if given or (given is not None and not isinstance(default, list)) else default
        values = found if isinstance(default, list) else [found]
        if self.within is not None:
            self.within.check(f"--{name}", *values)
        return distinct(f"--{name}", found) if isinstance(default, list) else found


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """An experiment: its function of scenarios by name and of its options, which returns the sweep, and its defaults.

    Without scenarios it has teams or controllers of its own, and its function takes only its options.
    """

    build: Callable[..., Experiment]
    options: Mapping[str, Values]
    scenarios: Sequence[str] = ()
    seeds: int = 1
    jobs: int | None = None  # runs at a time; None: one for each core
    maneuver: str = ""  # setting; empty: the scenario's own
    quick_maneuver: str = QUICK_MANEUVER

    def experiment(
        self, scenarios: Mapping[str, Scenario], given: Mapping[str, Any], *, quick: bool = False
    ) -> Experiment:
        """Return the sweep over scenarios with the options given, the others at their defaults.

        Raises: ExperimentError: an option is refused.
        """
        options = {name: values.checked(name, given.get(name), quick=quick) for name, values in self.options.items()}
        return self.build(scenarios, **options) if self.scenarios else self.build(**options)


# Experiments by the name of the command.
EXPERIMENTS: dict[str, Declaration] = {}


def declared(
    *, scenarios: Sequence[str] = ("paper", "resilient"), defaults: Mapping[str, Any] | None = None, **options: Values
) -> Callable[[Callable[..., Experiment]], Callable[..., Experiment]]:
    """Return a decorator that declares an experiment by its function, whose docstring is the help of the command.

    The defaults are further ones of the declaration.
    """

    def declare(build: Callable[..., Experiment]) -> Callable[..., Experiment]:
        found = Declaration(build=build, options=options, scenarios=scenarios, **(defaults or {}))
        EXPERIMENTS[build.__name__] = found
        return build

    return declare


def distinct(option: str, values: Sequence[Any]) -> Sequence[Any]:
    """Return the values of an option.

    Raises: ExperimentError: a value is given twice.
    """
    for value in values:
        if values.count(value) > 1:
            raise refused(option, "each value once", f"{value} {values.count(value)} times")
    return values
