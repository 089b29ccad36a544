"""Numbers of a run in an experiment, of logs composed by hand."""

import msgspec
import numpy as np
import pytest

from tests.support import log_messages, runs
from tests.support.logs import log_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.experiments.run_numbers import NUMBERS, numbers_of, resource_use
from transport.log.run_log import Recorded, RunLog
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import STAGES, Message


def test_shares_and_end_of_a_run() -> None:
    """Four agents share three of four plans at ten ticks of 50 ms, of which 4 of 81 are lost.

    A run that is not completed ends at its last tick; any run that comes to a contact ends there.
    """
    run = runs.setup(runs.ticks(10))
    sent: list[Message] = [runs.roster()]
    for k in range(10):
        plans = [runs.plan(run, agent, k) for agent in run.agents]
        sent += [msgspec.structs.replace(plan, shared=plan.agent != 4) for plan in plans]
        sent += [log_messages.report(run, agent, k, lost=int(k == 5)) for agent in run.agents]
        sent.append(log_messages.on_reference(run, k))

    end = runs.end(9)
    summary = summarise(AnalysedRun.of(run, log_of([*sent, end])))
    found = numbers_of(run, summary, end)
    assert tuple(found) == NUMBERS
    assert found["lost_s"] is None
    assert found["plans_shared_share"] == pytest.approx(0.75)
    assert found["plans_lost_share"] == pytest.approx(4 / (9 * 3 * 3))  # none is used at tick 0

    diverged = msgspec.structs.replace(end, outcome="diverged")
    assert numbers_of(run, summary, diverged)["lost_s"] == pytest.approx(0.45)
    summary["collision"] = {"at_s": 0.2}
    assert [numbers_of(run, summary, one)["lost_s"] for one in (end, diverged)] == [0.2, 0.2]


def test_resources_of_a_run() -> None:
    """Of six steps of two agents of four at three ticks of 50 ms, with four of six plans shared, in 0.3 s in all."""
    run = runs.setup(runs.SHORT)
    steps = [(agent, k) for k in range(3) for agent in (1, 2)]
    reports = []
    for total_ms, (agent, k) in enumerate(steps, start=1):
        times_ms = np.full(len(STAGES), 100.0)
        times_ms[STAGES.index("total")] = total_ms
        reports.append(log_messages.report(run, agent, k, times_ms=times_ms))
    plans = [
        msgspec.structs.replace(runs.plan(run, agent, k), shared=number < 4)
        for number, (agent, k) in enumerate(steps)
    ]
    sent = [runs.tick(0), *plans, *reports, runs.end(2)]
    times_ns = [10**9, *([1_100_000_000] * 12), 1_300_000_000]
    log = RunLog(
        header={},
        messages=tuple(
            Recorded(message=message, received_ns=at_ns)
            for message, at_ns in zip(sent, times_ns, strict=True)
        ),
        cut="",
    )
    shared_bytes = sum(len(encode(plan)) for plan in plans[:4])
    assert resource_use(run, None, log) == pytest.approx({
        "plans_per_tick": 4.0,  # 4 plans for 3 others each, in 3 ticks
        "plan_bytes_per_s": 3 * shared_bytes / 0.15,
        "cpu_step_p50_ms": 3.5,
        "cpu_step_p99_ms": 5.95,
        "cpu_team_tick_ms": 7.0,
        "cpu_flight_s_per_s": 2.0,
    })  # fmt: skip
    assert resource_use(run, None, RunLog(header={}, messages=(), cut="")) == {}
