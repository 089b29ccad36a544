"""Numbers of a run in an experiment: those of every run, from its summary, and what it takes of machine and network."""

from collections.abc import Callable, Mapping
from functools import reduce
from operator import getitem
from typing import Any

import numpy as np

from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import STAGES, Control, Plan, StepReport, Tick

# Numbers of a run, each with its place in the summary.
_FROM_SUMMARY = {
    "cost_mean": ("cost", "mean"),
    "cost_max": ("cost", "max"),
    "attitude_max_deg": ("attitude_max_deg",),
    "uav_rms_m": ("uav_tracking", "rms_m"),
    "uav_max_m": ("uav_tracking", "max_m"),
    "payload_rms_m": ("payload_tracking", "rms_m"),
    "payload_max_m": ("payload_tracking", "max_m"),
    # Largest payload error at the end, `cost_and_tracking_metrics.SWING_S`.
    "swing_m": ("payload_tracking", "swing_m"),
    "separation_min_m": ("separation_min_m",),
    "plan_age_mean_ticks": ("plan_age_ticks", "mean"),
    "plan_age_max_ticks": ("plan_age_ticks", "max"),
}
# Shares of messages: count and total, each an entry of the summary's messages.
_SHARES = {"plans_lost_share": ("lost", "sent"), "plans_shared_share": ("shared", "planned")}

# Numbers of every run; None where a run has none. The first is the scenario time of the end, unless
# completed. None of them is a wall-clock time.
NUMBERS = ("lost_s", *_FROM_SUMMARY, *_SHARES)

# Further numbers of a run, from its setup, summary and log.
More = Callable[[Setup, Any, RunLog], Mapping[str, float | None]]


def numbers_of(setup: Setup, summary: Any, end: Control) -> dict[str, float | None]:
    """Return the numbers of a run from its summary and the message that ended it.

    They are `NUMBERS`, and with a radio its airtime, delivered share and delays.
    """
    is_completed = end.outcome == "completed"
    end_s = None if is_completed else end.tick * setup.settings.sampling_period_s
    if summary["collision"]:
        end_s = summary["collision"]["at_s"]
    numbers: dict[str, float | None] = {"lost_s": end_s}

    numbers |= {name: reduce(getitem, place, summary) for name, place in _FROM_SUMMARY.items()}
    messages = summary["messages"]
    for name, (count, total) in _SHARES.items():
        numbers[name] = messages[count] / messages[total] if messages[total] else None

    radio = summary["radio"]
    if radio is not None:
        numbers["airtime_share"] = radio["airtime_share"]
        numbers["air_delivered_share"] = radio["delivered_share"]
        numbers["air_delay_p99_ms"] = radio["delay_ms"]["p99"]
    return numbers


def resource_use(setup: Setup, _: Any, log: RunLog) -> Mapping[str, float | None]:
    """Return messages and processor time of a run, as in docs/experiments.md.

    Nothing if it ended before its first step. A shared plan counts once for each other agent, as on
    a network without multicast. Messages to plant and coordinator are not counted: in the field
    they stay on board or do not exist.
    """
    total = STAGES.index("total")  # all stages of computation of an agent's step
    steps_ms = [float(report.times_ms[total]) for report in log.of(StepReport)]
    if not steps_ms:
        return {}

    ticks = len({report.tick for report in log.of(StepReport)})
    duration_s = ticks * setup.settings.sampling_period_s
    receivers = len(setup.agents) - 1
    plans_bytes = [len(encode(plan)) for plan in log.of(Plan) if plan.shared]

    # With plant, coordinator and messages.
    began_ns = min(log.received_ns(Tick).values())
    ended_ns = max(log.received_ns(Control).values())
    run_s = (ended_ns - began_ns) / 1e9
    return {
        "plans_per_tick": receivers * len(plans_bytes) / ticks,
        "plan_bytes_per_s": receivers * sum(plans_bytes) / duration_s,
        "cpu_step_p50_ms": float(np.median(steps_ms)),
        "cpu_step_p99_ms": float(np.percentile(steps_ms, 99.0)),
        "cpu_team_tick_ms": sum(steps_ms) / ticks,
        "cpu_flight_s_per_s": run_s / duration_s,
    }
