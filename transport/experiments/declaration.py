"""Declaration of an experiment: its points, its options with their checks, and how it is drawn.

The function of an experiment yields the points of one scenario; it is declared with its options,
from which the command line and its help are made.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

from transport.experiments.cases import Point
from transport.experiments.run_numbers import More
from transport.protocol.scenario.sections.schema import Scenario

# Label of points to which a column does not apply.
NONE = "none"

# Maneuver with --quick.
QUICK_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)


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


# Yields the points of a scenario, or of an experiment's own teams, for options by name.
Build = Callable[..., Iterable[Point]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A sweep, with its options and defaults, and how it is drawn.

    That is as curves over x, a map over x and y, or a row for each variant. Curves have the panels
    of costs, of processor time, of shared plans, of errors, of the radio or of the age of information.
    """

    name: str  # of the command
    x: str = ""  # columns along the axes
    y: str = ""
    shown: str = "cost_mean"  # number in a map
    drawn_as: Literal[
        "curves", "scaling", "variants", "sharing", "tracking", "radio", "weather", "arena", "age"
    ] = "curves"
    # Column that tells the curves of a scenario apart, and names of its values in the figure.
    # Points labelled `NONE` belong to all curves.
    curves: str | None = None
    legend: Mapping[str | float, str] = field(default_factory=dict)
    points: tuple[Point, ...] = ()
    build: Build = tuple
    options: Mapping[str, Values] = field(default_factory=dict)
    scenarios: Sequence[str] = ("paper", "resilient")  # none: teams of its own
    seeds: int = 1
    jobs: int | None = None  # runs at a time; None: one for each core
    more: More | None = None  # further numbers of each run
    maneuver: str = ""  # setting; empty: the scenario's own
    quick_maneuver: str = QUICK_MANEUVER

    def experiment(
        self, scenarios: Mapping[str, Scenario], given: Mapping[str, Any], *, quick: bool = False
    ) -> Self:
        """Return the experiment with the points of scenarios and the options given.

        The other options are at their defaults.

        Raises: ExperimentError: an option is refused.
        """
        options = {
            name: _chosen(given.get(name), values, quick=quick)
            for name, values in self.options.items()
        }
        points = [
            replace(point, scenario=name)
            for name, scenario in scenarios.items()
            for point in self.build(scenario, **options)
        ]
        return replace(self, points=tuple(points or self.build(**options)))


def _chosen(value: Any, values: Values, *, quick: bool) -> Any:
    """Return the given value of an option or its default; lists are sorted, without repetition."""
    if value in (None, []):
        value = values.quick if quick and values.quick is not None else values.default
    return sorted(set(value)) if isinstance(value, list) else value


# Experiments by the name of the command.
EXPERIMENTS: dict[str, Experiment] = {}


def declared(x: str, **given: Any) -> Callable[[Build], Build]:
    """Declare an experiment by its function, whose docstring is the help of the command.

    Args:
        x: Column along the horizontal axis.
        given: Further fields of `Experiment`, and options of the function as `Values`.
    """
    options = {name: value for name, value in given.items() if isinstance(value, Values)}
    fields = {name: value for name, value in given.items() if name not in options}

    def declare(build: Build) -> Build:
        name = build.__name__
        EXPERIMENTS[name] = Experiment(name=name, x=x, build=build, options=options, **fields)
        return build

    return declare
