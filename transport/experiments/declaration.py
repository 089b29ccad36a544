"""Declaration of an experiment: its points, its options with their checks, and how it is drawn.

The function of an experiment is declared with its options; the command line and its help are made from the declaration.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mpc.settings import Key
from protocol.scenario.keys import UNITS, ending_of, fields, key_of, unit_of
from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point, refused


@dataclass(frozen=True, slots=True)
class Axis:
    """Axis of a figure."""

    label: str  # name of the column along the axis
    title: str  # name of the quantity, with unit
    factor: float = 1.0  # conversion from the column to that unit


@dataclass(frozen=True, slots=True)
class Quantity:
    """Name and unit of a quantity in a figure, and the factor from its value, SI, to that unit."""

    name: str
    unit: str = ""
    factor: float = 1.0

    @property
    def title(self) -> str:
        """Return the label of an axis."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def text(self, value: str | float) -> str:
        """Return a value with name and unit, for a legend."""
        number = value if isinstance(value, str) else f"{self.factor * value:g}"
        return f"{self.name} {number} {self.unit}".rstrip()


# Factors from SI to the units of figures.
_FACTORS = {"ms": 1e3, "%": 100.0, "mm": 1e3, "mm/s": 1e3}

# Columns of experiments that are no keys of the scenario.
_COLUMNS: Mapping[str, Quantity] = {
    "std_s": Quantity("standard deviation of the delay", "ms", 1e3),
    "killed_s": Quantity("time at which the agent is killed", "s"),
    "hover_s": Quantity("duration of the last hover", "s"),
    "speed_mps": Quantity("largest speed", "m/s"),
    "uavs": Quantity("number of UAVs"),
    "terminal": Quantity("terminal weight"),
}


def quantity(key: str) -> Quantity:
    """Return name and unit of a key of the scenario, or of a column; from its words if it has no label."""
    if key in _COLUMNS:
        return _COLUMNS[key]
    field = fields().get(key)
    entry = Key() if field is None else key_of(field)
    if field is None or not entry.label:
        ending = ending_of(key)
        return Quantity(key.removesuffix(ending).replace(".", " ").replace("_", " "), UNITS[ending][0])
    label = entry.label  # those of links name plans
    if key.startswith("links.measurement."):
        label = label.replace("plans", "measurements")
    if key.startswith("links.actuation."):
        label = f"{label.removesuffix(' of plans')} to the actuators"
    unit = entry.shown or unit_of(key, field)
    return Quantity(label, unit, _FACTORS.get(unit.partition(" ")[0], 1.0))


def axis(column: str, key: str | None = None) -> Axis:
    """Return the axis of a column; its key is given where the column has a name of its own."""
    found = quantity(key or column)
    return Axis(column, found.title, found.factor)


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
