"""Simulation of a case in this process, and its result: outcome and numbers."""

import time
from dataclasses import dataclass

import threadpoolctl

from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.experiments.cases import Case, key_of
from transport.experiments.run_numbers import numbers_of
from transport.flight import memory
from transport.log.run_log import Recorded, RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Control, Message

# Outcome of a case that could not be simulated.
ERROR = "error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a case."""

    key: str  # of the case
    outcome: str  # as in a summary, or `ERROR` for a case that could not be simulated
    reason: str  # one line; empty when completed
    numbers: dict[str, float | None]  # by name; empty for an error


def run_in_memory(setup: Setup) -> RunLog:
    """Simulate a run in this process and return its log.

    Messages are stamped with the processor time of this thread.
    """
    messages: list[Recorded] = []
    clock_ns = time.thread_time_ns  # excludes the rest of the machine

    def record(message: Message) -> None:
        messages.append(Recorded(message=message, received_ns=clock_ns()))

    memory.simulate(setup, record, clock_ns)
    return RunLog(header={}, messages=tuple(messages), cut="")


def simulate(case: Case) -> Result:
    """Simulate a case in this process; an error is a result as well."""
    try:
        # One thread: sums have the same order on every machine.
        with threadpoolctl.threadpool_limits(1):
            return _result(case)
    except Exception as error:  # noqa: BLE001  # an error of one case must not end the others
        text = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {text}"
        return Result(key=case.key, outcome=ERROR, reason=reason, numbers={})


def _result(case: Case) -> Result:
    """Simulate a case and return its outcome and numbers."""
    setup = Setup.of(case.scenario, case.source)
    if key_of(setup.scenario) != case.key:
        raise RuntimeError(
            "expected the package, engine and controller that started the experiment, got another version"
        )

    log = run_in_memory(setup)
    summary = summarise(AnalysedRun.of(setup, log))
    end = next(log.of(Control))
    numbers = numbers_of(setup, summary, end)
    if case.more is not None:
        numbers |= case.more(setup, summary, log)
    # A kept result is read as floating-point numbers, and tables do not tell whether a run was resumed.
    numbers = {name: None if one is None else float(one) for name, one in numbers.items()}
    return Result(key=case.key, outcome=end.outcome, reason=end.reason, numbers=numbers)
