"""One flight of an experiment: from the case to its numbers."""

import io
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import threadpoolctl
from rich.console import Console

from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Control, Message
from transport.analysis.metrics import summarise
from transport.experiments.cases import Case, key_of
from transport.experiments.effort import effort
from transport.flight import memory, run
from transport.log.run_log import Recorded, RunLog, read_log
from transport.report.report import write_report

ERROR = "error"

# What is kept of a flight; each is None where the flight does not say. No wall-clock time is among them. Of a flight
# that is timed there is more (effort.EFFORT).
NUMBERS = (
    "lost_s",  # scenario time of the end, unless completed
    "cost_mean",
    "cost_max",
    "attitude_max_deg",
    "uav_rms_m",
    "uav_max_m",
    "payload_rms_m",
    "payload_max_m",
    "swing_m",  # largest payload error at the end, swing.SWING_S
    "separation_min_m",
    "plan_age_mean_ticks",
    "plan_age_max_ticks",
    "plans_lost_share",
    "plans_shared_share",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came of a flight.

    Attributes:
        key: Of its case.
        outcome: As in a summary, or "error" when it could not be flown.
        reason: Why, in one line; empty when completed.
        numbers: By name; none for an error.
    """

    key: str
    outcome: str
    reason: str
    numbers: dict[str, float | None]


def simulate_in_memory(case: Case) -> Result:
    """Fly a case in this process."""
    # Processor time of this thread: what else the machine does, and waiting for it, is not the controller's.
    clock = time.thread_time_ns if case.timed else lambda: 0

    def flight(setup: Setup) -> tuple[dict[str, Any], RunLog]:
        messages: list[Recorded] = []

        def record(message: Message) -> None:
            messages.append(Recorded(message=message, received_ns=clock()))

        memory.simulate(setup, record, clock)
        log = RunLog(header={}, messages=tuple(messages), cut="")
        return summarise(setup, log), log

    return _result(case, flight)


def simulate_in_processes(case: Case, folder: Path) -> Result:
    """Fly a case as `transport run` does, recorded into a run folder of its own.

    Args:
        case: What to fly.
        folder: Where the run folders are.
    Raises: KeyboardInterrupt: the run was interrupted.
    """
    own = folder / case.key

    def flight(setup: Setup) -> tuple[dict[str, Any], RunLog]:
        shutil.rmtree(own, ignore_errors=True)  # of a flight that was cut off: its result would be known otherwise
        try:
            finished = run.simulate(setup, own, Console(file=io.StringIO()))
        except run.RunError as error:
            if error.exit_code == EXIT_INTERRUPTED:
                raise KeyboardInterrupt from error
            raise
        if finished.exit_code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        return write_report(own, figures=False), read_log(own / "run.mcap")

    return _result(case, flight)


def _result(case: Case, flight: Callable[[Setup], tuple[dict[str, Any], RunLog]]) -> Result:
    try:
        # Sums in one order wherever the flight is flown.
        with threadpoolctl.threadpool_limits(1):
            setup = Setup.of(case.scenario, case.source)
            if key_of(setup.scenario, setup.samples_s) != case.key:
                raise RuntimeError("expected the version of this package that started the experiment, got another")
            summary, log = flight(setup)
    except Exception as error:  # noqa: BLE001  # whatever is wrong with one flight, the others go on
        text = " ".join(str(error).split())
        return Result(key=case.key, outcome=ERROR, reason=f"{type(error).__name__}: {text}", numbers={})
    control = next(log.of(Control))
    lost_s = None if control.outcome == "completed" else control.tick * setup.settings.sampling_period_s
    return Result(
        key=case.key,
        outcome=control.outcome,
        reason=control.reason,
        numbers=dict(zip(NUMBERS, (lost_s, *_numbers(summary)), strict=True))
        | (effort(setup, log) if case.timed else {}),
    )


def _numbers(summary: dict[str, Any]) -> list[float | None]:
    """In the order of `NUMBERS`, behind the first."""
    cost, ages, messages = (summary[part] for part in ("cost", "plan_age_ticks", "messages"))
    uavs, payload = summary["uav_tracking"], summary["payload_tracking"]
    return [
        cost["mean"],
        cost["max"],
        summary["attitude_max_deg"],
        uavs["rms_m"],
        uavs["max_m"],
        payload["rms_m"],
        payload["max_m"],
        payload["swing_m"],
        summary["separation_min_m"],
        ages["mean"],
        ages["max"],
        messages["lost"] / messages["sent"] if messages["sent"] else None,
        messages["shared"] / messages["planned"] if messages["planned"] else None,
    ]
