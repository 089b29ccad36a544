"""Messages of an agent's step: its plan, its report with ages, counts and times, numbers for the log."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from transport.agent.received import Received
from transport.model.arrays import Array
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import STAGES, Note, Plan, StepReport
from transport.protocol.wire.outbox import Outbox

# Stages counted as computation, not waiting or publishing.
COMPUTATION = ("estimate", "linearise", "discretise", "condense", "solve")


NO_AGE = -1  # of a plan or measurement that is not used


class StageTimes:
    """Times of the present step by stage, ns of a steady clock, from its stopwatch."""

    def __init__(self, stopwatch: Callable[[], int]) -> None:
        self._stopwatch = stopwatch
        self._last_ns = stopwatch()  # end of the last stage
        self.ns = dict.fromkeys(STAGES, 0)

    def begin(self, started_ns: int) -> None:
        """Begin a step: the time since the last stage was waiting."""
        self.ns = dict.fromkeys(STAGES, 0)
        self.ns["wait"] = started_ns - self._last_ns
        self._last_ns = started_ns

    def resume(self) -> None:
        """Begin a stage now; the time since the last one counts nowhere."""
        self._last_ns = self._stopwatch()

    def lap(self, stage: str) -> None:
        """Count the time since the end of the last stage as that of a stage."""
        before_ns = self._last_ns
        self._last_ns = self._stopwatch()
        self.ns[stage] += self._last_ns - before_ns

    def conclude(self, publish_ns: int) -> None:
        """Set the time of publishing the last messages, and the total of computation."""
        self.ns["publish"] = publish_ns
        self.ns["total"] = sum(self.ns[stage] for stage in COMPUTATION)


def numbers_note(
    tick: int, agent: int, numbers: Mapping[str, float], out: Outbox, problem: str = ""
) -> Note:
    """Return a note of an agent, 1-based, with numbers by name, and a problem if any."""
    return out.stamp(
        Note,
        tick=tick,
        agent=agent,
        problem=problem,
        names=tuple(numbers),
        values=list(numbers.values()),
    )


def step_plan(
    tick: int,
    agent: int,
    out: Outbox,
    setup: TeamRun,
    *,
    uav_states: Array,
    inputs: Array,
    **fields: Any,
) -> Plan:
    """Return the plan, or proposal, of an agent, 1-based, at a tick.

    Without further fields it is solved, the last of its tick, shared, and has no corrections.
    """
    is_as_solved = {
        "corrections": np.zeros((0, inputs.shape[1])),
        "status": "solved",
        "negotiation": 0,
        "shared": True,
    }
    return out.stamp(
        Plan,
        tick=tick,
        agent=agent,
        start_tick=tick + int(setup.rules.clock.next_tick),
        uavs=tuple(uav + 1 for uav in setup.owned[agent - 1]),
        uav_states=uav_states,
        inputs=inputs,
        **{**is_as_solved, **fields},
    )


def step_report(
    received: Received,
    agent: int,
    out: Outbox,
    *,
    peers: Sequence[int],
    plan_ages: Sequence[int],
    times_ns: Mapping[str, int],
    **fields: Any,
) -> StepReport:
    """Return the report of an agent's step from messages, times of stages, and other fields.

    Plans of peers that are off the roster are not used any more, so they have no age.
    """
    k = received.tick
    ages = [
        age if peer in received.agents else NO_AGE
        for peer, age in zip(peers, plan_ages, strict=True)
    ]
    return out.stamp(
        StepReport,
        tick=k,
        agent=agent,
        delivered=len(received.plans),
        peers=peers,
        plan_ages=tuple(ages),
        lost=received.lost,
        measurements_lost=received.measurements_lost,
        late=sum(plan.tick < k - 1 for plan in received.plans),
        times_ms=np.array([times_ns[stage] / 1e6 for stage in STAGES]),
        **fields,
    )
