"""Labels with units of the quantities that experiments and sweeps vary, for axes and legends of their figures."""

from collections.abc import Mapping
from dataclasses import dataclass

from mpc.settings import Key
from protocol.scenario.keys import UNITS, ending_of, fields, key_of, unit_of


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
