"""Time series of a run as named arrays whose names end in their units."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.plan_delays import plan_delays
from transport.interface.setting_arguments import ArgumentError
from transport.model import state
from transport.model.arrays import Array, frozen
from transport.protocol.wire.messages import ActualInputs, StepReport

_XYZ = ("x", "y", "z")
_ANGLES = ("roll", "pitch", "yaw")
_UAV = "uav"
_AGENT = "agent"


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a run over time."""

    unit: str  # empty for none
    # Meaning of the axes behind the first, which is time: "uav", "agent" (both counted from 1), or
    # components.
    axes: tuple[str | tuple[str, ...], ...]
    meaning: str  # one sentence


# All series, in the order in which they are listed. Positions: inertial frame, z down.
QUANTITIES: Mapping[str, Quantity] = {
    "time_s": Quantity("s", (), "Time t_k of the sampling instant."),
    "payload_position_m": Quantity("m", (_XYZ,), "Payload position, inertial frame, z down."),
    "payload_reference_m": Quantity(
        "m", (_XYZ,), "Reference position of the payload, inertial frame."
    ),
    "payload_error_m": Quantity(
        "m", (_XYZ,), "Payload position minus its reference, inertial frame."
    ),
    "payload_error_norm_m": Quantity("m", (), "Distance of the payload from its reference."),
    "payload_velocity_mps": Quantity("m/s", (_XYZ,), "Payload velocity, inertial frame."),
    "payload_attitude_deg": Quantity("deg", (_ANGLES,), "Payload roll, pitch and yaw."),
    "attitude_max_deg": Quantity(
        "deg", (), "Largest magnitude of the payload's roll, pitch and yaw."
    ),
    "payload_rate_radps": Quantity(
        "rad/s", (_XYZ,), "Angular velocity of the payload, payload frame."
    ),
    "uav_position_m": Quantity(
        "m", (_UAV, _XYZ), "UAV positions, inertial frame, z down; NaN after a release."
    ),
    "uav_reference_m": Quantity(
        "m", (_UAV, _XYZ), "Reference positions of the UAVs, inertial frame."
    ),
    "uav_error_m": Quantity(
        "m", (_UAV, _XYZ), "UAV positions minus references, inertial frame; NaN after a release."
    ),
    "uav_attitude_deg": Quantity(
        "deg", (_UAV, _ANGLES), "UAV roll, pitch and yaw; NaN after a release."
    ),
    "thrust_N": Quantity("N", (_UAV,), "Thrust commanded from t_k on."),
    "thrust_limits_N": Quantity(
        "N", (("smallest", "largest"),), "Limits of the thrust of each UAV."
    ),
    "moment_Nm": Quantity(
        "N m",
        (_UAV, _XYZ),
        "Moments about the UAV's body axes, commanded from t_k on; with body rates the mean of the actual ones.",
    ),
    "moment_limit_Nm": Quantity("N m", (_XYZ,), "Limit of the moments of each UAV, either sign."),
    "rate_command_radps": Quantity(
        "rad/s", (_UAV, _XYZ), "Body rates commanded from t_k on; NaN with moments."
    ),
    "cable_tension_N": Quantity(
        "N", (_UAV,), "Least tension of each cable from t_k on, 0 while slack; NaN with rods."
    ),
    "separation_m": Quantity("m", (), "Smallest distance between two UAVs."),
    "clearance_m": Quantity(
        "m",
        (("UAVs", "rods", "payload"),),
        "Smallest distances from any obstacle; infinite without obstacles.",
    ),
    "cost": Quantity("", (), "Stage cost (21), with the weights of the scenario; no unit."),
    "constraint_violation": Quantity(
        "", (), "Largest violation as a share of the constraint's range; 0 if all hold."
    ),
    "uav_error_max_m": Quantity(
        "m", (_AGENT,), "Largest distance of the agent's UAVs from their references."
    ),
    "plan_age_ticks": Quantity(
        "ticks", (_AGENT,), "Age of the oldest plan of another agent in use; NaN for none."
    ),
    "plan_delay_s": Quantity(
        "s",
        (_AGENT, _AGENT),
        "Delay of the newest plan that an agent used of each other one, by receiver and sender; NaN for none.",
    ),
    "plans_lost": Quantity(
        "", (_AGENT,), "Plans of other agents lost at this tick; NaN without a step."
    ),
    "estimated_force_N": Quantity(
        "N",
        (_AGENT, _XYZ),
        "Force on the payload that the agent estimates, zero if it estimates none; NaN without a step.",
    ),
    "step_ms": Quantity(
        "ms", (_AGENT,), "Wall-clock time of the agent's step; NaN without a step."
    ),
}


class RunSeries(Mapping[str, Array]):
    """Series of a run by name: read-only arrays with one row per recorded tick.

    Names end in the unit.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0, 0, 0]}]
    >>> series = transport.fly("paper", phases=hover).series
    >>> series["payload_error_m"].shape, series.unit("payload_error_m"), series.axes("thrust_N")
    ((10, 3), 'm', ('uav',))
    >>> bool((series["thrust_N"] <= series["thrust_limits_N"][:, 1:]).all())
    True
    """

    def __init__(self, run: AnalysedRun) -> None:
        self._arrays = {name: np.array(values) for name, values in _arrays(run).items()}
        frozen(*self._arrays.values())

    def __getitem__(self, name: str) -> Array:
        """Return a series, (ticks, ...), read-only."""
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(QUANTITIES)

    def __len__(self) -> int:
        return len(QUANTITIES)

    def __repr__(self) -> str:
        rows = [
            f"{name:22}{self[name].shape!s:14}{quantity.meaning}"
            for name, quantity in QUANTITIES.items()
        ]
        return "\n".join([f"{len(self['time_s'])} ticks; name, shape, meaning:", *rows])

    def unit(self, name: str) -> str:
        """Return the unit of a series, empty for none."""
        return _quantity(name).unit

    def axes(self, name: str) -> tuple[str | tuple[str, ...], ...]:
        """Return the meaning of a series' axes behind time.

        It is "uav", "agent" (counted from 1), or names of components.
        """
        return _quantity(name).axes

    def meaning(self, name: str) -> str:
        """Return the meaning of a series in one sentence."""
        return _quantity(name).meaning

    def columns(self) -> dict[str, Array]:
        """Return all series as columns, (ticks,), by name.

        Names are such as `thrust_N[1]`, `payload_error_m[x]`, `uav_error_m[1,x]`.
        """
        columns: dict[str, Array] = {}
        for name, quantity in QUANTITIES.items():
            values = self[name]
            for entry in np.ndindex(values.shape[1:]):
                column = _column_name(name, quantity, entry)
                columns[column] = values[(slice(None), *entry)]
        return columns


def _column_name(name: str, quantity: Quantity, entry: tuple[int, ...]) -> str:
    """Return the name of the column of an entry of a series."""
    labels = [
        axis[i] if isinstance(axis, tuple) else str(i + 1)
        for axis, i in zip(quantity.axes, entry, strict=True)
    ]
    return f"{name}[{','.join(labels)}]" if labels else name


def _arrays(run: AnalysedRun) -> dict[str, Array]:
    """Return the arrays of `QUANTITIES`."""
    return _of_payload(run) | _of_uavs(run) | _of_team(run) | _of_agents(run)


def _of_payload(run: AnalysedRun) -> dict[str, Array]:
    """Return time and the series of the payload."""
    s = run.series
    return {
        "time_s": s.times_s,
        "payload_position_m": s.x[:, state.R0],
        "payload_reference_m": s.payload_reference_I,
        "payload_error_m": s.payload_error_I,
        "payload_error_norm_m": s.payload_error_norm_m,
        "payload_velocity_mps": s.payload_velocity_I,
        "payload_attitude_deg": s.attitude_deg,
        "attitude_max_deg": s.attitude_max_deg,
        "payload_rate_radps": s.x[:, state.OMEGA0],
    }


def _of_uavs(run: AnalysedRun) -> dict[str, Array]:
    """Return the series of the UAVs, NaN after a release."""
    s = run.series
    N = run.setup.system.N
    on_rods = s.on_rods[:, :, None]
    uavs = s.x[:, state.PAYLOAD :].reshape(len(s.ticks), N, state.PER_UAV)
    attitudes_deg = np.degrees(uavs[:, :, state.THETA])
    return {
        "uav_position_m": np.where(on_rods, s.uavs_I, np.nan),
        "uav_reference_m": s.uav_references_I,
        "uav_error_m": s.uav_errors_I,
        "uav_attitude_deg": np.where(on_rods, attitudes_deg, np.nan),
        **_inputs(run),
    }


def _inputs(run: AnalysedRun) -> dict[str, Array]:
    """Return the inputs of the UAVs with their limits, and the tensions of cables."""
    s = run.series
    T = len(s.ticks)
    N = run.setup.system.N
    limits = run.setup.settings.limits
    commands_rates = run.setup.system.commands_rates
    inputs = s.u.reshape(T, N, state.INPUTS)

    missing = np.full((T, N, 3), np.nan)
    moments_Nm = missing.copy() if commands_rates else inputs[:, :, 1:]
    rates_radps = inputs[:, :, 1:] if commands_rates else missing
    tensions_N = missing[:, :, 0].copy()
    row_of_tick = s.row_of_tick
    for actual in run.log.of(ActualInputs):
        row = row_of_tick.get(actual.tick)
        if row is None:
            continue
        if commands_rates:
            moments_Nm[row] = actual.inputs[:, 1:]
        if len(actual.tensions):
            tensions_N[row] = actual.tensions

    return {
        "thrust_N": inputs[:, :, 0],
        "thrust_limits_N": np.tile(limits.thrust_N, (T, 1)),
        "moment_Nm": moments_Nm,
        "moment_limit_Nm": np.tile(limits.moments_Nm, (T, 1)),
        "rate_command_radps": rates_radps,
        "cable_tension_N": tensions_N,
    }


def _of_team(run: AnalysedRun) -> dict[str, Array]:
    """Return distances, cost and constraints of the whole team."""
    s = run.series
    return {
        "separation_m": s.separation_m,
        "clearance_m": s.clearance_m,
        "cost": s.cost,
        "constraint_violation": s.violation,
    }


def _of_agents(run: AnalysedRun) -> dict[str, Array]:
    """Return the series of the agents, NaN without a step."""
    s = run.series
    T = len(s.ticks)
    M = len(run.setup.agents)
    plan_ages = np.full((T, M), np.nan)
    delays_s = np.full((T, M, M), np.nan)
    lost = np.full((T, M), np.nan)
    step_ms = np.full((T, M), np.nan)
    force_N = np.full((T, M, 3), np.nan)

    row_of_tick = s.row_of_tick
    delays = plan_delays(run.setup, run.log)
    for report in run.log.of(StepReport):
        row = row_of_tick.get(report.tick)
        if row is None or report.agent not in run.setup.agents:
            continue
        column = report.agent - 1
        ages = [age for age in report.plan_ages if age >= 0]
        plan_ages[row, column] = max(ages, default=np.nan)
        for sender, delay_s in delays[report.tick, report.agent].items():
            delays_s[row, column, sender - 1] = delay_s
        lost[row, column] = report.lost
        step_ms[row, column] = report.times_ms[-1]
        force_N[row, column] = report.force

    return {
        "uav_error_max_m": s.uav_error_max_m(run.setup.owned),
        "plan_age_ticks": plan_ages,
        "plan_delay_s": delays_s,
        "plans_lost": lost,
        "estimated_force_N": force_N,
        "step_ms": step_ms,
    }


def _quantity(name: str) -> Quantity:
    """Return the quantity of a name; raise ArgumentError for another name."""
    if name not in QUANTITIES:
        raise ArgumentError(f"{name}: expected one of {', '.join(QUANTITIES)}")
    return QUANTITIES[name]
