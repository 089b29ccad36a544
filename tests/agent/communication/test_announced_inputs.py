"""Announced inputs: plans shifted by their age and held at their end, for any order of arrival.

Past inputs of the others: the first step of a plan as announced, then the shared control law with
    its corrections.
"""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from transport.agent.communication.announced_inputs import Alignment, AnnouncedInputs
from transport.agent.communication.unannounced_inputs import SharedLaw
from transport.agent.silence.heard_others import HeardOthers
from transport.agent.silence.silence_thresholds import Silence
from transport.model.arrays import Array
from transport.model.state import input_indices
from transport.mpc.settings_period_horizon_weights import ControllerSettings, Limits
from transport.protocol.wire.messages import Plan

Law = Callable[[int, Array], Array | None]

OWNED = ((0, 2), (1,))  # agent 1 owns UAV1 and UAV3, agent 2 owns UAV2
U_HOVER = -np.arange(1.0, 13.0)
OWN = 2  # agent of tests in which one agent knows its own plans
COLUMNS = {agent: input_indices(uavs) for agent, uavs in enumerate(OWNED, start=1)}
STEPS = 5


def labelled(agent: int, k: int, *, steps: int = STEPS, delay: int = 0) -> Plan:
    """Return a plan whose numbers encode agent, tick, step and input."""
    uavs = tuple(uav + 1 for uav in OWNED[agent - 1])
    columns = np.arange(4 * len(uavs))
    return Plan(
        sender=f"agent{agent}",
        incarnation=0,
        sequence=0,
        tick=k,
        agent=agent,
        start_tick=k + delay,
        negotiation=0,
        shared=True,
        uavs=uavs,
        uav_states=np.zeros((len(uavs), 12)),
        inputs=1e6 * agent + 1e3 * k + 10.0 * np.arange(steps)[:, None] + columns / 10.0,
        corrections=-1e6 * agent - 1e3 * k - 10.0 * np.arange(steps)[:, None] - columns / 10.0,
        status="solved",
    )


def announced(*plans: Plan, alignment: Alignment = "by_age", own: int = 0) -> AnnouncedInputs:
    """Return announced inputs after some plans."""
    inputs = AnnouncedInputs(OWNED, U_HOVER, alignment=alignment, own=own)
    for plan in plans:
        inputs.add(plan)
    return inputs


def rows(agent: int, U: Array) -> Array:
    """Return one agent's part of the inputs."""
    return U[..., COLUMNS[agent]]


def test_hover_before_any_plan() -> None:
    """An agent without plan is assumed to hover."""
    inputs = announced(labelled(1, 0))
    U = inputs.sequence(1, STEPS, before=1)
    np.testing.assert_array_equal(rows(2, U), np.tile(U_HOVER[4:8], (STEPS, 1)))
    np.testing.assert_array_equal(rows(2, inputs.in_force(0, before=1)), U_HOVER[4:8])
    np.testing.assert_array_equal(announced().in_force(0, before=0), U_HOVER)


def test_fail_safe_begins_where_the_inputs_in_force_end() -> None:
    """Inputs assumed in place of the last plan put off the fail-safe, for the filter as well."""
    inputs = announced(labelled(2, 0))
    inputs.heard.off_roster = {2}
    start = 2
    assumed = np.tile(np.arange(STEPS, dtype=float)[:, None], (1, len(U_HOVER)))
    inputs.assume(2, start, assumed)

    np.testing.assert_array_equal(rows(2, inputs.in_force(1, before=2)), labelled(2, 0).inputs[1])
    for tick in range(start, start + STEPS + 2):
        is_over = tick >= start + STEPS
        expected = U_HOVER[COLUMNS[2]] if is_over else assumed[tick - start, COLUMNS[2]]
        np.testing.assert_array_equal(rows(2, inputs.in_force(tick, before=tick)), expected)
        by_fail_safe = inputs.unannounced(tick, before=tick).by_fail_safe
        assert (by_fail_safe[COLUMNS[2]] == is_over).all()


class Following:
    """A fail-safe that follows: it takes over after so many steps of the last plan."""

    def __init__(self, played: int) -> None:
        self._played = played

    def played(self, steps: int, period_s: float) -> int:
        """Return the steps that the actuators play."""
        assert period_s == 0.05
        return min(steps, self._played)


@pytest.mark.parametrize("alignment", ["by_age", "by_one", "held"])
def test_off_the_roster_the_last_plan_is_played_by_its_age_then_hover(alignment: Alignment) -> None:
    """Whatever the alignment of others: the age of a last plan is known. No correction of it counts."""
    plan = labelled(2, 7)
    inputs = announced(plan, alignment=alignment)
    inputs.heard.off_roster = {2}
    hover = U_HOVER[COLUMNS[2]]
    expected = [plan.inputs[2], plan.inputs[3], plan.inputs[4], hover, hover]
    np.testing.assert_array_equal(rows(2, inputs.sequence(9, STEPS, before=9)), expected)
    assert not inputs.corrections(9, STEPS, before=9).any()


def test_off_the_roster_a_fail_safe_that_follows_takes_over_after_0_4_s() -> None:
    """Of a plan of 12 steps of 0.05 s 8 are played, of inputs assumed in its place as well."""
    plan = labelled(2, 0, steps=12)
    inputs = AnnouncedInputs(OWNED, U_HOVER, settings=ControllerSettings(sampling_period_s=0.05))
    inputs.add(plan)
    inputs.heard.off_roster = {2}
    inputs.fail_safe = Following(8)  # type: ignore[assignment]  # all that `sequence` asks
    hover = U_HOVER[COLUMNS[2]]
    U = rows(2, inputs.sequence(6, 4, before=6))
    np.testing.assert_array_equal(U, [plan.inputs[6], plan.inputs[7], hover, hover])
    inputs.assume(2, 10, np.tile(np.arange(12.0)[:, None], (1, len(U_HOVER))))
    U = rows(2, inputs.sequence(16, 4, before=16))
    np.testing.assert_array_equal(U, [[6.0] * 4, [7.0] * 4, hover, hover])


@pytest.mark.parametrize(
    ("start", "steps"), [(1, [0, 1, 2]), (2, [0, 1, 2]), (3, [1, 2, 3]), (6, [4]), (8, [])]
)
def test_assumed_inputs_begin_at_their_tick(start: int, steps: list[int]) -> None:
    """From tick 2 on five steps are assumed for a departed agent, then hover, (32b)."""
    inputs = announced(labelled(2, 0))
    inputs.heard.off_roster = {2}
    inputs.assume(2, 2, np.tile(np.arange(5.0)[:, None], (1, len(U_HOVER))))
    hover = list(U_HOVER[COLUMNS[2]])
    expected = [[float(step)] * 4 for step in steps] + [hover] * (3 - len(steps))
    np.testing.assert_array_equal(rows(2, inputs.sequence(start, 3, before=start)), expected)


def test_corrections_from_before_a_failure_do_not_count() -> None:
    """Plans of the tick of the failure of a UAV count, older ones do not."""
    older, newer = labelled(1, 6), labelled(2, 7)
    inputs = announced(older, newer)
    inputs.heard.failed_since = 7
    c = inputs.corrections(8, 2, before=8)
    np.testing.assert_array_equal(rows(1, c), np.zeros((2, 8)))
    np.testing.assert_array_equal(rows(2, c), newer.corrections[1:3])


@pytest.mark.parametrize("agent", [1, 2])
def test_stale_plans_are_played_like_a_last_one(agent: int) -> None:
    """An agent that only repeats old inputs is assumed on its fail-safe once these have been played.

    That holds for the own plans as well.
    """
    inputs = announced(own=OWN)
    solved = 3
    for tick in range(solved, solved + STEPS + 3):
        age = tick - solved
        plan = replace(labelled(agent, tick), stale=age)
        inputs.add(plan)
        is_over = age >= STEPS
        in_force = rows(agent, inputs.in_force(tick, before=tick + 1))
        U = rows(agent, inputs.sequence(tick, STEPS, before=tick + 1))
        c = rows(agent, inputs.corrections(tick, STEPS, before=tick + 1))
        unannounced = inputs.unannounced(tick, before=tick + 1)
        hover = U_HOVER[COLUMNS[agent]]
        np.testing.assert_array_equal(in_force, hover if is_over else plan.inputs[0])
        assert (unannounced.by_fail_safe[COLUMNS[agent]] == is_over).all()
        # The own shifted plan stays what the next solution is mixed with.
        is_known = not is_over or agent == OWN
        np.testing.assert_array_equal(U, plan.inputs if is_known else np.tile(hover, (STEPS, 1)))
        np.testing.assert_array_equal(c, plan.corrections if is_known else np.zeros_like(c))


def test_age_of_information_is_that_of_the_last_solved_step() -> None:
    """Another agent that only repeats old inputs is as silent as one that sends none."""
    silence = Silence.of(0.05, is_filtered=False)
    repeating = HeardOthers((1, 2), own=OWN, silence=silence)
    silent = HeardOthers((1, 2), own=OWN, silence=silence)
    silent.plans.add(labelled(1, 0))
    for tick in range(60):
        repeating.plans.add(replace(labelled(1, tick), stale=tick))
        repeating.observe(tick + 1)
        silent.observe(tick + 1)
        assert repeating.oldest_information == silent.oldest_information
        plans = [heard.plans.newest(1, before=tick + 1) for heard in (repeating, silent)]
        shares = [
            heard.share_alone(1, plan, tick + 1)
            for heard, plan in zip((repeating, silent), plans, strict=True)
        ]
        assert shares[0] == shares[1]
    assert shares[0] == 1.0


@pytest.mark.parametrize("age", range(-1, STEPS + 3))
@pytest.mark.parametrize("delay", [0, 1])
def test_shift_and_hold(age: int, delay: int) -> None:
    """A plan is shifted by the ticks since its start and held at its last step; before its start it is not.

    Source: docs/equations.md (32).
    """
    made = 7
    plan = labelled(1, made, delay=delay)
    start = plan.start_tick + age
    U = announced(plan).sequence(start, STEPS, before=max(start, made) + 1)
    shifted = [plan.inputs[min(max(age, 0) + step, STEPS - 1)] for step in range(STEPS)]
    np.testing.assert_array_equal(rows(1, U), shifted)


def test_own_inputs_without_those_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only the own inputs are looked up they are the same, and the others' are hover."""
    monkeypatch.setattr(np, "empty", lambda shape: np.full(shape, np.nan))  # so that a gap shows
    inputs = announced(labelled(1, 7), labelled(2, 7), own=1)
    of_all = inputs.sequence(8, STEPS, before=8)
    own = inputs.sequence(8, STEPS, before=8, of_all=False)
    np.testing.assert_array_equal(rows(1, own), rows(1, of_all))
    np.testing.assert_array_equal(rows(2, own), np.tile(rows(2, U_HOVER), (STEPS, 1)))
    assert (rows(2, of_all) != rows(2, own)).any()


@pytest.mark.parametrize("age", range(STEPS + 3))
@pytest.mark.parametrize("delay", [0, 1])
def test_corrections_end(age: int, delay: int) -> None:
    """Corrections are shifted like inputs but zero after their end, and before any plan."""
    plan = labelled(1, 7, delay=delay)
    start = plan.start_tick + age
    c = announced(plan).corrections(start, STEPS, before=start + 1)
    np.testing.assert_array_equal(rows(2, c), np.zeros((STEPS, 4)))
    left = plan.corrections[age:]
    np.testing.assert_array_equal(rows(1, c), np.vstack([left, np.zeros((STEPS - len(left), 8))]))


@pytest.mark.parametrize("own", [0, 1])
@pytest.mark.parametrize("age", range(STEPS + 3))
@pytest.mark.parametrize("delay", [0, 1])
def test_plans_of_others_count_as_one_tick_old_as_published(age: int, delay: int, own: int) -> None:
    """With `by_one` a plan of another agent is one tick old at most, (32); the age of an own one is known."""
    plan = labelled(1, 7, delay=delay)
    by_one, by_age = announced(plan, alignment="by_one", own=own), announced(plan)
    one_old = plan.start_tick + (age if own == 1 else min(age, 1))
    start = plan.start_tick + age
    np.testing.assert_array_equal(
        rows(1, by_one.sequence(start, STEPS, before=start + 1)),
        rows(1, by_age.sequence(one_old, STEPS, before=start + 1)),
    )
    np.testing.assert_array_equal(
        rows(1, by_one.corrections(start, STEPS, before=start + 1)),
        rows(1, by_age.corrections(one_old, STEPS, before=start + 1)),
    )


@pytest.mark.parametrize("age", range(STEPS + 3))
def test_plans_of_others_are_held_at_their_input_of_the_present_tick(age: int) -> None:
    """With `held` the others keep U_a(s - s_a), and its correction, over the whole horizon, (32)."""
    plan = labelled(1, 7)
    start = plan.start_tick + age
    held = announced(plan, alignment="held")
    U = rows(1, held.sequence(start, STEPS, before=start + 1))
    np.testing.assert_array_equal(U, np.tile(plan.inputs[min(age, STEPS - 1)], (STEPS, 1)))
    c = plan.corrections[age] if age < STEPS else np.zeros(8)  # none after the end of the plan
    c_held = rows(1, held.corrections(start, STEPS, before=start + 1))
    np.testing.assert_array_equal(c_held, np.tile(c, (STEPS, 1)))


def test_early_plans_wait() -> None:
    """A plan of tick k that is here before tick k + 1 is not used before.

    The network's speed has no effect.
    """
    early, older = labelled(1, 5), labelled(1, 4)
    inputs = announced(older, early)
    assert inputs.plans.newest(1, before=5) is older
    assert inputs.plans.newest(1, before=6) is early
    np.testing.assert_array_equal(
        inputs.sequence(5, STEPS, before=5), announced(older).sequence(5, STEPS, before=5)
    )
    np.testing.assert_array_equal(
        inputs.in_force(5, before=5), announced(older).in_force(5, before=5)
    )
    np.testing.assert_array_equal(
        rows(1, inputs.corrections(5, 1, before=5))[0], older.corrections[1]
    )
    np.testing.assert_array_equal(rows(1, inputs.sequence(6, STEPS, before=6))[0], early.inputs[1])


def test_in_force_is_the_newest_that_had_started() -> None:
    """Over [t_k, t_{k+1}) the newest plan started by t_k acts; it is held at its end."""
    plans = [labelled(1, 0), labelled(1, 3)]
    inputs = announced(*plans)
    expected = [plans[0].inputs[0], plans[0].inputs[1], plans[0].inputs[2]]
    expected += [plans[1].inputs[min(step, STEPS - 1)] for step in range(STEPS + 2)]
    for k, u in enumerate(expected):
        np.testing.assert_array_equal(rows(1, inputs.in_force(k, before=100)), u)


X = np.linspace(-1.0, 1.0, 48)


def by_law(tick: int, x: Array) -> Array:
    """Return inputs of a control law that encode tick, state and input."""
    inputs: Array = 100.0 * tick + 7.0 * x[:12] + np.arange(12.0)
    return inputs


def under_law(
    *plans: Plan, own: int = 0, law: Law = by_law, settings: ControllerSettings | None = None
) -> AnnouncedInputs:
    """Return announced inputs under a shared control law after some plans."""
    shared = SharedLaw(inputs=law)
    inputs = AnnouncedInputs(OWNED, U_HOVER, own=own, law=shared, settings=settings)
    for plan in plans:
        inputs.add(plan)
    return inputs


@pytest.mark.parametrize("age", range(STEPS + 3))
@pytest.mark.parametrize("delay", [0, 1])
def test_later_inputs_follow_the_law(age: int, delay: int) -> None:
    """After the first step of a plan its agent followed the law with its corrections, (32a)."""
    plan = labelled(1, 7, delay=delay)
    k = plan.start_tick + age
    u = rows(1, under_law(plan).in_force(k, before=k + 1, x=X))
    if age == 0:
        np.testing.assert_array_equal(u, plan.inputs[0])
    else:
        c = plan.corrections[age] if age < STEPS else np.zeros(8)  # none after the end of the plan
        np.testing.assert_array_equal(u, by_law(k, X)[COLUMNS[1]] + c)


# State at the tick at which a plan starts, another one than later, and what the inputs of an agent
# differ from the shared law by, as its estimate has a force that others do not know.
X_START = np.linspace(2.0, -1.0, 48)
DIFFERENCE = np.linspace(0.5, 4.0, 8)
ROUNDING = 1e-12  # sums of a few numbers, relative


def differing(k: int, *, delay: int = 0) -> Plan:
    """Return a plan of agent 1 whose first inputs are the corrected law's and the difference."""
    plan = labelled(1, k, delay=delay)
    inputs = plan.inputs.copy()
    law = by_law(plan.start_tick, X_START)[COLUMNS[1]]
    inputs[0] = law + plan.corrections[0] + DIFFERENCE
    return replace(plan, inputs=inputs)


def knowing_starts(plan: Plan) -> AnnouncedInputs:
    """Return announced inputs under the shared law, with the state at which the plan starts."""
    law = SharedLaw(inputs=by_law, start_state=lambda _: X_START)
    inputs = AnnouncedInputs(OWNED, U_HOVER, law=law)
    inputs.add(plan)
    return inputs


@pytest.mark.parametrize("age", range(1, STEPS + 3))
@pytest.mark.parametrize("delay", [0, 1])
def test_the_difference_of_the_first_step_from_the_law_stays(age: int, delay: int) -> None:
    """Inputs that differ from the corrected law at a plan's start differ as much later, (32a)."""
    plan = differing(7, delay=delay)
    k = plan.start_tick + age
    u = rows(1, knowing_starts(plan).in_force(k, before=k + 1, x=X))
    c = plan.corrections[age] if age < STEPS else np.zeros(8)  # none after the end of the plan
    law = by_law(k, X)[COLUMNS[1]]
    np.testing.assert_allclose(u, law + c + DIFFERENCE, rtol=ROUNDING)


@pytest.mark.parametrize("made", [6, 7, 8])
def test_the_difference_from_the_law_ends_with_the_law(made: int) -> None:
    """A difference stays from plans of the tick of the change on, not from older ones, (46)."""
    change = 7
    plan = differing(made)
    inputs = knowing_starts(plan)
    inputs.law_since = change
    k = 9
    u = rows(1, inputs.in_force(k, before=k + 1, x=X))
    expected = by_law(k, X)[COLUMNS[1]] + plan.corrections[k - made]
    if made >= change:
        expected = expected + DIFFERENCE
    np.testing.assert_allclose(u, expected, rtol=ROUNDING)


def test_own_inputs_are_known() -> None:
    """The own plan counts as announced, as in the plant's schedule, (32a)."""
    plan = labelled(1, 7)
    inputs = under_law(plan, labelled(2, 7), own=1)
    for age in range(STEPS + 2):
        u = inputs.in_force(7 + age, before=20, x=X)
        np.testing.assert_array_equal(rows(1, u), plan.inputs[min(age, STEPS - 1)])
        if age:
            assert rows(2, u)[0] == by_law(7 + age, X)[4] + (
                labelled(2, 7).corrections[age][0] if age < STEPS else 0.0
            )


def test_corrections_outlast_a_change_of_the_law() -> None:
    """From the tick of the change on, older plans correct the new law; before, they were played, (46)."""
    older, newer = labelled(1, 7), labelled(2, 9)
    inputs = under_law(older, newer)
    inputs.law_since = 9
    u = inputs.in_force(8, before=12, x=X)
    np.testing.assert_array_equal(rows(1, u), older.inputs[1])
    u = inputs.in_force(9, before=12, x=X)
    np.testing.assert_array_equal(rows(1, u), by_law(9, X)[COLUMNS[1]] + older.corrections[2])
    u = inputs.in_force(10, before=12, x=X)
    np.testing.assert_array_equal(rows(1, u), by_law(10, X)[COLUMNS[1]] + older.corrections[3])
    np.testing.assert_array_equal(rows(2, u), by_law(10, X)[COLUMNS[2]] + newer.corrections[1])
    ahead = inputs.corrections(10, 1, before=12)[0]
    np.testing.assert_array_equal(rows(1, ahead), older.corrections[3])


def test_after_a_change_of_the_law_silent_agents_act_alone() -> None:
    """An agent about which information is older than the law acts alone by their age, like any other, (32c)."""
    rule = Silence.of(0.05, is_filtered=False)
    shared = SharedLaw(
        inputs=by_law,
        silence=rule,
        inputs_alone=lambda uav, tick, x: np.full(4, 1e4 * uav + tick),
    )
    inputs = AnnouncedInputs(OWNED, U_HOVER, law=shared)
    inputs.add(labelled(1, 7))
    inputs.law_since = 9
    silent = 10 + round(rule.overdue.complete)
    u = rows(1, inputs.in_force(silent, before=silent, x=X))
    np.testing.assert_array_equal(u, [silent] * 4 + [2e4 + silent] * 4)


@given(st.lists(st.sets(st.sampled_from([2, 3, 4])), min_size=1, max_size=80), st.booleans())
def test_oldest_information_tell_how_much_to_act_alone(
    heard: list[set[int]], is_filtered: bool
) -> None:
    """The largest ages give the largest share that the rule has for any other agent on the roster."""
    rule = Silence.of(0.05, is_filtered=is_filtered)
    owned = ((0,), (1,), (2,), (3,))
    inputs = AnnouncedInputs(owned, np.zeros(16), own=1, law=SharedLaw(silence=rule))
    inputs.heard.off_roster = {4}
    for k, agents in enumerate(heard, start=1):
        for agent in agents:
            plan = replace(labelled(2, k - 1), agent=agent)
            inputs.add(plan)
        inputs.heard.observe(k)
        newest = {agent: inputs.plans.newest(agent, before=k) for agent in (2, 3)}
        ages = [inputs.heard.age(agent, plan, k) for agent, plan in newest.items()]
        shares = [rule.alone(age) for age in ages]
        assert rule.alone(inputs.heard.oldest_information) == max(shares)


def test_inputs_taken_to_be_in_force_are_within_limits() -> None:
    """No input in force is assumed beyond the limits of the actuators.

    By plan, law or hover, (32a).
    """
    settings = ControllerSettings(limits=Limits(thrust_N=(0.0, 30.0), moments_Nm=(1.0, 2.0, 3.0)))
    low, high = settings.lower(3), settings.upper(3)
    rng = np.random.default_rng(0)

    def wild(_tick: int, x: Array) -> Array:
        return 40.0 * rng.standard_normal(len(x[:12]))

    inputs = under_law(labelled(1, 7), law=wild, settings=settings)
    for k in (6, 7, 8, 9, 30):
        u = inputs.in_force(k, before=50, x=X)
        assert (low <= u).all()
        assert (u <= high).all()
    modest = replace(labelled(1, 7), corrections=np.full((STEPS, 8), 0.25))
    within = np.array([15.0, 0.5, -0.5, 0.5] * 3)
    inputs = under_law(modest, law=lambda _tick, _x: within, settings=settings)
    np.testing.assert_array_equal(rows(1, inputs.in_force(8, before=9, x=X)), within[:8] + 0.25)


def test_after_a_failure_the_law_holds_without_older_corrections() -> None:
    """Before the failure a plan counts as announced; after it by the law, corrected by newer plans only."""
    older, newer = labelled(1, 6), labelled(2, 8)
    inputs = under_law(older, newer)
    inputs.heard.failed_since = 8
    before = inputs.in_force(7, before=10, x=X)
    np.testing.assert_array_equal(rows(1, before), older.inputs[1])
    after = inputs.in_force(9, before=10, x=X)
    np.testing.assert_array_equal(rows(1, after), by_law(9, X)[COLUMNS[1]])
    np.testing.assert_array_equal(rows(2, after), by_law(9, X)[COLUMNS[2]] + newer.corrections[1])


def test_a_plan_without_corrections_leaves_the_law() -> None:
    """An agent that announces no corrections is assumed by the law alone."""
    plan = replace(labelled(1, 6), corrections=np.zeros((0, 8)))
    for inputs in (under_law(plan), knowing_starts(plan)):
        u = inputs.in_force(8, before=9, x=X)
        np.testing.assert_array_equal(rows(1, u), by_law(8, X)[COLUMNS[1]])


def test_the_difference_from_the_law_is_that_of_the_newest_plan_and_estimate() -> None:
    """It changes with the plan, also where the law at their starts is the same, and with a late message."""
    law = np.arange(12.0)
    at_start = [law]
    shared = SharedLaw(
        inputs=lambda tick, _: law if tick == 20 else at_start[0], start_state=lambda _: X
    )
    inputs = AnnouncedInputs(OWNED, U_HOVER, law=shared)
    columns = COLUMNS[1]
    for plan, start in [(labelled(1, 7), law), (labelled(1, 8), law), (labelled(1, 8), 2.0 * law)]:
        inputs.add(plan)
        at_start[0] = start
        expected = law[columns] + plan.inputs[0] - start[columns] - plan.corrections[0]
        u = inputs.in_force(20, before=20, x=X)
        np.testing.assert_allclose(rows(1, u), expected, rtol=ROUNDING)


def test_off_the_roster_the_last_plan_is_in_force_and_no_law() -> None:
    """The actuators play the inputs of a last plan, whatever the law says."""
    plan = labelled(1, 6)
    inputs = under_law(plan)
    inputs.heard.off_roster = {1}
    np.testing.assert_array_equal(rows(1, inputs.in_force(8, before=9, x=X)), plan.inputs[2])


# Limits beyond all numbers here.
WIDE = ControllerSettings(
    limits=Limits.model_construct(thrust_N=(-1e9, 1e9), moments_Nm=(1e9, 1e9, 1e9)),
    sampling_period_s=0.05,
)
RULE = Silence.of(0.05, is_filtered=False)  # alone from 10 ticks overdue on, wholly from 20


def test_a_quarter_alone_is_a_quarter_of_the_inputs_alone() -> None:
    """An agent that announces a share of 0.25 follows the law by three quarters."""
    plan = replace(labelled(2, 6), alone=0.25, corrections=np.zeros((0, 4)))
    law = SharedLaw(
        inputs=lambda _tick, _x: np.full(12, 8.0),
        silence=RULE,
        inputs_alone=lambda uav, _tick, _x: np.full(4, 100.0 + uav),
    )
    inputs = AnnouncedInputs(OWNED, U_HOVER, law=law)
    inputs.add(plan)
    u = inputs.in_force(7, before=8, x=X)
    np.testing.assert_array_equal(rows(2, u), np.full(4, 0.75 * 8.0 + 0.25 * 101.0))


def test_silent_others_by_columns() -> None:
    """None while all information is fresh; then share and correlation of the overdue agent alone.

    With a usual age of one tick, information is 15 ticks overdue 16 ticks after the last plan: half
    way between 0.5 s and 1 s, and 5 ticks of the 6 in which the correlation falls by e.
    """
    inputs = AnnouncedInputs(OWNED, U_HOVER, own=1, law=SharedLaw(silence=RULE))
    inputs.add(labelled(2, 0))
    inputs.heard.observe(1)
    assert inputs.silent(1, before=1) is None
    silent = inputs.silent(16, before=16)
    assert silent is not None
    np.testing.assert_allclose(silent.alone, [0.0] * 4 + [0.5] * 4 + [0.0] * 4)
    overdue = 0.6 * np.exp(-5.0 / 6.0)
    np.testing.assert_allclose(silent.correlation, [0.6] * 4 + [overdue] * 4 + [0.6] * 4)


def test_a_share_that_a_plan_announces_counts_while_it_is_fresh() -> None:
    """That of another agent does, the own one does not: own inputs are known."""
    inputs = AnnouncedInputs(OWNED, U_HOVER, own=1, law=SharedLaw(silence=RULE))
    inputs.add(replace(labelled(1, 0), alone=0.5))
    inputs.heard.observe(1)
    assert inputs.silent(1, before=1) is None
    inputs.add(replace(labelled(2, 0), alone=0.25))
    silent = inputs.silent(1, before=1)
    assert silent is not None
    np.testing.assert_array_equal(silent.alone, [0.0] * 4 + [0.25] * 4 + [0.0] * 4)


class FailSafe:
    """A fail-safe whose inputs encode UAV and tick; it takes over at the end of a plan."""

    def played(self, steps: int, _: float) -> int:
        """Return the steps that the actuators play."""
        return steps

    def inputs(self, uav: int, x: Array, tick: int) -> Array:
        """Return inputs."""
        return np.full(4, 100.0 * uav + tick + x[0])


def test_without_a_plan_inputs_are_those_of_the_agents_state() -> None:
    """Hover; overdue alone; on the fail-safe before a return, by the law from then on; without a state hover."""
    shared = SharedLaw(
        inputs=by_law, silence=RULE, inputs_alone=lambda uav, _tick, _x: np.full(4, 50.0 + uav)
    )
    inputs = AnnouncedInputs(OWNED, U_HOVER, own=2, law=shared, settings=WIDE)
    inputs.fail_safe = FailSafe()  # type: ignore[assignment]
    hover = U_HOVER[COLUMNS[1]]
    alone = [50.0] * 4 + [52.0] * 4
    silent = 60
    np.testing.assert_array_equal(rows(1, inputs.in_force(3, before=4, x=X)), hover)
    np.testing.assert_array_equal(rows(1, inputs.in_force(silent, before=silent, x=X)), alone)
    np.testing.assert_array_equal(rows(1, inputs.in_force(silent, before=silent)), hover)

    inputs.add(labelled(1, 40))
    inputs.assume(1, 41, np.ones((40, len(U_HOVER))))
    inputs.begin_anew(1, silent)
    by_fail_safe = np.repeat([0.0, 200.0], 4) + silent - 1 + X[0]
    before_return = inputs.in_force(silent - 1, before=silent, x=X)
    np.testing.assert_array_equal(rows(1, before_return), by_fail_safe)
    np.testing.assert_array_equal(rows(1, inputs.in_force(silent - 1, before=silent)), hover)
    returned = inputs.in_force(silent, before=silent, x=X)
    np.testing.assert_array_equal(rows(1, returned), by_law(silent, X)[COLUMNS[1]])
    U = inputs.sequence(silent, STEPS, before=silent)
    np.testing.assert_array_equal(rows(1, U), np.tile(hover, (STEPS, 1)))
    assert inputs.unannounced(silent - 1, before=silent).by_fail_safe[COLUMNS[1]].all()
    assert not inputs.unannounced(silent, before=silent).by_fail_safe.any()

    # One of the time before, which comes late: what it announced was in force.
    inputs.add(labelled(1, silent - 3))
    late = inputs.unannounced(silent - 1, before=silent)
    assert not late.by_fail_safe.any()
    assert late.by_law[COLUMNS[1]].all()


@pytest.mark.parametrize("has_fail_safe", [True, False])
def test_off_the_roster_the_fail_safe_is_that_of_each_uav(has_fail_safe: bool) -> None:
    """At the end of the last plan; hover without a fail-safe, without a state, and where no plan was ever made."""
    plan = labelled(1, 0)
    inputs = AnnouncedInputs(OWNED, U_HOVER, settings=WIDE)
    inputs.add(plan)
    inputs.heard.off_roster = {1, 2}
    if has_fail_safe:
        inputs.fail_safe = FailSafe()  # type: ignore[assignment]
    hover = U_HOVER[COLUMNS[1]]
    followed = np.repeat([0.0, 200.0], 4) + STEPS + X[0]
    np.testing.assert_array_equal(
        rows(1, inputs.in_force(STEPS - 1, before=9, x=X)), plan.inputs[-1]
    )
    u = inputs.in_force(STEPS, before=9, x=X)
    np.testing.assert_array_equal(rows(1, u), followed if has_fail_safe else hover)
    np.testing.assert_array_equal(rows(2, u), U_HOVER[COLUMNS[2]])
    np.testing.assert_array_equal(rows(1, inputs.in_force(STEPS, before=9)), hover)
    is_over = inputs.unannounced(STEPS, before=9).by_fail_safe
    assert (is_over == np.isin(np.arange(12), COLUMNS[1])).all()


def test_which_inputs_the_law_gives() -> None:
    """Another agent's without plan or after the first step of it, never the own ones."""
    inputs = announced(labelled(1, 6), own=OWN)
    of_agent_1 = np.array([True] * 4 + [False] * 4 + [True] * 4)
    np.testing.assert_array_equal(inputs.unannounced(5, before=9).by_law, of_agent_1)
    assert not inputs.unannounced(6, before=9).by_law.any()
    np.testing.assert_array_equal(inputs.unannounced(7, before=9).by_law, of_agent_1)
    assert not inputs.unannounced(7, before=9).by_fail_safe.any()
    next_tick = announced(labelled(1, 6, delay=1), own=OWN)
    assert not next_tick.unannounced(7, before=9).by_law.any()
