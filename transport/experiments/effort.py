"""What a flight takes: computation, as time of the processor, and the plans that agents send each other, as bytes."""

from collections import defaultdict

import numpy as np

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.messages import STAGES, Control, Plan, StepReport, Tick
from transport.log.run_log import RunLog

# Stages of the step itself, without waiting before and publishing behind it.
_WORK = STAGES[STAGES.index("estimate") : STAGES.index("solve") + 1]

# Those of messages are the same for every flight of a scenario; what begins with cpu_ is the machine's to say.
MESSAGES = ("plans_per_tick", "plan_bytes", "plan_bytes_per_s")
CPU = (
    "cpu_step_p50_ms",  # of an agent's step: estimate, linearise, discretise, condense, solve
    "cpu_step_p99_ms",
    *(f"cpu_{stage}_p50_ms" for stage in _WORK),
    "cpu_team_tick_ms",  # of all agents' steps of a tick, on average
    "cpu_flight_s_per_s",  # of the whole flight, plant, coordinator and messages included, per second flown
)
EFFORT = (*MESSAGES, *CPU)


def effort(setup: Setup, log: RunLog) -> dict[str, float | None]:
    """What a flight took, by name.

    A shared plan counts once for each other agent, as on a network without multicast. What plant and coordinator
    hear is not counted: it would be on board, or is not there in the field.

    Args:
        setup: The flight.
        log: All its messages; stamped, as its step reports are, by the clock of the processor.
    Returns: A number for each of `EFFORT`; None throughout for a flight that ended before its first step.
    """
    totals_ms: dict[int, float] = defaultdict(float)
    reports = list(log.of(StepReport))
    for report in reports:
        totals_ms[report.tick] += float(report.times_ms[-1])
    if not reports:
        return dict.fromkeys(EFFORT)
    steps_ms = np.array([report.times_ms for report in reports])
    stages_ms = np.median(steps_ms, axis=0)
    flown_s = len(totals_ms) * setup.settings.sampling_period_s
    bytes_of_plans = [len(encode(plan)) for plan in log.of(Plan) if plan.shared]
    receivers = len(setup.agents) - 1
    began_ns, ended_ns = min(log.received_ns(Tick).values()), max(log.received_ns(Control).values())
    return {
        "plans_per_tick": receivers * len(bytes_of_plans) / len(totals_ms),
        "plan_bytes": sum(bytes_of_plans) / len(bytes_of_plans),
        "plan_bytes_per_s": receivers * sum(bytes_of_plans) / flown_s,
        "cpu_step_p50_ms": float(stages_ms[-1]),
        "cpu_step_p99_ms": float(np.percentile(steps_ms[:, -1], 99.0)),
        **{f"cpu_{stage}_p50_ms": float(stages_ms[STAGES.index(stage)]) for stage in _WORK},
        "cpu_team_tick_ms": sum(totals_ms.values()) / len(totals_ms),
        "cpu_flight_s_per_s": (ended_ns - began_ns) / 1e9 / flown_s,
    }
