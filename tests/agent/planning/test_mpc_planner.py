"""Steps of an agent's planner: what a proposal of another agent changes in its problem (47)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from transport.agent.communication.event_triggered_sharing import Corrections
from transport.agent.planning import mpc_planner
from transport.agent.planning.mpc_planner import Planner
from transport.agent.received import Received
from transport.model.state import input_indices
from transport.mpc.alone.alone_law import steps_alone
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import STAGES, Note, Plan, StepReport
from transport.protocol.wire.outbox import Outbox

SETTINGS = (
    "controller.horizon=5",
    "controller.negotiation_iterations=3",
    "controller.prediction=closed_loop",
    "controller.terminal=riccati",
)
OPEN_LOOP = SETTINGS[:2]
NO_UAVS: frozenset[int] = frozenset()


def received(run: Setup, k: int, plans: Sequence[Plan] = (), version: int = 1) -> Received:
    """Return what agent 1 receives at a tick, with its own measurement."""
    seen = runs.measurement(run, 1, k, version=version)
    return Received(
        measurement=seen,
        measurements=[seen],
        plans=plans,
        lost=0,
        measurements_lost=0,
        agents=frozenset(run.agents),
        off=NO_UAVS,
        released=NO_UAVS,
        failed_since=0,
        ticks_since_start=k,
        started_ns=0,
    )


@pytest.mark.parametrize("settings", [SETTINGS, OPEN_LOOP], ids=["closed loop", "open loop"])
def test_a_proposal_replaces_the_columns_of_its_agent(
    settings: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Inputs and corrections each where they cover the horizon; the own ones are those of the last solve.

    A proposal is shared, whatever the rule for sharing says of the plan.
    """
    monkeypatch.setattr(mpc_planner, "Sharing", NotingSharing)
    run = runs.setup(*settings)
    planner = Planner(run.run, 1, lambda: 0)
    step = planner.begin(received(run, 0))
    (own,) = planner.plan(step, Outbox("agent1", 0), 0)
    assert isinstance(own, Plan)
    assert (step.negotiation, own.negotiation) == (2, 2)
    assert (own.shared, made[-1].asked) == (True, [])
    before = step.problem
    steps = len(before.U)

    def proposal(agent: int, rows: int, corrections: int) -> Plan:
        given = runs.plan(run, agent, 0, inputs=np.full((rows, 4), 10.0 + agent))
        return replace(given, corrections=np.full((corrections, 4), 0.1 * agent), negotiation=2)

    planner.adopt(
        step, [proposal(2, steps, steps), proposal(3, steps - 1, steps), proposal(4, steps, 0)]
    )
    columns = {agent: input_indices(run.owned[agent - 1]) for agent in run.agents}
    assert step.result is not None
    expected = before.U.copy()
    expected[:, columns[1]] = step.result.U
    expected[:, columns[2]] = 12.0
    expected[:, columns[4]] = 14.0
    np.testing.assert_array_equal(step.problem.U, expected)
    assert (before.U[:, columns[2]] != 12.0).all()

    if before.law is None:
        assert step.problem.law is None
        return
    assert step.problem.law is not None
    c = before.law.c.copy()
    c[:, columns[1]] = step.result.c
    c[:, columns[2]] = 0.2
    c[:, columns[3]] = 0.3 + 0.0
    np.testing.assert_allclose(step.problem.law.c, c)
    assert not before.law.c[:, columns[2]].any()


class NotingSharing:
    """A rule for sharing that notes what it is asked, and shares nothing."""

    def __init__(self, *_: Any) -> None:
        made.append(self)
        self.asked: list[Corrections] = []
        self.renewed = 0

    def decide(self, corrections: Corrections) -> bool:
        """Return that a plan need not be shared."""
        self.asked.append(corrections)
        return False

    def renew(self) -> None:
        """Count."""
        self.renewed += 1


made: list[NotingSharing] = []
LAW = (SETTINGS[0], *SETTINGS[2:])


def answer(planner: Planner, at: Received) -> tuple[list[Note], Plan, StepReport]:
    """Return notes, plan and report of a tick, in this order."""
    *notes, own, report = planner.plan(planner.begin(at), Outbox("agent1", 0), 0)
    assert isinstance(own, Plan)
    assert isinstance(report, StepReport)
    return [note for note in notes if isinstance(note, Note)], own, report


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_wholly_alone_nothing_is_solved(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan says by how much it is alone, is as long as its law covers, and what the rule for sharing decides."""
    monkeypatch.setattr(mpc_planner, "Sharing", NotingSharing)
    run = runs.setup(*LAW, "controller.horizon=20", "clock.actuation=next_tick")
    planner = Planner(run.run, 1, lambda: 0)
    advanced: list[int] = []
    monkeypatch.setattr(planner._handover, "advance", advanced.append)
    answer(planner, received(run, 0))
    assert planner._team.expected is not None
    assert planner._team.expected.start == 1
    planner._handover._mixture.share = share
    _, own, report = answer(planner, received(run, 1, version=3))
    assert advanced == [0, 1]
    kept = planner._team.announced.plans.newest(1, before=2)
    assert kept is own
    is_alone = share == 1.0
    steps = steps_alone(run.settings.sampling_period_s) if is_alone else 20
    assert steps < 20 or not is_alone
    assert (own.alone, own.status, own.stale, own.shared) == (share, "solved", 0, False)
    assert (len(own.inputs), len(own.corrections)) == (steps, steps)
    assert (report.solver == "alone") == is_alone
    assert (planner._team.expected is None) == is_alone
    asked = made[-1].asked[-1]
    assert (asked.tick, asked.start, asked.roster, asked.alone) == (1, 2, 3, share)


def test_an_agent_shares_anew_after_targets_and_a_new_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A further target, a plan that carries one, and a restart, which discards what was heard as well."""
    monkeypatch.setattr(mpc_planner, "Sharing", NotingSharing)
    run = runs.setup(*LAW)
    planner = Planner(run.run, 1, lambda: 0)
    answer(planner, received(run, 1, [runs.plan(run, 2, 0)]))
    planner.follow(run.run)
    planner.announce()
    assert made[-1].renewed == 2
    before, count = made[-1], len(made)
    planner.restart()
    assert (len(made), made[-1] is before) == (count + 1, False)
    assert answer(planner, received(run, 2))[2].plan_ages == (-1, -1, -1)


def test_steps_without_a_solution_are_stale_until_the_next_one() -> None:
    """Plans count from the last solved step, those of others as well; a proposal is always shared."""
    run = runs.setup(*LAW)
    planner = Planner(run.run, 1, lambda: 0)
    report: StepReport
    stale = []
    for k, is_solved in enumerate([True, False, False, True]):
        step = planner.begin(
            received(run, k, [replace(runs.plan(run, 2, k - 1), stale=2)] if k else [])
        )
        if not is_solved:
            step.problem = replace(step.problem, discrete=None)
        own, last = planner.plan(step, Outbox("agent1", 0), publish_ns=5_000_000)
        assert isinstance(own, Plan)
        assert isinstance(last, StepReport)
        report = last
        assert len(own.corrections) == len(own.inputs)
        assert report.times_ms[STAGES.index("publish")] == 5.0
        assert (report.residual == -1.0) == (not is_solved)
        stale.append((own.stale, own.status == "solved"))
        assert report.measurement_age == 0
    assert stale == [(0, True), (1, False), (2, False), (0, True)]
    assert report.plan_ages == (3, -1, -1)
    assert report.state_ages == (1, -1, -1)


def test_an_estimator_is_noted_each_second_and_each_new_begin_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At ticks 20 and 40 of 20 Hz, not at the first one; several begins in a step by the newest."""
    run = runs.setup(*LAW)
    planner = Planner(run.run, 1, lambda: 0)
    estimator: Any = planner._team.estimator
    monkeypatch.setattr(estimator, "log_numbers", lambda: {"height": -10.0})
    noted = {}
    for k in (0, 19, 20, 21, 40):
        if k == 21:
            estimator.resets = {3, 17}
        notes, _, _ = answer(planner, received(run, k))
        noted[k] = [note.problem or note.names[0] for note in notes]
    (anew,) = noted.pop(21)
    assert "begun anew about the reference at tick 17" in anew
    assert noted == {0: [], 19: [], 20: ["height"], 40: ["height"]}
