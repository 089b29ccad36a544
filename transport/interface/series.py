"""Time series of a run as named arrays whose names end in their units."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from model import state
from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import ActualInputs, StepReport
from transport.analysis.series import Series, series_of
from transport.interface.settings import ArgumentError, public
from transport.log.run_log import RunLog

_XYZ, _ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
_UAV, _AGENT = "uav", "agent"


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a run over time.

    Attributes:
        unit: Unit, empty for none.
        axes: Meaning of the axes behind the first, which is time: "uav", "agent" (both counted from 1), or components.
        meaning: One sentence.
    """

    unit: str
    axes: tuple[str | tuple[str, ...], ...]
    meaning: str


# All series, in the order in which they are listed. Positions: inertial frame, z down.
QUANTITIES: Mapping[str, Quantity] = {
    "time_s": Quantity("s", (), "Time t_k of the sampling instant."),
    "payload_position_m": Quantity("m", (_XYZ,), "Payload position, inertial frame, z down."),
    "payload_reference_m": Quantity("m", (_XYZ,), "Reference position of the payload, inertial frame."),
    "payload_error_m": Quantity("m", (_XYZ,), "Payload position minus its reference, inertial frame."),
    "payload_velocity_mps": Quantity("m/s", (_XYZ,), "Payload velocity, inertial frame."),
    "payload_attitude_deg": Quantity("deg", (_ANGLES,), "Payload roll, pitch and yaw."),
    "payload_rate_radps": Quantity("rad/s", (_XYZ,), "Angular velocity of the payload, payload frame."),
    "uav_position_m": Quantity("m", (_UAV, _XYZ), "UAV positions, inertial frame, z down; NaN after a release."),
    "uav_reference_m": Quantity("m", (_UAV, _XYZ), "Reference positions of the UAVs, inertial frame."),
    "uav_error_m": Quantity("m", (_UAV, _XYZ), "UAV positions minus references, inertial frame; NaN after a release."),
    "uav_attitude_deg": Quantity("deg", (_UAV, _ANGLES), "UAV roll, pitch and yaw; NaN after a release."),
    "thrust_N": Quantity("N", (_UAV,), "Thrust applied from t_k on."),
    "thrust_limits_N": Quantity("N", (("smallest", "largest"),), "Limits of the thrust of each UAV."),
    "moment_Nm": Quantity(
        "N m", (_UAV, _XYZ), "Moments about the UAV's body axes, applied from t_k on; with body rates their mean."
    ),
    "moment_limit_Nm": Quantity("N m", (_XYZ,), "Limit of the moments of each UAV, either sign."),
    "rate_command_radps": Quantity("rad/s", (_UAV, _XYZ), "Body rates commanded from t_k on; NaN with moments."),
    "cable_tension_N": Quantity("N", (_UAV,), "Least tension of each cable from t_k on, 0 while slack; NaN with rods."),
    "separation_m": Quantity("m", (), "Smallest distance between two UAVs."),
    "clearance_m": Quantity(
        "m", (("UAVs", "rods", "payload"),), "Smallest distances from any obstacle; infinite without obstacles."
    ),
    "cost": Quantity("", (), "Stage cost, docs/equations.md (21)."),
    "constraint_violation": Quantity("", (), "Largest violation as a share of the constraint's range; 0 if all hold."),
    "plan_age_ticks": Quantity("ticks", (_AGENT,), "Age of the oldest plan of another agent in use; NaN for none."),
    "plans_lost": Quantity("", (_AGENT,), "Plans of other agents lost at this tick; NaN without a step."),
    "estimated_force_N": Quantity("N", (_AGENT, _XYZ), "Force on the payload that the agent estimates; NaN for none."),
    "step_ms": Quantity("ms", (_AGENT,), "Wall-clock time of the agent's step; NaN without a step."),
}


class RunSeries(Mapping[str, Array]):
    """Series of a run by name: read-only arrays with one row per recorded tick; names end in the unit.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0, 0, 0]}]
    >>> series = transport.fly("paper", phases=hover).series
    >>> series["payload_error_m"].shape, series.unit("payload_error_m"), series.axes("thrust_N")
    ((10, 3), 'm', ('uav',))
    >>> bool((series["thrust_N"] <= series["thrust_limits_N"][:, 1:]).all())
    True
    """

    def __init__(self, setup: Setup, log: RunLog) -> None:
        self._series = series_of(setup, log)
        self._setup, self._log = setup, log
        self._reports: dict[str, Array] | None = None
        self._found: dict[str, Array] = {}

    def __getitem__(self, name: str) -> Array:
        """Return a series, (ticks, ...), read-only.

        Raises: KeyError: no such series.
        """
        if name not in QUANTITIES:
            raise KeyError(f"{name}: expected one of {', '.join(QUANTITIES)}")
        if name not in self._found:
            values = np.array(self._values(name))
            values.setflags(write=False)
            self._found[name] = values
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(QUANTITIES)

    def __len__(self) -> int:
        return len(QUANTITIES)

    def __repr__(self) -> str:
        rows = [f"{name:22}{self[name].shape!s:14}{quantity.meaning}" for name, quantity in QUANTITIES.items()]
        return "\n".join([f"{len(self['time_s'])} ticks; name, shape, meaning:", *rows])

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td><code>{name}</code></td><td>{self[name].shape}</td><td>{quantity.unit}</td>"
            f"<td>{quantity.meaning}</td></tr>"
            for name, quantity in QUANTITIES.items()
        )
        return f"<table><tr><th>name</th><th>shape</th><th>unit</th><th>meaning</th></tr>{rows}</table>"

    @property
    def source(self) -> Series:
        """The series as the figures and metrics of the report use them."""
        return self._series

    @public
    def unit(self, name: str) -> str:
        """Return the unit of a series, empty for none."""
        return _known(name).unit

    @public
    def axes(self, name: str) -> tuple[str | tuple[str, ...], ...]:
        """Return the meaning of a series' axes behind time: "uav", "agent" (counted from 1), or names of components."""
        return _known(name).axes

    @public
    def meaning(self, name: str) -> str:
        """Return the meaning of a series in one sentence."""
        return _known(name).meaning

    def columns(self) -> dict[str, Array]:
        """Return all series as columns, (ticks,), by name: `thrust_N[1]`, `payload_error_m[x]`, `uav_error_m[1,x]`."""
        found: dict[str, Array] = {}
        for name, quantity in QUANTITIES.items():
            values = self[name]
            labels = [
                axis if isinstance(axis, tuple) else [str(i + 1) for i in range(values.shape[number])]
                for number, axis in enumerate(quantity.axes, start=1)
            ]
            for place in np.ndindex(values.shape[1:]):
                label = ",".join(names[i] for names, i in zip(labels, place, strict=True))
                found[f"{name}[{label}]" if label else name] = values[(slice(None), *place)]
        return found

    def _values(self, name: str) -> Array:
        s, setup = self._series, self._setup
        T, N = len(s.ticks), setup.system.N
        uavs = s.x[:, state.PAYLOAD :].reshape(T, N, state.PER_UAV)
        limits, on_rods = setup.settings.limits, s.on_rods[:, :, None]
        commanded, rates = s.u.reshape(T, N, state.INPUTS)[:, :, 1:], setup.system.commands_rates
        made: dict[str, Callable[[], Any]] = {
            "time_s": lambda: s.times_s,
            "payload_position_m": lambda: s.x[:, state.R0],
            "payload_reference_m": lambda: s.payload_reference_I,
            "payload_error_m": lambda: s.payload_error_I,
            "payload_velocity_mps": lambda: s.payload_velocity_I,
            "payload_attitude_deg": lambda: s.attitude_deg,
            "payload_rate_radps": lambda: s.x[:, state.OMEGA0],
            "uav_position_m": lambda: np.where(on_rods, s.uavs_I, np.nan),
            "uav_reference_m": lambda: s.uav_references_I,
            "uav_error_m": lambda: s.uav_errors_I,
            "uav_attitude_deg": lambda: np.where(on_rods, np.degrees(uavs[:, :, state.THETA]), np.nan),
            "thrust_N": lambda: s.u.reshape(T, N, state.INPUTS)[:, :, 0],
            "thrust_limits_N": lambda: np.tile(limits.thrust_N, (T, 1)),
            "moment_Nm": lambda: self._actual(lambda m: m.inputs[:, 1:], (N, 3)) if rates else commanded,
            "cable_tension_N": lambda: self._actual(lambda m: m.tensions, (N,)),
            "rate_command_radps": lambda: commanded if rates else np.full((T, N, 3), np.nan),
            "moment_limit_Nm": lambda: np.tile(limits.moments_Nm, (T, 1)),
            "separation_m": lambda: s.separation_m,
            "clearance_m": lambda: s.clearance_m,
            "cost": lambda: s.cost,
            "constraint_violation": lambda: s.violation,
        }
        if name in made:
            return np.asarray(made[name]())
        if self._reports is None:
            self._reports = self._of_reports()
        return self._reports[name]

    def _actual(self, part: Callable[[ActualInputs], Array], shape: tuple[int, ...]) -> Array:
        """Return a part of the actual inputs at each tick, (T, *shape); NaN where they are missing."""
        actual = {message.tick: found for message in self._log.of(ActualInputs) if len(found := part(message))}
        missing = np.full(shape, np.nan)
        return np.array([actual.get(int(tick), missing) for tick in self._series.ticks]).reshape(-1, *shape)

    def _of_reports(self) -> dict[str, Array]:
        """Return the series that come from the agents' reports."""
        ticks, agents = self._series.ticks, self._setup.agents
        shape = (len(ticks), len(agents))
        found = {name: np.full(shape, np.nan) for name in ("plan_age_ticks", "plans_lost", "step_ms")}
        found["estimated_force_N"] = np.full((*shape, 3), np.nan)
        row_of = {int(tick): row for row, tick in enumerate(ticks)}
        for report in self._log.of(StepReport):
            row = row_of.get(report.tick)
            if row is None or report.agent not in agents:
                continue
            place = row, report.agent - 1
            ages = [age for age in report.plan_ages if age >= 0]
            found["plan_age_ticks"][place] = max(ages, default=np.nan)
            found["plans_lost"][place] = report.lost
            found["step_ms"][place] = report.times_ms[-1]
            found["estimated_force_N"][place] = report.force
        return found


def _known(name: str) -> Quantity:
    if name not in QUANTITIES:
        raise ArgumentError(f"{name}: expected one of {', '.join(QUANTITIES)}")
    return QUANTITIES[name]
