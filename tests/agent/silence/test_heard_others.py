"""Information about the others as one agent has heard it, by hand-made plans (32c)."""

from collections.abc import Iterable
from dataclasses import replace as replaced

import pytest
from msgspec.structs import replace

from tests.support import runs
from transport.agent.silence.age_of_information import NO_WAIT, InformationAge
from transport.agent.silence.heard_others import HeardOthers
from transport.agent.silence.silence_thresholds import Ramp, Silence
from transport.protocol.wire.messages import Plan

RUN = runs.setup()
RULE = Silence(
    overdue=Ramp(begins=5.0, complete=15.0),
    uninformed=3.0,
    late=Ramp(begins=4.0, complete=8.0),
    forgets=1.0,
    window=100,
    recent=4,
    to_team=10,
)


def plan(agent: int, tick: int, *, stale: int = 0, alone: float = 0.0) -> Plan:
    """Return a plan whose last solved step was some ticks before."""
    return replace(runs.plan(RUN, agent, tick), stale=stale, alone=alone)


def heard(ticks: Iterable[int], agents: Iterable[int] = (2, 3, 4)) -> HeardOthers:
    """Return what agent 1 has heard at some ticks, of plans of the tick before."""
    others = HeardOthers((1, 2, 3, 4), own=1, silence=RULE)
    for k in ticks:
        for agent in agents if k else ():
            others.plans.add(plan(agent, k - 1))
        others.observe(k)
    return others


def test_information_counts_from_the_last_solved_step() -> None:
    """Beyond the usual age it is overdue; the oldest mean and the oldest overdue one are of any agents."""
    others = heard(range(10))
    assert others.oldest_information == InformationAge(mean=1.0, overdue=0.0)
    for k in range(10, 14):
        others.plans.add(plan(2, k - 1))
        others.plans.add(plan(3, k - 1, stale=k - 10))
        others.observe(k)
    # Agent 3 has solved none since tick 9, agent 4 is not heard since tick 8.
    assert others.age(3, others.plans.newest(3, 13), 13) == InformationAge(mean=2.5, overdue=3.0)
    assert others.age(4, others.plans.newest(4, 13), 13) == InformationAge(mean=3.5, overdue=4.0)
    assert others.oldest_information == InformationAge(mean=3.5, overdue=4.0)
    others.off_roster = {4}
    others.observe(14)
    assert others.oldest_information == InformationAge(mean=3.5, overdue=4.0)
    assert others.age(1, None, 99) == others.age(4, None, 99) == NO_WAIT


def test_without_a_plan_one_is_expected_from_the_first_tick_or_a_return_on() -> None:
    """As if one had been made just before; it is assumed to act once that is overdue."""
    others = heard(range(3), agents=(2, 3))
    assert others.age(4, None, 4).overdue == 4.0
    assert [others.acts_without_plan(4, tick) for tick in (5, 6)] == [False, True]
    others.begin_anew(4, 30)
    assert others.age(4, None, 34).overdue == 4.0
    assert heard([20]).age(4, None, 24).overdue == 4.0
    assert [others.acts_without_plan(4, tick) for tick in (35, 36)] == [False, True]
    assert [others.is_before_return(4, tick) for tick in (29, 30)] == [True, False]
    assert (others.has_returned(4), others.has_returned(3)) == (True, False)


@pytest.mark.parametrize(("age", "is_informed"), [(4, True), (5, False)])
def test_inputs_are_known_until_information_is_overdue_by_the_limit(
    age: int, is_informed: bool
) -> None:
    """3 ticks beyond the usual age of 1; those of any one of the others are needed."""
    others = heard(range(10))
    for agent in (2, 3):
        others.plans.add(plan(agent, 8 + age - 1))
    assert others.is_informed(8 + age, before=9 + age) is is_informed
    others.off_roster = {4}
    assert others.is_informed(8 + age, before=9 + age)


def test_a_past_tick_is_judged_by_plans_that_had_started() -> None:
    """One that was made after it tells nothing of the inputs then."""
    others = heard(range(10))
    for agent in (2, 3, 4):
        others.plans.add(plan(agent, 20))
    assert [others.is_informed(tick, before=21) for tick in (12, 13, 20)] == [True, False, True]


def test_the_usual_age_is_that_since_the_return() -> None:
    """A plan may be newer than usual; at a return, also of the agent itself, the ages are forgotten."""
    others = heard(range(1))
    for k in range(5, 40):
        others.plans.add(plan(2, k - 5))
        others.observe(k)
    assert others.age(2, plan(2, 34), 40) == InformationAge(mean=5.0, overdue=1.0)
    assert others.age(2, plan(2, 37), 40) == InformationAge(mean=5.0, overdue=0.0)
    for agent in (1, 2):
        others.begin_anew(agent, 40)
    assert others.age(2, None, 44) == InformationAge(mean=1.0, overdue=4.0)


def test_another_rule_holds_from_a_failure_on() -> None:
    """Also from one at the first tick."""
    rule = replaced(RULE, uninformed=7.0)
    others = HeardOthers((1, 2), own=1, silence=RULE, after_failures=rule)
    assert others.silence is RULE
    others.failed_since = 0
    assert others.silence is rule


def test_an_agent_that_begins_in_mid_run_has_to_hear_those_that_were_there() -> None:
    """Each of the others on the roster, but those that have returned; one that began with the run none."""
    assert not heard(range(1), agents=()).lacks_first_information(before=1)
    others = heard([20], agents=(2,))
    assert others.lacks_first_information(before=21)
    others.off_roster = {3}
    assert others.lacks_first_information(before=21)
    others.begin_anew(4, 21)
    assert not others.lacks_first_information(before=21)
    assert others.lacks_first_information(before=19)  # the plan was not made yet


def test_a_plan_counts_by_the_larger_share_alone() -> None:
    """Of what it says and what its age says; the largest said is that of agents on the roster."""
    others = heard(range(10))
    newest = plan(2, 9, alone=0.2)
    assert others.share_alone(2, newest, 10) == 0.2
    assert others.share_alone(2, newest, 9 + 1 + 10) == pytest.approx(0.5)
    for agent, alone in [(2, 0.2), (3, 0.6), (4, 0.9)]:
        others.plans.add(plan(agent, 9, alone=alone))
    assert others.most_said(before=10) == 0.9
    assert others.most_said(before=9) == 0.0
    others.off_roster = {4}
    assert others.most_said(before=10) == 0.6
    others.off_roster = {2}
    assert others.most_said(before=10) == 0.9


@pytest.mark.parametrize(("tick", "said"), [(39, 0.0), (40, 0.7)])
def test_an_agent_on_its_way_back_does_not_count(tick: int, said: float) -> None:
    """For the 10 ticks in which it hands over to the team after its return."""
    others = heard(range(10))
    others.begin_anew(3, 30)
    others.plans.add(plan(3, tick, alone=0.7))
    assert others.most_said(before=tick + 1) == said


def test_without_a_rule_nothing_depends_on_ages() -> None:
    """All are informed, and none acts alone, however long nothing has been heard."""
    others = HeardOthers((1, 2), own=1)
    others.observe(50)
    assert others.oldest_information == NO_WAIT
    assert others.is_informed(50, before=51)
    assert not others.acts_without_plan(2, 50)
    assert others.share_alone(2, plan(2, 0, alone=1.0), 50) == 0.0
