"""Axes of figures: the names and units of the columns of an experiment."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from transport.protocol.scenario.sections.scenario_keys import (
    UNITS,
    ending_of,
    fields,
    key_of,
    short_names,
    unit_of,
)
from transport.protocol.scenario.sections.schema import Scenario


@dataclass(frozen=True, slots=True)
class Axis:
    """A quantity in a figure."""

    label: str  # its column
    name: str
    unit: str = ""
    factor: float = 1.0  # from the column to the unit

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

# Beginnings of keys that share the fields of the agents' links, whose labels name plans.
_OTHER_LINKS = ("links.measurement.", "links.actuation.")

# Columns of experiments that are no keys of the scenario: name, unit, factor.
_COLUMNS: Mapping[str, tuple[Any, ...]] = {
    "std_s": ("standard deviation of the delay", "ms", 1e3),
    "agent": ("agent killed",),
    "network": ("network",),
    "restart_s": ("restart", "s"),
    "killed_s": ("time at which the agent is killed", "s"),
    "hover_s": ("duration of the last hover", "s"),
    "speed_mps": ("largest speed", "m/s"),
    "uavs": ("number of UAVs",),
    "age_s": ("mean age of the newest plan", "s"),
    "terminal": ("terminal weight",),
    "share_threshold": ("threshold", "% of the input's range; 0: all plans sent", 100.0),
    "rule": ("rule of the agents that learn a target from plans",),
    "cost_mean": ("mean cost", "$10^{-3}$", 1e3),
    "away_rms_m": ("away, rms", "cm", 100.0),
}


def axis(column: str) -> Axis:
    """Return the axis of a column, which is a key, a short name, or one of `_COLUMNS`.

    A key without a label is named in its own words.
    """
    if column in _COLUMNS:
        return Axis(column, *_COLUMNS[column])

    key = short_names(Scenario).get(column, column)
    field_of_key = fields(Scenario).get(key)
    names_plans = key.startswith(_OTHER_LINKS)
    if field_of_key is None or not key_of(field_of_key).label or names_plans:
        ending = ending_of(key)
        words = key.removesuffix(ending).replace(".", " ").replace("_", " ")
        return Axis(column, words, UNITS[ending].symbol)

    described = key_of(field_of_key)
    unit = described.shown or unit_of(key, field_of_key)
    return Axis(column, described.label, unit, _FACTORS.get(unit.partition(" ")[0], 1.0))
