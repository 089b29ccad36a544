"""The numbers of a run.

From its log to summary.json, described in docs/summary.md and summary.schema.json.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from itertools import zip_longest
from typing import Any

import numpy as np
from scipy.stats import chi2

from transport.analysis.airtime import radio_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.series import Series, estimates_of, swing_of
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.state import R0
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire import messages
from transport.protocol.wire.names import agent_name

# Time after which a target counts as reached or missed, s; tolerance of times.
SETTLED_S, _ROUNDING_S, _DIGITS = 2.0, 1e-9, 9
_ORIGIN = {"script": " by script", "person": " by hand", "unknown": ""}


def summarise(run: AnalysedRun) -> dict[str, Any]:
    """Return the summary of a run as JSON data (summary.schema.json).

    None for anything the log does not tell.
    """
    setup = run.setup
    log = run.log
    series = run.series
    control = next(log.of(messages.Control), None)
    reports = list(log.of(messages.StepReport))
    processes = log.header.get("processes", "")
    times_ms = np.array([report.times_ms for report in reports]).reshape(-1, len(messages.STAGES))
    medians_ms = {
        stage: _percentiles(times_ms[:, i])["p50"] for i, stage in enumerate(messages.STAGES[:-1])
    }
    ages = [age for report in reports for age in report.plan_ages if age >= 0]
    return {
        "run_id": log.header.get("run_id", ""),
        "scenario": setup.scenario.name,
        "outcome": control.outcome if control else "unknown",
        "reason": control.reason if control else "",
        "exit_code": control.exit_code if control else None,
        "processes": int(processes) if processes.isdecimal() else None,
        "controller": {
            "name": log.header.get("controller", "mpc"),
            "agents": len(setup.owned),
            "owned": [[uav + 1 for uav in group] for group in setup.owned],
            "prediction": setup.settings.prediction,
            "relaxation": setup.settings.relaxation,
            "negotiation_iterations": setup.scenario.controller.negotiation_iterations,
            "sampling_period_s": setup.settings.sampling_period_s,
            "horizon": setup.settings.horizon,
            "solver": setup.settings.solver,
        },
        **_durations(setup, log, series),
        **_flight(setup, series),
        "cables": _cables(setup, log),
        "estimate": _consistency(series, log),
        "agent_step_ms": {**_percentiles(times_ms[:, -1]), "by_stage": medians_ms},
        "rest_of_tick_ms": _percentiles(rest_of_tick_ms(setup, log).values()),
        "deadline": _deadline(setup, log),
        "plan_age_ticks": {
            "mean": sum(ages) / len(ages) if ages else None,
            "max": max(ages, default=None),
        },
        "messages": _messages(setup, log, reports),
        "radio": radio_of(setup, log),
        "rejections": _rejections(log),
        "solver": _solver(setup, reports),
        "faults": events(setup, log, control),
        "targets": _targets(setup, series),
        # From "python 3.12.1, numpy 2.0.0" to names and versions.
        "versions": dict(
            v.rsplit(" ", 1) for v in log.header.get("versions", "").split(", ") if " " in v
        ),
        "engine": log.header.get("engine", setup.scenario.plant.engine),
        "machine": log.header.get("machine", ""),
        "seed": setup.scenario.seed,
        "log_cut": log.cut or None,
    }


def rest_of_tick_ms(setup: Setup, log: RunLog) -> dict[int, float]:
    """Return the time of each tick without its slowest agent's step, by tick, ms.

    It runs from the recorder's receiving tick k to its receiving tick k + 1, minus the slowest step
    of tick k, at
    least 0: message transport, coding, the work of plant and coordinator, and waiting for a
    processor. Empty for a paced run (speed > 0), whose ticks wait for the clock.
    """
    if setup.scenario.clock.speed > 0.0:
        return {}
    received_ns = log.received_ns(messages.Tick)
    slowest: dict[int, float] = {}
    for report in log.of(messages.StepReport):
        slowest[report.tick] = max(float(report.times_ms[-1]), slowest.get(report.tick, 0.0))
    return {
        tick: max(0.0, (received_ns[tick + 1] - at) / 1e6 - slowest[tick])
        for tick, at in received_ns.items()
        if tick in slowest and tick + 1 in received_ns
    }


def events(setup: Setup, log: RunLog, control: messages.Control | None) -> list[dict[str, Any]]:
    """Return the events in the order of their ticks, as JSON data with the fields of `faults` in the schema."""
    began_ns = min(log.received_ns(messages.Tick).values(), default=None)
    found = sorted(_events(setup, log), key=lambda event: event[0].tick)
    if control is not None and control.reason:
        found.append(
            (
                control,
                log.received_ns(messages.Control).get(control.tick),
                "end",
                control.reason,
                [],
            )
        )
    return [
        {
            "tick": message.tick,
            "time_s": round(message.tick * setup.settings.sampling_period_s, _DIGITS),
            "wall_s": None
            if began_ns is None or received_ns is None
            else (received_ns - began_ns) / 1e9,
            "kind": kind,
            "processes": processes,
            "what": what,
        }
        for message, received_ns, kind, what, processes in found
    ]


def _events(
    setup: Setup, log: RunLog
) -> Iterator[tuple[messages.Message, int | None, str, str, list[str]]]:
    """Yield message, time of arrival, kind, description and processes of each event before the end."""
    degraded, before = [fault for fault in setup.faults if fault.do == "degrade"], None
    # A problem of a controller is one event, at its first tick, of all agents that have it.
    agents_by_problem: dict[str, set[int]] = {}
    for note in log.of(messages.Note):
        agents_by_problem.setdefault(note.problem, set()).add(note.agent)
    noted: set[str] = set()
    for message, at_ns in ((entry.message, entry.received_ns) for entry in log.messages):
        match message:
            case messages.FaultNote(target=target):
                yield (
                    message,
                    at_ns,
                    "fault",
                    f"{target} {message.what}{_ORIGIN[message.origin]}",
                    [target],
                )
            case messages.ActualInputs():
                for fault in (fault for fault in degraded if fault.tick == message.tick):
                    what = f"motors of {fault.target} degraded to {fault.efficiency:g} of their inputs by script"
                    yield message, at_ns, "fault", what, [fault.target]
            case messages.Note(problem=problem) if problem and problem not in noted:
                noted.add(problem)
                agents = [agent_name(agent) for agent in sorted(agents_by_problem[problem])]
                yield message, at_ns, "notice", f"{', '.join(agents)}: {problem}", agents
            case messages.Roster():
                lost = {*message.off, *message.released} - (
                    {*before.off, *before.released} if before else set()
                )
                released = {*message.released} - ({*before.released} if before else set())
                left = set() if before is None else {*before.agents} - {*message.agents}
                joined = set() if before is None else {*message.agents} - {*before.agents}
                if lost or released:
                    what = f"{message.reason} by script"
                    yield (
                        message,
                        at_ns,
                        "fault",
                        what,
                        [f"uav{uav}" for uav in sorted(lost | released)],
                    )
                elif before is not None:
                    kind = "detected" if left else "rejoined" if joined else "notice"
                    yield (
                        message,
                        at_ns,
                        kind,
                        message.reason,
                        [agent_name(a) for a in sorted(left or joined)],
                    )
                before = message


def _durations(setup: Setup, log: RunLog, series: Series) -> dict[str, Any]:
    sim_time_s = len(series.ticks) * setup.settings.sampling_period_s
    begin_ns = min(log.received_ns(messages.Tick).values(), default=None)
    last_ns = log.messages[-1].received_ns if log.messages else None  # if the end is not recorded
    end_ns = min(log.received_ns(messages.Control).values(), default=last_ns)
    wall_time_s = None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / 1e9
    started = log.header.get("command_started_ns", "")
    return {
        "ticks": len(series.ticks),
        "sim_time_s": sim_time_s,
        "wall_time_s": wall_time_s,
        "startup_s": (begin_ns - int(started)) / 1e9
        if begin_ns is not None and started.isdecimal()
        else None,
        "real_time_factor": sim_time_s / wall_time_s if wall_time_s else None,
    }


def _flight(setup: Setup, series: Series) -> dict[str, Any]:
    # The first phase lets the formation settle about its hover, as in the paper's section V.
    settled = series.times_s >= setup.maneuver.stages()[0][2]
    swing_m = swing_of(setup, series)
    clear_m = map(_number, series.clearance_m.min(axis=0, initial=np.inf))
    return {
        "cost": {
            "mean": _number(series.cost.mean()) if len(series.cost) else None,
            "max": _largest(series.cost),
            "max_after_hover": _largest(series.cost[settled]),
        },
        "attitude_max_deg": _largest(series.attitude_max_deg),
        "uav_tracking": _tracking(series.uav_errors_I[series.on_rods]),
        "payload_tracking": {
            **_tracking(series.payload_error_I),
            "swing_m": None if swing_m is None else _number(swing_m),
        },
        "separation_min_m": _number(series.separation_m.min(initial=np.inf)),
        "clearance_min_m": dict(zip(("uav", "rod", "payload"), clear_m, strict=True))
        if setup.obstacles
        else None,
        "constraint_violation_max": _largest(series.violation),
        "local_error_max": _largest(series.local_error),
    }


def _cables(setup: Setup, log: RunLog) -> dict[str, Any] | None:
    """Return the least tension of the cables, and how often and how long they were slack.

    None without cables.
    """
    found = {
        actual.tick: actual.tensions
        for actual in log.of(messages.ActualInputs)
        if len(actual.tensions)
    }
    if not found:
        return None
    tensions_N = np.array([found[tick] for tick in sorted(found)])
    slack = np.vstack(
        [np.zeros_like(tensions_N[:1]), tensions_N <= 0.0, np.zeros_like(tensions_N[:1])]
    )
    changes = np.diff(slack, axis=0).T  # +1 at the first tick of a slack, -1 behind its last
    ticks = np.concatenate([np.flatnonzero(of < 0.0) - np.flatnonzero(of > 0.0) for of in changes])
    return {
        "tension_min_N": _number(tensions_N.min()),
        "slack": len(ticks),
        "slack_longest_s": float(ticks.max(initial=0)) * setup.settings.sampling_period_s,
        "slack_at_end": int((tensions_N[-1] <= 0.0).sum()),
    }


def _consistency(series: Series, log: RunLog) -> dict[str, Any] | None:
    """Return errors of the estimates and how they match their covariance, as JSON data.

    None without estimates.

    NEES and NIS are squared errors in units of the covariance (docs/equations.md, after (64)).
    """
    found = estimates_of(series, log)
    if found is None:
        return None
    error = found.true - found.pose
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(found.P, error[:, :, None])[:, :, 0])
    nis, measurements = found.surprise.sum(axis=0)
    low, high = chi2.ppf([0.025, 0.975], error.shape[1])
    rms = np.sqrt((error**2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0))
    return {
        "position_rms_m": float(rms[0]),
        "attitude_rms_deg": float(np.degrees(rms[1])),
        "nees": float(nees.mean()),
        "nees_band": [float(low), float(high)],
        "nis": float(nis / measurements) if measurements else None,
    }


def _targets(setup: Setup, series: Series) -> list[dict[str, Any]]:
    """Return the targets and how close the payload was `SETTLED_S` after its reference had reached the last point.

    A target that is followed sooner, by the next one or the end, counts at that moment.
    """
    targets = setup.maneuver.targets
    found = []
    for target, after in zip_longest(targets, targets[1:]):
        at_s = min(
            target.ends_s + SETTLED_S,
            series.times_s.max(initial=-np.inf),
            np.inf if after is None else after.since_s,
        )
        row = np.searchsorted(series.times_s, at_s - _ROUNDING_S)
        there = at_s >= target.ends_s - _ROUNDING_S
        error_m = float(np.linalg.norm(series.x[row, R0] - target.end_I)) if there else None
        times_s = {
            "t_s": round(target.since_s, _DIGITS),
            "arrives_s": round(target.ends_s, _DIGITS),
        }
        found.append({**times_s, "position_m": target.end_I.tolist(), "error_m": error_m})
    return found


def _tracking(errors_I: Array) -> dict[str, float | None]:
    """Return RMS and maximum of the lengths of position errors, (..., 3), m."""
    errors_m = np.linalg.norm(errors_I, axis=-1).ravel()
    rms_m = _number(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else None
    return {"rms_m": rms_m, "max_m": _largest(errors_m)}


def _deadline(setup: Setup, log: RunLog) -> dict[str, Any]:
    """Count plans that missed their deadline, or ticks held for them, none in lockstep.

    And how late ticks opened.
    """
    if setup.scenario.clock.mode != "realtime":
        return {
            "plans": 0,
            "missed": 0,
            "share": None,
            "worst_ms": None,
            "tick_late_ms": _percentiles([]),
        }
    ticks = {tick.tick: tick for tick in log.of(messages.Tick)}
    pairs = [(tick, ticks[k + 1]) for k, tick in sorted(ticks.items()) if k + 1 in ticks]
    if setup.scenario.clock.on_overrun == "hold":
        # No plan is missing when a tick opens: a deadline is missed by the tick that waited for a
        # late plan.
        missed, plans = sum(after.overrun_ns > 0 for _, after in pairs), len(pairs)
    else:
        missed = sum(len(set(tick.members) - set(after.answered)) for tick, after in pairs)
        plans = sum(len(tick.members) for tick, _ in pairs)
    worst_ms = max((tick.overrun_ns / 1e6 for tick in ticks.values()), default=None)
    return {
        "plans": plans,
        "missed": missed,
        "share": missed / plans if plans else None,
        # The delay of a plan that never came is unknown, not 0.
        "worst_ms": None if missed and not worst_ms else worst_ms,
        "tick_late_ms": _percentiles(tick.late_ns / 1e6 for tick in ticks.values()),
    }


def _messages(setup: Setup, log: RunLog, reports: Iterable[messages.StepReport]) -> dict[str, int]:
    """Count plans between agents.

    A shared one is sent to every other agent that takes a step able to use it.

    Plans neither delivered nor lost were in transit when the run, or their receiver, ended.
    """
    steps: dict[tuple[int, int], set[int]] = {}  # ticks of the steps of each agent and incarnation
    for report in reports:
        steps.setdefault((report.agent, report.incarnation), set()).add(report.tick)
    joined: dict[
        tuple[int, int], int
    ] = {}  # first tick on the roster of each agent and incarnation
    for roster in log.of(messages.Roster):
        for start in zip(roster.agents, roster.incarnations, strict=True):
            joined.setdefault(start, roster.tick)
    realtime = setup.scenario.clock.mode == "realtime"
    usable: dict[
        tuple[int, int], Collection[int]
    ] = {}  # ticks whose plans each agent and incarnation could use
    for start, taken in steps.items():
        # In real time steps are skipped: the next step uses all plans received meanwhile, also of
        # its own tick.
        first = joined.get(start, min(taken))
        usable[start] = range(first, max(taken) + 1) if realtime else {tick - 1 for tick in taken}
    plans = [plan for plan in log.of(messages.Plan) if not plan.negotiation]
    shared = [plan for plan in plans if plan.shared]
    sent = sum(
        plan.tick in ticks
        for plan in shared
        for (receiver, _), ticks in usable.items()
        if receiver != plan.agent
    )
    delivered = sum(report.delivered for report in reports)
    lost = sum(report.lost for report in reports)
    return {
        "planned": len(plans),
        "shared": len(shared),
        "sent": sent,
        "delivered": delivered,
        "lost": lost,
        "in_transit": max(0, sent - delivered - lost),  # a restarted receiver may report more
        "late": sum(report.late for report in reports),
        "rejected": sum(notice.count for notice in log.of(messages.Rejected)),
    }


def _rejections(log: RunLog) -> list[dict[str, Any]]:
    """Return rejected messages by receiver, sender and reason, largest count first."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for notice in log.of(messages.Rejected):
        counts[notice.sender, notice.offender, notice.reason] += notice.count
    return [
        {"by": by, "sender": sender, "reason": reason, "count": count}
        for (by, sender, reason), count in sorted(
            counts.items(), key=lambda entry: (-entry[1], entry[0])
        )
    ]


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


def _percentiles(values: Iterable[float] | Array) -> dict[str, float | None]:
    values = np.fromiter(values, dtype=np.float64)
    if not len(values):
        return {"p50": None, "p99": None, "max": None}
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}


def _largest(values: Array) -> float | None:
    return _number(values.max()) if len(values) else None


def _number(value: Any) -> float | None:
    """Return a finite number.

    None for one that overflowed in a diverged run, which JSON cannot hold.
    """
    return float(value) if np.isfinite(value) else None
