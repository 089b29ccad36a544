"""Numbers of a run as in summary.json: docs/reference/summary.md and summary.schema.json describe them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from transport.analysis.airtime import radio_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.communication_metrics import (
    deadline,
    links_of_plant,
    plans_between_agents,
    rejections,
    rest_of_tick_ms,
)
from transport.analysis.cost_and_tracking_metrics import (
    cables,
    cost_and_tracking,
    targets,
)
from transport.analysis.estimates import consistency
from transport.analysis.events import TIME_DIGITS, events
from transport.analysis.numbers_for_json import percentiles
from transport.analysis.series import Series
from transport.analysis.user_constraint_violations import own_constraints
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages

_NS_PER_S = 1e9


def summarise(run: AnalysedRun) -> dict[str, Any]:
    """Return the summary of a run as JSON data (summary.schema.json).

    None for anything the log does not tell.
    """
    setup = run.setup
    log = run.log
    series = run.series
    control = next(log.of(messages.Control), None)
    reports = list(log.of(messages.StepReport))
    radio = radio_of(setup, log)
    replaced = 0 if radio is None else radio["replaced"]

    return {
        "run_id": log.header.get("run_id", ""),
        "scenario": setup.scenario.name,
        **_end(control),
        "processes": _processes(log),
        "controller": _controller(setup, log),
        **_durations(setup, log, series),
        **cost_and_tracking(setup, series),
        "collision": _collision(series),
        "own_constraints": own_constraints(setup, series, log),
        "cables": cables(setup, log),
        "estimate": consistency(series, log),
        "agent_step_ms": _step_times(reports),
        "rest_of_tick_ms": percentiles(rest_of_tick_ms(setup, log).values()),
        "deadline": deadline(setup, log),
        "plan_age_ticks": _plan_ages(reports),
        "messages": {
            **plans_between_agents(setup, log, reports, replaced=replaced),
            **links_of_plant(log, reports),
        },
        "radio": radio,
        "rejections": rejections(log),
        "solver": _solver(setup, reports),
        "faults": events(setup, log, control),
        "targets": targets(setup, series, log),
        "versions": _versions(log),
        "engine": log.header.get("engine", setup.scenario.plant.engine),
        "machine": log.header.get("machine", ""),
        "seed": setup.scenario.seed,
        "log_cut": log.cut or None,
    }


def _end(control: messages.Control | None) -> dict[str, Any]:
    """Return how the run ended."""
    if control is None:
        return {"outcome": "unknown", "reason": "", "exit_code": None}
    return {
        "outcome": control.outcome,
        "reason": control.reason,
        "exit_code": control.exit_code,
    }


def _collision(series: Series) -> dict[str, Any] | None:
    """Return the first contact of two UAVs; None if there is none."""
    contact = series.contact
    if contact is None:
        return None
    return {
        "at_s": round(contact.at_s, TIME_DIGITS),
        "uavs": list(contact.uavs),
        "distance_m": contact.distance_m,
    }


def _processes(log: RunLog) -> int | None:
    """Return the number of processes of the run."""
    number = log.header.get("processes", "")
    return int(number) if number.isdecimal() else None


def _versions(log: RunLog) -> dict[str, str]:
    """Return versions by name, from a text such as "python 3.12.1, numpy 2.0.0"."""
    entries = log.header.get("versions", "").split(", ")
    return dict(entry.rsplit(" ", 1) for entry in entries if " " in entry)


def _controller(setup: Setup, log: RunLog) -> dict[str, Any]:
    """Return the controller of the agents and its main settings; UAVs count from 1."""
    settings = setup.settings
    return {
        "name": log.header.get("controller", "mpc"),
        "agents": len(setup.owned),
        "owned": [[uav + 1 for uav in group] for group in setup.owned],
        "prediction": settings.prediction,
        "relaxation": settings.relaxation,
        "negotiation_iterations": setup.scenario.controller.negotiation_iterations,
        "sampling_period_s": settings.sampling_period_s,
        "horizon": settings.horizon,
        "solver": settings.solver,
    }


def _durations(setup: Setup, log: RunLog, series: Series) -> dict[str, Any]:
    """Return ticks and times of the run, simulated and by the wall clock, s."""
    sim_time_s = len(series.ticks) * setup.settings.sampling_period_s
    begin_ns = min(log.received_ns(messages.Tick).values(), default=None)
    last_ns = log.messages[-1].received_ns if log.messages else None  # if the end is not recorded
    end_ns = min(log.received_ns(messages.Control).values(), default=last_ns)
    wall_time_s = None
    if begin_ns is not None and end_ns is not None:
        wall_time_s = (end_ns - begin_ns) / _NS_PER_S

    started_ns = log.header.get("command_started_ns", "")
    startup_s = None
    if begin_ns is not None and started_ns.isdecimal():
        startup_s = (begin_ns - int(started_ns)) / _NS_PER_S

    return {
        "ticks": len(series.ticks),
        "sim_time_s": sim_time_s,
        "wall_time_s": wall_time_s,
        "startup_s": startup_s,
        "real_time_factor": sim_time_s / wall_time_s if wall_time_s else None,
    }


def _step_times(reports: Sequence[messages.StepReport]) -> dict[str, Any]:
    """Return the times of the agents' steps, and the median of each stage, ms."""
    times_ms = np.array([report.times_ms for report in reports])
    times_ms = times_ms.reshape(-1, len(messages.STAGES))
    *stages, _ = messages.STAGES  # the last one is the whole step
    medians_ms = {stage: percentiles(times_ms[:, i])["p50"] for i, stage in enumerate(stages)}
    return {**percentiles(times_ms[:, -1]), "by_stage": medians_ms}


def _plan_ages(reports: Iterable[messages.StepReport]) -> dict[str, float | None]:
    """Return mean and maximum of the ages of the plans in use, ticks; None without any."""
    ages = [age for report in reports for age in report.plan_ages if age >= 0]
    if not ages:
        return {"mean": None, "max": None}
    return {"mean": sum(ages) / len(ages), "max": max(ages)}


def _solver(setup: Setup, reports: Iterable[messages.StepReport]) -> dict[str, Any]:
    """Return how often the second solver was used, and the failed steps with all their agents."""
    steps = Counter[int]()
    failed = Counter[int]()
    fallbacks = 0
    for report in reports:
        steps[report.agent] += 1
        failed[report.agent] += report.status != "solved"
        fallbacks += report.fallback

    agents = [
        {"agent": agent, "steps": steps[agent], "failures": failed[agent]}
        for agent in sorted(steps)
        if failed[agent]
    ]
    allowed = setup.scenario.agents.failed_share
    return {
        "fallbacks": fallbacks,
        "failures": failed.total(),
        "failed_agents": agents,
        "beyond_share": any(failed[agent] / steps[agent] > allowed for agent in steps),
    }
