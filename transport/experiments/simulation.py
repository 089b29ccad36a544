"""Simulation of one case of an experiment, and its numbers."""

import io
import shutil
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl
from rich.console import Console

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import STAGES, Control, Plan, StepReport, Tick
from transport.analysis.metrics import summarise
from transport.experiments.cases import Case, key_of
from transport.flight import memory, run
from transport.log.run_log import Recorded, RunLog, read_log
from transport.report.report import write_report

ERROR = "error"

# Numbers of a run, each with its place in the summary.
_FROM_SUMMARY = {
    "cost_mean": ("cost", "mean"),
    "cost_max": ("cost", "max"),
    "attitude_max_deg": ("attitude_max_deg",),
    "uav_rms_m": ("uav_tracking", "rms_m"),
    "uav_max_m": ("uav_tracking", "max_m"),
    "payload_rms_m": ("payload_tracking", "rms_m"),
    "payload_max_m": ("payload_tracking", "max_m"),
    "swing_m": ("payload_tracking", "swing_m"),  # largest payload error at the end, swing.SWING_S
    "separation_min_m": ("separation_min_m",),
    "plan_age_mean_ticks": ("plan_age_ticks", "mean"),
    "plan_age_max_ticks": ("plan_age_ticks", "max"),
}
# Shares of messages: count and total, each an entry of the summary's messages.
_SHARES = {"plans_lost_share": ("lost", "sent"), "plans_shared_share": ("shared", "planned")}

# All numbers; None where a run has none. The first is the scenario time of the end, unless completed. None of them is
# a wall-clock time.
NUMBERS = ("lost_s", *_FROM_SUMMARY, *_SHARES)

# Stages counted as computation, not waiting or publishing.
_COMPUTATION = STAGES[STAGES.index("estimate") : STAGES.index("solve") + 1]

# Further numbers of a timed run. Those of messages are the same for every run of a scenario; processor times (cpu_...)
# depend on the machine.
MESSAGES = ("plans_per_tick", "plan_bytes", "plan_bytes_per_s")
CPU = (
    "cpu_step_p50_ms",  # of an agent's step: all stages of computation
    "cpu_step_p99_ms",
    *(f"cpu_{stage}_p50_ms" for stage in _COMPUTATION),
    "cpu_team_tick_ms",  # mean sum of all agents' steps of a tick
    "cpu_flight_s_per_s",  # of the whole run with plant, coordinator and messages, per simulated second
)
RESOURCES = (*MESSAGES, *CPU)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a case."""

    key: str  # of the case
    outcome: str  # as in a summary, or `ERROR` for a case that could not be simulated
    reason: str  # one line; empty when completed
    numbers: dict[str, float | None]  # by name; empty for an error


def run_in_memory(setup: Setup, clock: Callable[[], int] = lambda: 0) -> RunLog:
    """Simulate a run in this process and return its log; the clock, in ns, times messages and steps."""
    messages: list[Recorded] = []
    memory.simulate(setup, lambda message: messages.append(Recorded(message=message, received_ns=clock())), clock)
    return RunLog(header={}, messages=tuple(messages), cut="")


def simulate(case: Case, folder: Path | None = None) -> Result:
    """Simulate a case in this process; with a folder as `transport run` does, into a run folder of its own below it.

    Raises: KeyboardInterrupt: the run was interrupted.
    """
    try:
        # One thread: sums have the same order on every machine.
        with threadpoolctl.threadpool_limits(1):
            setup = Setup.of(case.scenario, case.source)
            if key_of(setup.scenario) != case.key:
                raise RuntimeError("expected the version of this package that started the experiment, got another")
            if folder is None:
                # Processor time of this thread excludes the rest of the machine.
                log = run_in_memory(setup, time.thread_time_ns if case.timed else lambda: 0)
                summary = summarise(setup, log)
            else:
                summary, log = _with_processes(setup, folder / case.key)
            control = next(log.of(Control))
            end_s = None if control.outcome == "completed" else control.tick * setup.settings.sampling_period_s
            numbers = {"lost_s": end_s, **_numbers(summary)}
            if case.timed:
                numbers |= resource_use(setup, log)
            if case.more is not None:
                numbers |= case.more(setup, summary, log)
    except Exception as error:  # noqa: BLE001  # an error of one case must not end the others
        text = " ".join(str(error).split())
        return Result(key=case.key, outcome=ERROR, reason=f"{type(error).__name__}: {text}", numbers={})
    return Result(key=case.key, outcome=control.outcome, reason=control.reason, numbers=numbers)


def _with_processes(setup: Setup, folder: Path) -> tuple[dict[str, Any], RunLog]:
    shutil.rmtree(folder, ignore_errors=True)  # left by an interrupted run
    finished = run.simulate(setup, folder, Console(file=io.StringIO()))
    if finished.exit_code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    return write_report(finished.folder, figures=False), read_log(finished.folder / "run.mcap")


def _numbers(summary: Any) -> dict[str, float | None]:
    messages = summary["messages"]
    return {
        **{name: reduce(getitem, place, summary) for name, place in _FROM_SUMMARY.items()},
        **{name: messages[part] / messages[of] if messages[of] else None for name, (part, of) in _SHARES.items()},
    }


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
