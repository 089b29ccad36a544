"""Step table of a run: one row per agent and tick."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from model import state
from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, StepReport
from transport.analysis.series import series_of
from transport.log.run_log import RunLog

# Columns with this ending are wall-clock times; all others are equal bit for bit in equal runs.
WALL_CLOCK = "_ms"

_SOLVE = ("status", "solver", "fallback", "iterations", "residual")
_MESSAGES = ("delivered", "late", "lost")
_FLIGHT = ("cost", "attitude_deg", "payload_error_m", "uav_error_m", "separation_min_m", "constraint_violation")
_FORCE = ("force_x_N", "force_y_N", "force_z_N")
_MOMENTS = ("thrust{}_N", "moment{}_x_Nm", "moment{}_y_Nm", "moment{}_z_Nm")
_RATES = ("thrust{}_N", "rate{}_x_rad_s", "rate{}_y_rad_s", "rate{}_z_rad_s")


def steps_columns(setup: Setup) -> list[str]:
    """Return the names of the columns, which depend on the number of UAVs and the kind of their inputs."""
    return [
        *("tick", "t_s", "agent"),
        *_SOLVE,
        *("plan_age_max", "state_age_max"),
        *_MESSAGES,
        *_FORCE,
        *_FLIGHT,
        *(name.format(uav) for uav in range(1, setup.system.N + 1) for name in _inputs(setup)),
        *(f"{stage}{WALL_CLOCK}" for stage in STAGES),
    ]


def steps_rows(setup: Setup, log: RunLog) -> Iterator[dict[str, Any]]:
    """Yield one row per agent and tick, values by column, sorted by tick, then agent.

    `cost`, `attitude_deg`, `payload_error_m`, `separation_min_m` and `constraint_violation` refer to the whole team and
    are equal for all agents of a tick; `uav_error_m` and the inputs refer to the UAVs of the agent, the error
    to those of them that are not released. Inputs of other UAVs, and values missing in the log, are None.
    """
    series, columns = series_of(setup, log), steps_columns(setup)
    at = {int(tick): row for row, tick in enumerate(series.ticks)}
    payload_m = np.linalg.norm(series.payload_error_I, axis=1)
    uavs_m = np.linalg.norm(series.uav_errors_I, axis=2)
    attitude_deg = series.attitude_max_deg
    reports = {(report.tick, report.agent): report for report in log.of(StepReport)}
    for (tick, agent), report in sorted(reports.items()):
        row: dict[str, Any] = dict.fromkeys(columns)
        row |= {"tick": tick, "t_s": tick * setup.settings.sampling_period_s, "agent": agent}
        row |= {name: getattr(report, name) for name in (*_SOLVE, *_MESSAGES)}
        row["fallback"] = int(report.fallback)
        row |= {"plan_age_max": _oldest(report.plan_ages), "state_age_max": _oldest(report.state_ages)}
        row |= {name: float(value) for name, value in zip(_FORCE, report.force, strict=True)}
        row |= {f"{stage}{WALL_CLOCK}": float(ms) for stage, ms in zip(STAGES, report.times_ms, strict=True)}
        k = at.get(tick)
        if k is not None:
            owned = setup.owned[agent - 1] if agent <= len(setup.owned) else ()
            uav_m = max((float(uavs_m[k, i]) for i in owned if series.on_rods[k, i]), default=None)
            separation_m = float(series.separation_m[k]) if setup.system.N > 1 else None
            numbers = float(series.cost[k]), float(attitude_deg[k]), float(payload_m[k])
            row |= zip(_FLIGHT, (*numbers, uav_m, separation_m, float(series.violation[k])), strict=True)
            for i in owned:
                inputs = series.u[k, state.input_slice(i)]
                row |= {name.format(i + 1): float(value) for name, value in zip(_inputs(setup), inputs, strict=True)}
        yield row


def _inputs(setup: Setup) -> tuple[str, ...]:
    return _RATES if setup.system.commands_rates else _MOMENTS


def _oldest(ages: tuple[int, ...]) -> int | None:
    """Return the largest age; -1 if anything was never received yet; None without other agents."""
    if not ages:
        return None
    return -1 if min(ages) < 0 else max(ages)
