"""Labels with units of the quantities that experiments and sweeps vary, for axes and legends of their figures."""

from collections.abc import Mapping
from dataclasses import dataclass


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


_MS, _PERCENT = 1e3, 100.0

# Quantities by dotted key of the scenario, or by column where an experiment varies something else.
QUANTITIES: Mapping[str, Quantity] = {
    "links.delay_s": Quantity("delay of plans", "ms", _MS),
    "links.jitter_s": Quantity("jitter of plans", "ms", _MS),
    "links.loss": Quantity("loss of plans", "%", _PERCENT),
    "links.duplicate": Quantity("duplicated plans", "%", _PERCENT),
    "links.reorder": Quantity("plans held back", "%", _PERCENT),
    "links.reorder_s": Quantity("extra delay of plans held back", "ms", _MS),
    "links.rate_hz": Quantity("plans per second on a link", "1/s"),
    "links.distribution": Quantity("delay distribution"),
    "links.measurement.delay_s": Quantity("delay of measurements", "ms", _MS),
    "links.measurement.loss": Quantity("loss of measurements", "%", _PERCENT),
    "links.actuation.delay_s": Quantity("delay to the actuators", "ms", _MS),
    "links.actuation.loss": Quantity("loss to the actuators", "%", _PERCENT),
    "controller.sampling_period_s": Quantity("sampling period", "ms", _MS),
    "controller.horizon": Quantity("horizon", "steps"),
    "controller.relaxation": Quantity("relaxation"),
    "controller.negotiation_iterations": Quantity("negotiation iterations"),
    "controller.motor_lag_s": Quantity("motor lag of the model", "ms", _MS),
    "controller.share_threshold": Quantity("threshold of sharing", "% of the input's range", _PERCENT),
    "controller.share_heartbeat_s": Quantity("longest time without a plan", "s"),
    "controller.weights.position": Quantity("weight on UAV position", "1/m²"),
    "controller.weights.attitude": Quantity("weight on payload attitude", "1/rad²"),
    "controller.weights.yaw_rate": Quantity("weight on yaw rate", "s²/rad²"),
    "controller.weights.payload_position": Quantity("weight on payload position", "1/m²"),
    "controller.weights.payload_velocity": Quantity("weight on payload velocity", "s²/m²"),
    "controller.weights.terminal": Quantity("terminal weight"),
    "controller.weights.thrust": Quantity("weight on thrust", "1/N²"),
    "controller.weights.moments": Quantity("weight on moments", "1/(N m)²"),
    "controller.separation.minimum_m": Quantity("smallest allowed distance of UAVs", "m"),
    "controller.tilt.limit_deg": Quantity("largest planned tilt", "deg"),
    "controller.disturbance.time_constant_s": Quantity("time constant of the estimator", "s"),
    "plant.payload_mass_factor": Quantity("actual over assumed payload mass"),
    "plant.uav_mass_factor": Quantity("actual over assumed UAV mass"),
    "plant.step_s": Quantity("integration step", "ms", _MS),
    "plant.motors.lag_s": Quantity("motor lag", "ms", _MS),
    "plant.motors.thrust_step_N": Quantity("thrust step", "N"),
    "plant.wind.speed_mps": Quantity("wind speed", "m/s"),
    "plant.wind.gust_mps": Quantity("gusts, standard deviation", "m/s"),
    "plant.wind.gust_time_constant_s": Quantity("correlation time of gusts", "s"),
    "plant.noise.position_m": Quantity("noise of payload position", "mm", 1e3),
    "plant.noise.velocity_mps": Quantity("noise of payload velocity", "mm/s", 1e3),
    "plant.noise.attitude_rad": Quantity("noise of attitudes", "rad"),
    "plant.noise.rate_rads": Quantity("noise of angular velocities", "rad/s"),
    "system.payload.mass_kg": Quantity("payload mass", "kg"),
    "agents.owned": Quantity("UAVs of each agent"),
    "std_s": Quantity("standard deviation of the delay", "ms", _MS),
    "killed_s": Quantity("time at which the agent is killed", "s"),
    "hover_s": Quantity("duration of the last hover", "s"),
    "uavs": Quantity("number of UAVs"),
    "terminal": Quantity("terminal weight"),
}

# Units by the end of a key, for keys that the table lacks.
_UNITS = {
    "_Nm_s": "N m/s",
    "_N_s": "N/s",
    "_kgps": "kg/s",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_rads": "rad/s",
    "_kgm2": "kg m²",
    "_Nm": "N m",
    "_kg": "kg",
    "_deg": "deg",
    "_rad": "rad",
    "_hz": "1/s",
    "_N": "N",
    "_m": "m",
    "_s": "s",
}


def quantity(key: str) -> Quantity:
    """Return name and unit of a key of the scenario, or of a column; from its words if it is not in the table."""
    if key in QUANTITIES:
        return QUANTITIES[key]
    ending = next((ending for ending in _UNITS if key.endswith(ending)), "")
    words = key.removesuffix(ending).replace(".", " ").replace("_", " ")
    return Quantity(words, _UNITS.get(ending, ""))


def axis(column: str, key: str | None = None) -> Axis:
    """Return the axis of a column; its key is given where the column has a name of its own."""
    found = quantity(key or column)
    return Axis(column, found.title, found.factor)
