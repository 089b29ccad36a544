"""Table of the steps of a run: a row for each agent and tick, as in steps.csv."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.plan_delays import plan_delays
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import STAGES, StepReport

# Columns with this ending are wall-clock times; all others are equal bit for bit in equal runs.
WALL_CLOCK = "_ms"

_SOLVE = ("status", "solver", "fallback", "iterations", "residual")
_AGES = ("plan_age_max", "state_age_max")
_DELAY = "plan_delay{}_s"
_MESSAGES = ("delivered", "late", "lost")
_FORCE = ("force_x_N", "force_y_N", "force_z_N")
# Names, units and values are those of the series of the same names in Python.
_TEAM = (
    "cost",
    "attitude_max_deg",
    "payload_error_norm_m",
    "uav_error_max_m",
    "separation_m",
    "constraint_violation",
)
_MOMENTS = ("thrust{}_N", "moment{}_x_Nm", "moment{}_y_Nm", "moment{}_z_Nm")
_RATES = ("thrust{}_N", "rate{}_x_rad_s", "rate{}_y_rad_s", "rate{}_z_rad_s")


def steps_columns(setup: Setup) -> list[str]:
    """Return the names of the columns.

    They depend on the number of UAVs and the kind of their inputs.
    """
    inputs = [name for i in range(setup.system.N) for name in _input_names(setup, i)]
    delays = [_DELAY.format(agent) for agent in setup.agents]
    times = [f"{stage}{WALL_CLOCK}" for stage in STAGES]
    return [
        *("tick", "t_s", "agent"),
        *_SOLVE,
        *_AGES,
        *delays,
        *_MESSAGES,
        *_FORCE,
        *_TEAM,
        *inputs,
        *times,
    ]


def steps_rows(run: AnalysedRun) -> Iterator[dict[str, Any]]:
    """Yield one row per agent and tick, values by column, sorted by tick, then agent.

    `cost`, `attitude_max_deg`, `payload_error_norm_m`, `separation_m` and `constraint_violation`
    refer to the whole team and are equal for all agents of a tick; `uav_error_max_m` and the inputs
    refer to the UAVs of the agent. Inputs of other UAVs, and values missing in the log, are None.
    """
    columns = steps_columns(run.setup)
    row_of_tick = run.series.row_of_tick
    team = _team_series(run)
    uav_errors_m = run.series.uav_error_max_m(run.setup.owned)
    delays = plan_delays(run.setup, run.log)
    reports = {(report.tick, report.agent): report for report in run.log.of(StepReport)}

    for (tick, agent), report in sorted(reports.items()):
        row: dict[str, Any] = dict.fromkeys(columns)
        row["tick"] = tick
        row["t_s"] = tick * run.setup.settings.sampling_period_s
        row["agent"] = agent
        row |= _of_report(report)
        row |= {_DELAY.format(sender): delay for sender, delay in delays[tick, agent].items()}

        k = row_of_tick.get(tick)
        if k is not None:
            row |= {name: float(values[k]) for name, values in team.items()}
            if agent <= len(run.setup.owned):
                row["uav_error_max_m"] = _number(uav_errors_m[k, agent - 1])
                row |= _inputs(run, agent, k)
        yield row


def _of_report(report: StepReport) -> dict[str, Any]:
    """Return the values that an agent reports about a step, by column."""
    values = {name: getattr(report, name) for name in (*_SOLVE, *_MESSAGES)}
    values["fallback"] = int(report.fallback)
    values["plan_age_max"] = _oldest(report.plan_ages)
    values["state_age_max"] = _oldest(report.state_ages)
    values |= zip(_FORCE, report.force.tolist(), strict=True)

    for stage, time_ms in zip(STAGES, report.times_ms, strict=True):
        values[f"{stage}{WALL_CLOCK}"] = float(time_ms)

    return values


def _team_series(run: AnalysedRun) -> dict[str, Array]:
    """Return the series of the whole team, (T,), by column; no separation for one UAV."""
    series = run.series
    columns = {
        "cost": series.cost,
        "attitude_max_deg": series.attitude_max_deg,
        "payload_error_norm_m": series.payload_error_norm_m,
        "constraint_violation": series.violation,
    }
    if run.setup.system.N > 1:
        columns["separation_m"] = series.separation_m
    return columns


def _inputs(run: AnalysedRun, agent: int, k: int) -> dict[str, float]:
    """Return the inputs of the UAVs of an agent in row k of the series, by column."""
    values: dict[str, float] = {}
    for i in run.setup.owned[agent - 1]:
        names = _input_names(run.setup, i)
        values |= zip(names, run.series.u[k, state.input_slice(i)].tolist(), strict=True)
    return values


def _input_names(setup: Setup, i: int) -> list[str]:
    """Return the columns of the inputs of UAV i (0-based)."""
    names = _RATES if setup.system.commands_rates else _MOMENTS
    return [name.format(i + 1) for name in names]


def _oldest(ages: tuple[int, ...]) -> int | None:
    """Return the largest age, ticks.

    -1 if nothing has been received yet from any of the others; None without other agents.
    """
    if min(ages, default=0) < 0:
        return -1
    return max(ages, default=None)


def _number(value: float) -> float | None:
    """Return a number; None for one that does not exist."""
    return None if np.isnan(value) else float(value)
