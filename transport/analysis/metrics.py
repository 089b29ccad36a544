"""The numbers of a run: from its log to the summary that docs/summary.md and summary.schema.json describe."""

from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import (
    STAGES,
    Control,
    FaultNote,
    Message,
    Plan,
    Rejected,
    Roster,
    StepReport,
    Tick,
    agent_name,
)
from transport.analysis.series import Series, series_of
from transport.analysis.swing import swing_of
from transport.log.run_log import RunLog


def summarise(setup: Setup, log: RunLog) -> dict[str, Any]:
    """The summary of a run, as plain data that JSON can hold.

    Args:
        setup: The run as it was flown.
        log: Its log; whatever a log that is not whole cannot tell is None.
    Returns: The fields of transport/summary.schema.json.
    """
    series = series_of(setup, log)
    control = next(iter(log.of(Control)), None)
    reports = list(log.of(StepReport))
    processes = log.header.get("processes", "")
    return {
        "run_id": log.header.get("run_id", ""),
        "scenario": setup.scenario.name,
        "outcome": control.outcome if control else "unknown",
        "reason": control.reason if control else "",
        "exit_code": control.exit_code if control else None,
        "processes": int(processes) if processes.isdecimal() else None,
        "controller": _controller(setup),
        **_durations(setup, log, series),
        **_flight(setup, series),
        "agent_step_ms": _step_times(reports),
        "rest_of_tick_ms": _spread(rest_of_tick_ms(setup, log).values()),
        "deadline": _deadline(setup, log),
        "plan_age_ticks": _ages(reports),
        "messages": _messages(setup, log, reports),
        "rejections": _rejections(log),
        "solver": {
            "fallbacks": sum(report.fallback for report in reports),
            "failures": sum(report.status != "solved" for report in reports),
        },
        "faults": _faults(setup, log, control),
        "versions": _versions(log.header.get("versions", "")),
        "machine": log.header.get("machine", ""),
        "seed": setup.scenario.seed,
        "log_cut": log.cut or None,
    }


def rest_of_tick_ms(setup: Setup, log: RunLog) -> dict[int, float]:
    """What each tick took besides the slowest agent's step, by tick, ms.

    From the recorder's receiving tick k to its receiving tick k + 1, minus the slowest step of tick k, at least
    0: all ways of the messages there and back, coding, the plant's and the coordinator's work, and waiting for
    a processor. Empty for a paced run (speed > 0), whose ticks wait for the clock.
    """
    if setup.scenario.clock.speed > 0.0:
        return {}
    received_ns = log.received_ns(Tick)
    slowest: dict[int, float] = {}
    for report in log.of(StepReport):
        slowest[report.tick] = max(float(report.times_ms[-1]), slowest.get(report.tick, 0.0))
    return {
        tick: max(0.0, (received_ns[tick + 1] - at) / 1e6 - slowest[tick])
        for tick, at in received_ns.items()
        if tick in slowest and tick + 1 in received_ns
    }


def _controller(setup: Setup) -> dict[str, Any]:
    return {
        "agents": len(setup.owned),
        "owned": [[uav + 1 for uav in group] for group in setup.owned],
        "prediction": setup.settings.prediction,
        "relaxation": setup.settings.relaxation,
        "negotiation_iterations": setup.scenario.controller.negotiation_iterations,
        "sampling_period_s": setup.settings.sampling_period_s,
        "horizon": setup.settings.horizon,
        "solver": setup.settings.solver,
    }


def _durations(setup: Setup, log: RunLog, series: Series) -> dict[str, Any]:
    sim_time_s = len(series.ticks) * setup.settings.sampling_period_s
    begin_ns = min(log.received_ns(Tick).values(), default=None)
    end_ns = min(log.received_ns(Control).values(), default=None)
    if end_ns is None and log.messages:
        end_ns = log.messages[-1].received_ns
    wall_time_s = None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / 1e9
    started = log.header.get("command_started_ns", "")
    return {
        "ticks": len(series.ticks),
        "sim_time_s": sim_time_s,
        "wall_time_s": wall_time_s,
        "startup_s": (begin_ns - int(started)) / 1e9 if begin_ns is not None and started.isdecimal() else None,
        # A run cut off by a crash has no end; how fast it was until then is its last message's to say.
        "real_time_factor": sim_time_s / wall_time_s if wall_time_s else None,
    }


def _flight(setup: Setup, series: Series) -> dict[str, Any]:
    # The first phase lets the formation settle about its hover, as in the paper's section V.
    settled = series.times_s >= setup.maneuver.phases[0].duration_s
    swing = swing_of(setup, series)
    return {
        "cost": {
            "mean": _number(series.cost.mean()) if len(series.cost) else None,
            "max": _largest(series.cost),
            "max_after_hover": _largest(series.cost[settled]),
        },
        "attitude_max_deg": _largest(series.attitude_max_deg),
        "uav_tracking": _tracking(series.uav_errors_I),
        "payload_tracking": {
            **_tracking(series.payload_error_I),
            "swing_m": None if swing.largest_m is None else _number(swing.largest_m),
            "decays": swing.decays,
        },
        "separation_min_m": _number(series.separation_m.min(initial=np.inf)),
        "constraint_violation_max": _largest(series.violation),
    }


def _tracking(errors_I: Array) -> dict[str, float | None]:
    """RMS and maximum of the lengths of position errors, (..., 3), m."""
    errors_m = np.linalg.norm(errors_I, axis=-1).ravel()
    return {
        "rms_m": _number(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else None,
        "max_m": _largest(errors_m),
    }


def _step_times(reports: Iterable[StepReport]) -> dict[str, Any]:
    times_ms = np.array([report.times_ms for report in reports]).reshape(-1, len(STAGES))
    medians = {stage: _spread(times_ms[:, i])["p50"] for i, stage in enumerate(STAGES[:-1])}
    return {**_spread(times_ms[:, -1]), "by_stage": medians}


def _ages(reports: Iterable[StepReport]) -> dict[str, float | int | None]:
    ages = [age for report in reports for age in report.plan_ages if age >= 0]
    return {"mean": sum(ages) / len(ages) if ages else None, "max": max(ages, default=None)}


def _messages(setup: Setup, log: RunLog, reports: Iterable[StepReport]) -> dict[str, int]:
    """Plans between agents: a shared one counts as sent to every other agent that takes a step it could be used at.

    What is neither delivered nor lost was on its way when the run, or its receiver, ended.
    """
    steps: dict[tuple[int, int], set[int]] = {}  # taken by each start of an agent
    for report in reports:
        steps.setdefault((report.agent, report.incarnation), set()).add(report.tick)
    joined, realtime = _joined(log), setup.scenario.clock.mode == "realtime"
    uses: dict[tuple[int, int], Collection[int]] = {}  # ticks whose plans they could be
    for start, taken in steps.items():
        # In real time steps are skipped: what comes meanwhile is used at the next one, perhaps the plan's own.
        first = joined.get(start, min(taken))
        uses[start] = range(first, max(taken) + 1) if realtime else {tick - 1 for tick in taken}
    plans = [plan for plan in log.of(Plan) if not plan.negotiation]
    shared = [plan for plan in plans if plan.shared]
    sent = sum(
        plan.tick in usable for plan in shared for (receiver, _), usable in uses.items() if receiver != plan.agent
    )
    delivered = sum(report.delivered for report in reports)
    return {
        "planned": len(plans),
        "shared": len(shared),
        "sent": sent,
        "delivered": delivered,
        "lost": sum(report.lost for report in reports),
        "late": sum(report.late for report in reports),
        "rejected": sum(notice.count for notice in log.of(Rejected)),
    }


def _joined(log: RunLog) -> dict[tuple[int, int], int]:
    """The tick from which on each start of an agent is on the roster."""
    joined: dict[tuple[int, int], int] = {}
    for roster in log.of(Roster):
        for start in zip(roster.agents, roster.incarnations, strict=True):
            joined.setdefault(start, roster.tick)
    return joined


def _rejections(log: RunLog) -> list[dict[str, Any]]:
    """Messages refused, by who refused them, who sent them and why; most of them first."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for notice in log.of(Rejected):
        counts[notice.sender, notice.offender, notice.reason] += notice.count
    return [
        {"by": by, "sender": sender, "reason": reason, "count": count}
        for (by, sender, reason), count in sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
    ]


def _deadline(setup: Setup, log: RunLog) -> dict[str, Any]:
    """How well real time was kept: plans that came after their deadline, and ticks that were opened late."""
    if setup.scenario.clock.mode != "realtime":
        # The lockstep clock waits: there is no deadline to miss.
        return {"plans": 0, "missed": 0, "share": None, "worst_ms": None, "tick_late_ms": _spread([])}
    ticks = {tick.tick: tick for tick in log.of(Tick)}
    followed = [(tick, ticks[k + 1]) for k, tick in sorted(ticks.items()) if k + 1 in ticks]
    missed = sum(len(set(tick.members) - set(after.answered)) for tick, after in followed)
    plans = sum(len(tick.members) for tick, _ in followed)
    worst_ms = max((tick.overrun_ns / 1e6 for tick in ticks.values()), default=None)
    return {
        "plans": plans,
        "missed": missed,
        "share": missed / plans if plans else None,
        # Of plans that never came nobody knows how late they are.
        "worst_ms": None if missed and not worst_ms else worst_ms,
        "tick_late_ms": _spread(tick.late_ns / 1e6 for tick in ticks.values()),
    }


def _faults(setup: Setup, log: RunLog, control: Control | None) -> list[dict[str, Any]]:
    """What was done to processes, every change of the roster after the first, and why the run ended if it failed."""
    began_ns = min(log.received_ns(Tick).values(), default=None)
    events: list[dict[str, Any]] = []
    members: set[int] | None = None
    failed: tuple[set[int], set[int]] = (set(), set())  # UAVs off, and released

    def note(message: Message, received_ns: int | None, kind: str, what: str, who: Iterable[str]) -> None:
        events.append(
            {
                "tick": message.tick,
                "time_s": message.tick * setup.settings.sampling_period_s,
                "wall_s": None if began_ns is None or received_ns is None else (received_ns - began_ns) / 1e9,
                "kind": kind,
                "processes": list(who),
                "what": what,
            }
        )

    for entry in log.messages:
        message = entry.message
        if isinstance(message, FaultNote):
            by = {"script": " by script", "person": " by hand", "unknown": ""}[message.origin]
            note(message, entry.received_ns, "fault", f"{message.target} {message.what}{by}", [message.target])
        elif isinstance(message, Roster):
            now, health = set(message.agents), (set(message.off), set(message.released))
            if health != failed:
                uavs = sorted((health[0] - failed[0]) | (health[1] - failed[1]))
                note(message, entry.received_ns, "fault", f"{message.reason} by script", [f"uav{uav}" for uav in uavs])
                members, failed = now, health
                continue
            if members is not None:
                left, joined = (sorted(map(agent_name, names)) for names in (members - now, now - members))
                kind = "detected" if left else "rejoined" if joined else "notice"
                note(message, entry.received_ns, kind, message.reason, left or joined)
            members = now
    if control is not None and control.reason:
        note(control, log.received_ns(Control).get(control.tick), "end", control.reason, [])
    return events


def _versions(text: str) -> dict[str, str]:
    """From "python 3.12.1, numpy 2.0.0" to names and versions."""
    return dict(part.rsplit(" ", 1) for part in text.split(", ") if " " in part)


def _spread(values: Iterable[float] | Array) -> dict[str, float | None]:
    values = np.fromiter(values, dtype=np.float64)
    if not len(values):
        return {"p50": None, "p99": None, "max": None}
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}


def _largest(values: Array) -> float | None:
    return _number(values.max()) if len(values) else None


def _number(value: Any) -> float | None:
    """A number as JSON can hold it: a diverged run may overflow, and that is no number."""
    return float(value) if np.isfinite(value) else None
