"""Resource use of a run: processor time of the computation, and bytes of the plans sent between agents."""

from collections import defaultdict

import numpy as np

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.messages import STAGES, Control, Plan, StepReport, Tick
from transport.log.run_log import RunLog

# Stages counted as computation, not waiting or publishing.
_COMPUTATION = STAGES[STAGES.index("estimate") : STAGES.index("solve") + 1]

# Numbers of messages are the same for every run of a scenario; processor times (cpu_...) depend on the machine.
MESSAGES = ("plans_per_tick", "plan_bytes", "plan_bytes_per_s")
CPU = (
    "cpu_step_p50_ms",  # of an agent's step: all stages of computation
    "cpu_step_p99_ms",
    *(f"cpu_{stage}_p50_ms" for stage in _COMPUTATION),
    "cpu_team_tick_ms",  # mean sum of all agents' steps of a tick
    "cpu_flight_s_per_s",  # of the whole run with plant, coordinator and messages, per simulated second
)
RESOURCES = (*MESSAGES, *CPU)


def resource_use(setup: Setup, log: RunLog) -> dict[str, float | None]:
    """Return a number for each of `RESOURCES`; None throughout for a run that ended before its first step.

    A shared plan counts once for each other agent, as on a network without multicast. Messages to plant and
    coordinator are not counted: in the field they stay on board or do not exist. The log must be stamped with processor
    time.
    """
    totals_ms: dict[int, float] = defaultdict(float)
    reports = list(log.of(StepReport))
    for report in reports:
        totals_ms[report.tick] += float(report.times_ms[-1])
    if not reports:
        return dict.fromkeys(RESOURCES)
    steps_ms = np.array([report.times_ms for report in reports])
    stages_ms = np.median(steps_ms, axis=0)
    duration_s = len(totals_ms) * setup.settings.sampling_period_s
    bytes_of_plans = [len(encode(plan)) for plan in log.of(Plan) if plan.shared]
    receivers = len(setup.agents) - 1
    began_ns, ended_ns = min(log.received_ns(Tick).values()), max(log.received_ns(Control).values())
    return {
        "plans_per_tick": receivers * len(bytes_of_plans) / len(totals_ms),
        "plan_bytes": sum(bytes_of_plans) / len(bytes_of_plans),
        "plan_bytes_per_s": receivers * sum(bytes_of_plans) / duration_s,
        "cpu_step_p50_ms": float(stages_ms[-1]),
        "cpu_step_p99_ms": float(np.percentile(steps_ms[:, -1], 99.0)),
        **{f"cpu_{stage}_p50_ms": float(stages_ms[STAGES.index(stage)]) for stage in _COMPUTATION},
        "cpu_team_tick_ms": sum(totals_ms.values()) / len(totals_ms),
        "cpu_flight_s_per_s": (ended_ns - began_ns) / 1e9 / duration_s,
    }
