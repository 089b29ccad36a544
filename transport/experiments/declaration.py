"""Declaration of an experiment: its points, its options with their checks, and how it is drawn.

The function of an experiment yields the points of one scenario; it is declared with its options, from which the command
line and its help are made.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from protocol.scenario.keys import UNITS, ending_of, fields, key_of, short_names, unit_of
from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point


@dataclass(frozen=True, slots=True)
class Axis:
    """A quantity in a figure: its column, its name and unit, and the factor from the column to that unit."""

    label: str
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

# Columns of experiments that are no keys of the scenario: name, unit, factor.
_COLUMNS: Mapping[str, tuple[Any, ...]] = {
    "std_s": ("standard deviation of the delay", "ms", 1e3),
    "agent": ("agent killed",),
    "restart_s": ("restart", "s"),
    "killed_s": ("time at which the agent is killed", "s"),
    "hover_s": ("duration of the last hover", "s"),
    "speed_mps": ("largest speed", "m/s"),
    "uavs": ("number of UAVs",),
    "terminal": ("terminal weight",),
    "share_threshold": ("threshold", "% of the input's range; 0: all plans sent", 100.0),
}


def axis(column: str) -> Axis:
    """Return the axis of a column: of a key or short name, in its words if it has no label, or of `_COLUMNS`."""
    if column in _COLUMNS:
        return Axis(column, *_COLUMNS[column])
    key = short_names().get(column, column)
    found = fields().get(key)
    label = key_of(found).label if found is not None else ""
    if found is None or not label:
        ending = ending_of(key)
        return Axis(column, key.removesuffix(ending).replace(".", " ").replace("_", " "), UNITS[ending][0])
    if key.startswith("links.measurement."):  # labels of links name plans
        label = label.replace("plans", "measurements")
    if key.startswith("links.actuation."):
        label = f"{label.removesuffix(' of plans')} to the actuators"
    unit = key_of(found).shown or unit_of(key, found)
    return Axis(column, label, unit, _FACTORS.get(unit.partition(" ")[0], 1.0))


# Label of points to which a column does not apply.
NONE = "none"

# Maneuver with --quick.
QUICK_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A sweep and how it is drawn: as curves over x, a map over x and y, or a row for each variant.

    Curves have the panels of costs, of processor time, of shared plans or of errors.
    """

    name: str  # of the command
    points: tuple[Point, ...]
    x: Axis
    y: Axis | None = None
    drawn_as: Literal["curves", "scaling", "variants", "sharing", "tracking"] = "curves"
    # Column that tells the curves of a scenario apart, and names of its values in the figure. Points labelled `NONE`
    # belong to all curves.
    curves: str | None = None
    legend: Mapping[str | float, str] = field(default_factory=dict)
    timed: bool = False  # whether processor time and messages are measured as well


@dataclass(frozen=True, slots=True)
class Values:
    """An option of an experiment: one value, or several if its default is a list.

    What the scenario refuses needs no limits here.
    """

    default: Any
    metavar: str = ""  # empty: not an option of the command
    help: str = ""  # without the default
    quick: Any = None  # default with --quick, where it differs
    least: float | None = None  # smallest and largest value
    most: float | None = None

    @property
    def kind(self) -> type:
        """Type of a value."""
        return type(self.default[0] if isinstance(self.default, list) else self.default)


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """An experiment: its function of a scenario and of its options, which yields the points, and its defaults.

    Without scenarios it has teams or controllers of its own, and its function takes only its options.
    """

    build: Callable[..., Iterable[Point]]
    options: Mapping[str, Values]
    drawn: Mapping[str, Any]  # fields of `Experiment`
    scenarios: Sequence[str] = ("paper", "resilient")
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
        options = {}
        for name, values in self.options.items():
            default = values.default if not quick or values.quick is None else values.quick
            found = given.get(name)
            found = default if found is None or found == [] else found
            options[name] = sorted(set(found)) if isinstance(found, list) else found
        if self.scenarios:
            points = [
                replace(point, scenario=name)
                for name, scenario in scenarios.items()
                for point in self.build(scenario, **options)
            ]
        else:
            points = list(self.build(**options))
        return Experiment(name=self.build.__name__, points=tuple(points), **self.drawn)


# Experiments by the name of the command.
EXPERIMENTS: dict[str, Declaration] = {}

Build = Callable[..., Iterable[Point]]


def declared(
    x: str, *, drawn: Mapping[str, Any] | None = None, defaults: Mapping[str, Any] | None = None, **options: Values
) -> Callable[[Build], Build]:
    """Declare an experiment by its function, whose docstring is the help of the command.

    Args:
        x: Column along the horizontal axis.
        drawn: Further fields of `Experiment`.
        defaults: Further fields of `Declaration`.
        options: Options of the function by name.
    """

    def declare(build: Build) -> Build:
        fields = {"drawn": {"x": axis(x), **(drawn or {})}, **(defaults or {})}
        EXPERIMENTS[build.__name__] = Declaration(build=build, options=options, **fields)
        return build

    return declare
