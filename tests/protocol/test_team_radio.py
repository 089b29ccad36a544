"""The radio of a team: refused settings, the fates of plans in a run, and what they cost."""

from collections import Counter
from functools import cache

import numpy as np
import pytest

from tests.support.runs import recorded, setup, ticks
from transport.protocol.radio.slots import frame_lengths
from transport.protocol.radio.standard import OFDM
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.links import Link
from transport.protocol.scenario.radio_settings import plan_length
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    NO_NEWS,
    REPLACED,
    Airtime,
    Message,
    Plan,
    PlantState,
    StepReport,
)

TICKS = 12
CLOSED_LOOP = "controller.prediction=closed_loop", "controller.received_plans=by_age"
AT_ONE_INSTANT = "radio={offsets='none',computation_deviation_s=0.0}"
PERIOD_S = 0.05
ROUNDING_S = 1e-9


@cache
def messages_of(*settings: str) -> list[Message]:
    """Return all messages of a short run in memory."""
    return recorded(setup(ticks(TICKS), *CLOSED_LOOP, *settings))


def news_of(*settings: str) -> list[Airtime]:
    """Return the news of the radio of a short run."""
    return [one for one in messages_of(*settings) if isinstance(one, Airtime)]


def states_of(*settings: str) -> list[bytes]:
    """Return the plant's states of a short run."""
    found = [one for one in messages_of(*settings) if isinstance(one, PlantState)]
    return [state.x.tobytes() for state in found]


def lost_of(*settings: str) -> int:
    """Return how many plans the agents have counted as lost."""
    reports = [one for one in messages_of(*settings) if isinstance(one, StepReport)]
    return sum(report.lost for report in reports)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            ("radio={rate_mbps=7.0}",),
            "radio.rate_mbps: expected one of 6, 9, 12, 18, 24, 36, 48, 54 with 802.11a, got 7",
        ),
        (
            ("radio={standard='802.11b',rate_mbps=6.0}",),
            "radio.rate_mbps: expected one of 1, 2, 5.5, 11 with 802.11b, got 6",
        ),
        (("radio={power_mw=-1.0}",), "radio.power_mw: expected greater than 0, got -1"),
        (
            ("radio={queue_length=0}",),
            "radio.queue_length: expected greater than or equal to 1, got 0",
        ),
        (("radio={background=1.0}",), "radio.background: expected less than 1, got 1"),
        (("radio={standard='802.11n'}",), "radio.standard: expected '802.11a' or '802.11b'"),
        (
            ("radio={}", "clock.mode=realtime", "clock.speed=1.0"),
            "expected no such section with clock.mode = 'realtime': the network is real",
        ),
        (
            ("radio={}", "agents.owned=[[1,2,3,4]]"),
            "radio={}: expected several agents with it: one agent sends no plans, got one agent",
        ),
        (
            ("radio={computation_mean_s=0.05}",),
            "radio.computation_mean_s: expected mean and three deviations below 0.05 s",
        ),
        (
            ("radio={inputs='first'}",),
            "radio.inputs: expected 'all' without controller.prediction = 'closed_loop': the others "
            "predict with them, got 'first'",
        ),
        (
            ("radio={offsets='none',cycle_ticks=2}",),
            "radio.cycle_ticks: expected no value with radio.offsets = 'none', which has no slots, "
            "got 2",
        ),
        (
            ("radio={cycle_ticks=2}", "controller.negotiation_iterations=3"),
            "radio.cycle_ticks: expected 1 with controller.negotiation_iterations = 3: each exchange "
            "has the slots of all agents, got 2",
        ),
    ],
)
def test_refused_settings(settings: tuple[str, ...], text: str) -> None:
    """A radio that cannot be is refused with key, expected and got."""
    with pytest.raises(ScenarioError) as refused:
        setup(*settings)
    assert text in str(refused.value)


def test_without_a_section_there_is_no_radio() -> None:
    """A run without `[radio]` has no news of one."""
    assert news_of() == []


def test_slots_deliver_every_plan_within_its_tick() -> None:
    """With slots the radio costs nothing: states have the bits of a run without one."""
    arrivals = np.vstack([one.arrivals for one in news_of("radio={}")])
    decided = arrivals[arrivals != NO_NEWS]
    assert len(decided) == (TICKS - 1) * 4 * 3
    assert np.all((decided > 0.0) & (decided <= PERIOD_S))
    assert states_of("radio={}") == states_of()


def test_sends_at_one_instant_deliver_nothing() -> None:
    """Agents that send at one instant lose every plan, and count it."""
    arrivals = np.vstack([one.arrivals for one in news_of(AT_ONE_INSTANT)])
    assert Counter(arrivals[arrivals != NO_NEWS]) == {-1.0: (TICKS - 1) * 4 * 3}
    assert lost_of(AT_ONE_INSTANT) == (TICKS - 1) * 4 * 3
    assert states_of(AT_ONE_INSTANT) != states_of()


def test_airtime_is_that_of_the_real_messages() -> None:
    """The channel is busy for as long as the encoded plans take."""
    plans = [one for one in messages_of("radio={}") if isinstance(one, Plan)]
    airtime_ns = sum(
        OFDM.message_airtime_ns(len(encode(plan)), 6.0) for plan in plans if plan.tick < TICKS - 1
    )
    busy_s = sum(one.busy_s for one in news_of("radio={}"))
    assert busy_s == pytest.approx(airtime_ns / 1e9, rel=ROUNDING_S)


def test_plans_that_are_not_shared_take_no_air() -> None:
    """With on_change only the plans that are sent take airtime."""
    sharing = ("radio={}", "controller.share=on_change", "controller.received_states=predicted")
    plans = [one for one in messages_of(*sharing) if isinstance(one, Plan) and one.shared]
    frames = sum(one.transmissions for one in news_of(*sharing))
    assert frames == sum(plan.tick < TICKS - 1 for plan in plans)
    assert frames < (TICKS - 1) * 4


def test_each_exchange_of_a_negotiation_takes_air() -> None:
    """Three iterations put three times as many plans on the air, each reported when it ends."""
    three = ("radio={}", "controller.negotiation_iterations=3", "controller.relaxation=0.25")
    news = news_of(*three)
    assert Counter(one.negotiation for one in news) == {2: TICKS, 1: TICKS, 0: TICKS - 1}
    proposals = [one for one in news if one.negotiation > 0]
    assert sum(one.transmissions for one in proposals) == 2 * TICKS * 4
    for one in proposals:
        ends_s = PERIOD_S / 3.0 * (3 - one.negotiation)
        heard = one.arrivals[one.arrivals >= 0.0]
        assert len(heard) == 4 * 3
        assert np.all(heard <= ends_s)


def test_proposals_at_one_instant_are_not_heard() -> None:
    """A negotiation whose exchanges all collide has the result of one iteration."""
    lost = (AT_ONE_INSTANT, "controller.negotiation_iterations=2", "controller.relaxation=1.0")
    silent = ("links.loss=1.0", "controller.negotiation_iterations=2", "controller.relaxation=1.0")
    assert states_of(*lost) == states_of(*silent)


def test_links_act_behind_the_radio() -> None:
    """Delay on the air and delay of the link add up before a plan counts."""
    link = Link(
        setup("links.delay_s=0.03").scenario.links, "agent1", "agent2", seed=0, period_s=0.05
    )
    assert link.usable_ticks(4, 1, 0.01) == [5]
    assert link.usable_ticks(4, 1, 0.03) == [6]
    assert link.usable_ticks(4, 1, 0.13) == [8]


def test_late_computations_make_plans_late() -> None:
    """A plan that is computed after the next tick is used two ticks after its own."""
    late = "radio={offsets='none',computation_mean_s=0.06,computation_deviation_s=0.002}"
    ages = {
        age
        for one in messages_of(late)
        if isinstance(one, StepReport) and one.tick > 2
        for age in one.plan_ages
    }
    assert 2 in ages
    assert 1 not in ages


SLOW = "radio={standard='802.11b',rate_mbps=1.0}"  # a plan takes 12.2 ms


def test_the_length_of_a_plan_is_known_before_the_run() -> None:
    """Slots are for plans as long as the longest one."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, "radio={}")
    assert run.scenario.radio is not None
    plans = [one for one in messages_of("radio={}") if isinstance(one, Plan)]
    assert plan_length(run, run.scenario.radio) - max(len(encode(plan)) for plan in plans) in range(
        8
    )


def test_slots_that_do_not_fit_into_a_period_take_turns() -> None:
    """At 1 Mb/s two agents send in a tick and two in the next; each plan sent arrives."""
    news = news_of(SLOW)
    arrivals = np.vstack([one.arrivals for one in news])
    sent = np.concatenate([one.of_sent() for one in news])
    replaced = np.count_nonzero(arrivals == REPLACED)
    assert len(sent) == 2 * (TICKS - 1) * 3
    assert np.all(sent > 0.0)
    # At the end two plans wait for their turns.
    assert len(sent) + replaced == (4 * (TICKS - 1) - 2) * 3
    assert all(one.transmissions == 2 for one in news)


def test_replaced_plans_are_not_lost() -> None:
    """The others use the newest plan that was sent, at most three ticks old, and count no loss."""
    reports = [one for one in messages_of(SLOW) if isinstance(one, StepReport)]
    assert lost_of(SLOW) == 0
    assert {age for one in reports if one.tick > 3 for age in one.plan_ages} == {1, 2}


def test_slots_of_one_tick_overlap_if_they_are_too_short() -> None:
    """With a cycle of one tick the last plans at 1 Mb/s come after the next tick."""
    short = "radio={standard='802.11b',rate_mbps=1.0,cycle_ticks=1}"
    assert REPLACED not in np.vstack([one.arrivals for one in news_of(short)])
    assert max(one.arrivals.max() for one in news_of(short)) > PERIOD_S


@pytest.mark.parametrize(
    "changes",
    [
        ("links.delay_s=0.1", "links.loss=0.3"),
        ("controller.negotiation_iterations=3", "controller.relaxation=0.25"),
    ],
)
def test_the_first_input_is_enough_under_the_shared_law(changes: tuple[str, ...]) -> None:
    """Without the later inputs plans are two fifths shorter, and the run has the same bits."""
    whole, first = "radio={inputs='all'}", "radio={inputs='first'}"
    assert states_of(first, *changes) == states_of(whole, *changes)
    busy_s = [sum(one.busy_s for one in news_of(each, *changes)) for each in (whole, first)]
    assert 0.55 < busy_s[1] / busy_s[0] < 0.62


def test_a_long_message_takes_several_frames() -> None:
    """A message beyond the largest frame is cut; none is sent for nothing."""
    assert frame_lengths(1500) == [1500]
    assert frame_lengths(2296) == [2296]
    assert frame_lengths(5000) == [2296, 2296, 408]


def test_plans_in_several_frames_arrive_with_the_last() -> None:
    """An agent of two UAVs with a long horizon sends two frames, and one arrival counts."""
    pairs = ("radio={}", "agents.owned=[[1,2],[3,4]]", "controller.horizon=40")
    news = news_of(*pairs)
    frames = sum(one.transmissions for one in news)
    plans = sum(len(one.agents) for one in news)
    assert plans == 2 * (TICKS - 1)
    assert frames > plans


def test_equal_runs_have_equal_news() -> None:
    """The radio draws from the seed alone."""
    settings = (ticks(TICKS), *CLOSED_LOOP, "radio={offsets='random',background=0.3}")
    first, again = recorded(setup(*settings)), recorded(setup(*settings))
    other = recorded(setup(*settings, "seed=1"))

    def news(messages: list[Message]) -> list[bytes]:
        return [encode(one) for one in messages if isinstance(one, Airtime)]

    assert news(first) == news(again)
    assert news(first) != news(other)
