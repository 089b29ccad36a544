"""Simulation of one case of an experiment, and its numbers."""

import io
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import threadpoolctl
from rich.console import Console

from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Control
from transport.analysis.metrics import summarise
from transport.experiments.cases import Case, key_of
from transport.experiments.resource_use import resource_use
from transport.flight import memory, run
from transport.flight.run_error import RunError
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
# a wall-clock time. A timed run has more (resource_use.RESOURCES).
NUMBERS = ("lost_s", *_FROM_SUMMARY, *_SHARES)


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


def simulate_in_memory(case: Case) -> Result:
    """Simulate a case in this process."""
    # Processor time of this thread excludes the rest of the machine.
    clock = time.thread_time_ns if case.timed else lambda: 0

    def simulate(setup: Setup) -> tuple[dict[str, Any], RunLog]:
        log = run_in_memory(setup, clock)
        return summarise(setup, log), log

    return _result(case, simulate)


def simulate_in_processes(case: Case, folder: Path) -> Result:
    """Simulate a case as `transport run` does, recorded into its own run folder below a folder.

    Raises: KeyboardInterrupt: the run was interrupted.
    """
    own = folder / case.key

    def simulate(setup: Setup) -> tuple[dict[str, Any], RunLog]:
        shutil.rmtree(own, ignore_errors=True)  # left by an interrupted run
        try:
            finished = run.simulate(setup, own, Console(file=io.StringIO()))
        except RunError as error:
            if error.exit_code == EXIT_INTERRUPTED:
                raise KeyboardInterrupt from error
            raise
        if finished.exit_code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        return write_report(finished.folder, figures=False), read_log(finished.folder / "run.mcap")

    return _result(case, simulate)


def _result(case: Case, simulate: Callable[[Setup], tuple[dict[str, Any], RunLog]]) -> Result:
    try:
        # One thread: sums have the same order on every machine.
        with threadpoolctl.threadpool_limits(1):
            setup = Setup.of(case.scenario, case.source)
            if key_of(setup.scenario, setup.samples_s) != case.key:
                raise RuntimeError("expected the version of this package that started the experiment, got another")
            summary, log = simulate(setup)
    except Exception as error:  # noqa: BLE001  # an error of one case must not end the others
        text = " ".join(str(error).split())
        return Result(key=case.key, outcome=ERROR, reason=f"{type(error).__name__}: {text}", numbers={})
    control = next(log.of(Control))
    end_s = None if control.outcome == "completed" else control.tick * setup.settings.sampling_period_s
    numbers = {"lost_s": end_s, **_numbers(summary)}
    if case.timed:
        numbers |= resource_use(setup, log)
    return Result(key=case.key, outcome=control.outcome, reason=control.reason, numbers=numbers)


def _numbers(summary: Any) -> dict[str, float | None]:
    messages = summary["messages"]
    return {
        **{name: reduce(getitem, place, summary) for name, place in _FROM_SUMMARY.items()},
        **{name: messages[part] / messages[of] if messages[of] else None for name, (part, of) in _SHARES.items()},
    }
