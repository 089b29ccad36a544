"""The radio of a team: refused settings, the fates of plans in a run, and what they cost."""

from collections import Counter
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.own_classes import Bulky
from tests.support.runs import ALL, VEHICLE, plan, recorded, setup, ticks
from transport.protocol.radio.channel_settings_and_state import ChannelParameters
from transport.protocol.radio.frames import FrameResult
from transport.protocol.radio.propagation import Propagation, noise_mw
from transport.protocol.radio.slot_length import frame_lengths, occupied_ns
from transport.protocol.radio.standards_80211 import DSSS, MESSAGE_BYTES, OFDM
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.radio.radio_parameters import (
    NS_PER_S,
    PlanShape,
    SlotLengths,
    channel_parameters,
    plan_length,
    propagation_of,
    send_times,
    slot_lengths,
)
from transport.protocol.scenario.radio.team_radio import TeamRadio
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    REPLACED,
    UNREPORTED,
    Airtime,
    Message,
    Plan,
    PlantState,
    StepReport,
)

TICKS = 12
PERIOD_S = 0.05
# The radio tells of a tick as the next one opens, and none opens after the last.
REPORTED_TICKS = TICKS - 1
AGENTS = len(ALL)
PAIRS = AGENTS * (AGENTS - 1)  # of sender and receiver

COLLISION = -float(FrameResult.COLLISION)  # in `Airtime.arrivals`

CLOSED_LOOP = "controller.prediction=closed_loop", "controller.received_plans=by_age"
AT_ONE_INSTANT = "radio={offsets='none',computation_deviation_s=0.0}"
# A plan occupies the channel for 12.322 ms: its frame of 1474 bytes and 36 bytes of headers takes
# 12.080 ms at 1 Mb/s, after a preamble of 0.192 ms, and waits 0.050 ms (DIFS) for the channel. Four of
# them take 49.3 ms; slots have 42 ms of the period of 50 ms, 8 ms are for the computation.
SLOW = "radio={standard='802.11b',rate_mbps=1.0}"
AGENTS_OF_A_TICK = 2  # that send with these slots; the others send in the next tick

# Error of the sum of the airtimes relative to it: rounding of seconds as floats.
ROUNDING = 1e-9
# Bytes by which plans of a run may be shorter than the longest one: MessagePack encodes small integers
# shorter.
SHORTER_BYTES = 7
# Airtime without the later inputs as a share of that with them: three fifths, preambles and headers
# included.
FIRST_INPUT_SHARE = 0.55, 0.62


@cache
def messages_of(*settings: str) -> list[Message]:
    """Return all messages of a short run in memory."""
    return recorded(setup(ticks(TICKS), *CLOSED_LOOP, *settings))


def reports_of(*settings: str) -> list[Airtime]:
    """Return the reports of the radio of a short run."""
    return [one for one in messages_of(*settings) if isinstance(one, Airtime)]


def states_of(*settings: str) -> list[bytes]:
    """Return the plant's states of a short run."""
    states = [one for one in messages_of(*settings) if isinstance(one, PlantState)]
    return [state.x.tobytes() for state in states]


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
    """A run without `[radio]` has no reports of one."""
    assert reports_of() == []


def test_slots_deliver_every_plan_within_its_tick() -> None:
    """With slots the radio costs nothing: states have the bits of a run without one."""
    arrivals = np.vstack([one.arrivals for one in reports_of("radio={}")])
    decided = arrivals[arrivals != UNREPORTED]
    assert len(decided) == REPORTED_TICKS * PAIRS
    assert np.all((decided > 0.0) & (decided <= PERIOD_S))
    assert states_of("radio={}") == states_of()


def test_plans_defer_to_the_traffic_of_others() -> None:
    """It is heard by all: plans wait for its end, and arrive later than without it."""
    alone_s, beside_s = (
        np.vstack([one.arrivals for one in reports_of(f"radio={{background={share}}}")])
        for share in (0.0, 0.5)
    )
    assert beside_s.max() > alone_s.max() + 0.1e-3
    assert sum(one.busy_s for one in reports_of("radio={background=0.5}")) > 0.3 * TICKS * PERIOD_S


def test_a_plan_that_none_hears_is_not_sent() -> None:
    """On a roster of one there are no receivers."""
    run = setup(ticks(TICKS), "radio={}")
    assert run.scenario.radio is not None
    radio = TeamRadio(run.run, run.scenario.radio)
    radio.send(plan(run, 1, 0), (1,))
    assert radio.advance(1, run.initial_state())["transmissions"] == 0


@pytest.mark.parametrize(
    ("plan_s", "cycle", "words"),
    [
        (0.002, 1, "takes 2.00 ms; 4 slots of 2.00 ms, one for each agent every tick"),
        (0.001, 3, "takes 1.00 ms; 4 slots of 2.00 ms, one for each agent every 3 ticks"),
        (
            0.0021,
            1,
            "takes 2.10 ms, longer than its slot: plans wait for each other and collide; 4",
        ),
    ],
)
def test_slots_in_words(plan_s: float, cycle: int, words: str) -> None:
    """A plan as long as its slot fits; one that is longer has a remedy."""
    slots = SlotLengths(plan_bytes=700, plan_s=plan_s, slot_s=0.002, slots=4, cycle_ticks=cycle)
    assert slots.text().startswith(f"a plan of 700 bytes {words}")
    assert slots.are_enough is ("longer" not in words)
    assert ("raise radio.rate_mbps" in slots.text()) is not slots.are_enough


def test_sends_at_one_instant_deliver_nothing() -> None:
    """Agents that send at one instant lose every plan, and count it."""
    arrivals = np.vstack([one.arrivals for one in reports_of(AT_ONE_INSTANT)])
    assert Counter(arrivals[arrivals != UNREPORTED]) == {COLLISION: REPORTED_TICKS * PAIRS}
    assert lost_of(AT_ONE_INSTANT) == REPORTED_TICKS * PAIRS
    assert states_of(AT_ONE_INSTANT) != states_of()


def test_airtime_is_that_of_the_real_messages() -> None:
    """The channel is busy for as long as the encoded plans take."""
    plans = [one for one in messages_of("radio={}") if isinstance(one, Plan)]
    rate_mbps = RadioSection().rate_mbps
    airtime_ns = sum(
        OFDM.message_airtime_ns(len(encode(plan)), rate_mbps)
        for plan in plans
        if plan.tick < REPORTED_TICKS
    )
    busy_s = sum(one.busy_s for one in reports_of("radio={}"))
    assert busy_s == pytest.approx(airtime_ns / NS_PER_S, rel=ROUNDING)


def test_plans_that_are_not_shared_take_no_air() -> None:
    """With on_change only the plans that are sent take airtime."""
    sharing = ("radio={}", "controller.share=on_change", "controller.received_states=predicted")
    plans = [one for one in messages_of(*sharing) if isinstance(one, Plan) and one.shared]
    frames = sum(one.transmissions for one in reports_of(*sharing))
    assert frames == sum(plan.tick < REPORTED_TICKS for plan in plans)
    assert frames < REPORTED_TICKS * AGENTS


def test_each_exchange_of_a_negotiation_takes_air() -> None:
    """Three iterations put three times as many plans on the air, each reported when it ends."""
    iterations = 3
    three = (
        "radio={}",
        f"controller.negotiation_iterations={iterations}",
        "controller.relaxation=0.25",
    )
    reports = reports_of(*three)
    assert Counter(one.negotiation for one in reports) == {2: TICKS, 1: TICKS, 0: REPORTED_TICKS}
    proposals = [one for one in reports if one.negotiation > 0]
    assert sum(one.transmissions for one in proposals) == (iterations - 1) * TICKS * AGENTS
    for one in proposals:
        ends_s = PERIOD_S / iterations * (iterations - one.negotiation)
        heard = one.arrivals[one.arrivals >= 0.0]
        assert len(heard) == PAIRS
        assert np.all(heard <= ends_s)


def test_proposals_at_one_instant_are_not_heard() -> None:
    """A negotiation whose exchanges all collide has the result of one iteration."""
    lost = (AT_ONE_INSTANT, "controller.negotiation_iterations=2", "controller.relaxation=1.0")
    silent = ("links.loss=1.0", "controller.negotiation_iterations=2", "controller.relaxation=1.0")
    assert states_of(*lost) == states_of(*silent)


def test_links_act_behind_the_radio() -> None:
    """Delay on the air and delay of the link add up before a plan counts."""
    links = setup("links.delay_s=0.03").scenario.links
    link = Link(links, "agent1", "agent2", seed=0, period_s=PERIOD_S)
    tick = 4
    # Air 10 ms and link 30 ms: before the next tick, 50 ms later.
    assert link.usable_ticks(tick, 1, 0.01) == [tick + 1]
    assert link.usable_ticks(tick, 1, 0.03) == [tick + 2]
    assert link.usable_ticks(tick, 1, 0.13) == [tick + 4]


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
    # Whatever their order on the air, plans are reported in that of their agents.
    for one in reports_of(late):
        plans = [*zip(one.agents, one.plan_ticks, one.exchanges, strict=True)]
        assert plans == sorted(plans)


def test_the_length_of_a_plan_is_known_before_the_run() -> None:
    """Slots are for plans as long as the longest one."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, "radio={}")
    assert run.scenario.radio is not None
    plans = [one for one in messages_of("radio={}") if isinstance(one, Plan)]
    longest = max(len(encode(plan)) for plan in plans)
    expected = plan_length(run.run, run.scenario.radio, PlanShape.of(run.run))
    assert 0 <= expected - longest <= SHORTER_BYTES


@pytest.mark.parametrize("owned", [((1,), (2, 3, 4)), ((1, 2, 3), (4,))])
def test_slots_are_for_the_agent_with_most_uavs(owned: tuple[tuple[int, ...], ...]) -> None:
    """Whichever agent that is: the largest plan of the last tick is as long as they expect."""
    groups = [list(uavs) for uavs in owned]
    run = setup(ticks(300), "radio={}", f"agents.owned={groups}")
    assert run.scenario.radio is not None
    expected = plan_length(run.run, run.scenario.radio, PlanShape.of(run.run))
    assert expected == max(len(encode(plan(run, agent, 300))) for agent in run.agents)


def test_slots_hold_the_reports_of_sensors() -> None:
    """With sensors of the vehicles a plan has corrections, and of four ticks 15 measurements, 4 inputs, a mark."""
    run = setup(ticks(300), "radio={}", *VEHICLE)
    assert run.scenario.radio is not None
    own = plan(run, 1, 300)
    longest = replace(own, uav_states=np.zeros((1, 4 * 20)), corrections=own.inputs)
    expected = plan_length(run.run, run.scenario.radio, PlanShape.of(run.run))
    assert expected == len(encode(longest))


def test_slots_are_for_the_agent_with_the_longest_name() -> None:
    """The name of agent 10 is a byte longer than that of agent 1."""
    run = setup(ticks(300), "radio={}")
    assert run.scenario.radio is not None
    team: Any = SimpleNamespace(
        agents=range(1, 11), owned=((0,),) * 10, ticks=300, sensors=run.run.sensors
    )
    longest = replace(plan(run, 1, 300), sender="agent10", agent=10)
    expected = plan_length(team, run.scenario.radio, PlanShape.of(run.run))
    assert expected == len(encode(longest)) == len(encode(plan(run, 1, 300))) + 1


def test_slots_that_do_not_fit_into_a_period_take_turns() -> None:
    """At 1 Mb/s two agents send in a tick and two in the next; each plan sent arrives."""
    reports = reports_of(SLOW)
    arrivals = np.vstack([one.arrivals for one in reports])
    sent = np.concatenate([one.of_sent() for one in reports])
    replaced = np.count_nonzero(arrivals == REPLACED)
    receivers = AGENTS - 1
    assert len(sent) == AGENTS_OF_A_TICK * REPORTED_TICKS * receivers
    assert np.all(sent > 0.0)
    # At the end the plans of the other two agents wait for their turns.
    waiting = AGENTS - AGENTS_OF_A_TICK
    assert len(sent) + replaced == (AGENTS * REPORTED_TICKS - waiting) * receivers
    assert all(one.transmissions == AGENTS_OF_A_TICK for one in reports)


def test_a_slow_plan_takes_as_long_as_stated() -> None:
    """Slots of all agents do not fit into a period with `SLOW`, those of two do."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, SLOW)
    slots = slot_lengths(run.run, PlanShape.of(run.run))
    assert slots is not None
    assert slots.plan_s == pytest.approx(12.322e-3)
    assert slots.slots == AGENTS_OF_A_TICK
    assert slots.slots * slots.slot_s == pytest.approx(42e-3)
    assert AGENTS * slots.plan_s > slots.slots * slots.slot_s


@pytest.mark.parametrize(("rate_mbps", "cycle"), [(2.0, 2), (1.0, 4)])
def test_slots_hold_the_own_data_of_a_class(rate_mbps: float, cycle: int) -> None:
    """A plan with 512 numbers has a slot as long as it needs, so that each plan sent arrives.

    Its 4.3 KB take some 19 ms at 2 Mb/s, so that two of them fit into the 42 ms of the slots of a
    tick, and 37 ms at 1 Mb/s. With the inputs of ten ticks it is longer, and fits still.
    """
    radio = f"radio={{standard='802.11b',rate_mbps={rate_mbps}}}"
    own = f"agents.controller={Bulky.__module__}:Bulky"
    run = setup(ticks(TICKS), radio, own)
    messages = recorded(run)
    plans = [one for one in messages if isinstance(one, Plan)]
    assert {one.data.size for one in plans} == {512}

    slots = slot_lengths(run.run, PlanShape.of(run.run).holding(plans))
    assert slots is not None
    assert slots.cycle_ticks == cycle
    assert 0 <= slots.plan_bytes - max(len(encode(one)) for one in plans) <= SHORTER_BYTES
    assert slots.are_enough

    told = [one for one in messages if isinstance(one, Airtime)]
    sent = np.concatenate([one.of_sent() for one in told])
    assert len(sent) > 0
    assert np.all(sent > 0.0)
    # From the sender's turn to its arrival: within its slot, in the tick of its turn.
    assert max(one.arrivals.max() for one in told) < cycle * PERIOD_S


def test_replaced_plans_are_not_lost() -> None:
    """The others use the newest plan that was sent, at most two ticks old, and count no loss."""
    reports = [one for one in messages_of(SLOW) if isinstance(one, StepReport)]
    assert lost_of(SLOW) == 0
    # Each agent has sent once by then.
    for tick in range(AGENTS // AGENTS_OF_A_TICK, TICKS):
        assert {age for one in reports if one.tick == tick for age in one.plan_ages} == {1, 2}


def test_proposals_of_one_window_all_go_on_the_air() -> None:
    """Only a plan that waits for the turn of its station is replaced by a newer one.

    With a slot in each exchange no plan waits for another one. So a proposal and the plan that
    follows it are both sent, even if the radio takes in both before it advances.
    """
    run = setup(ticks(TICKS), "radio={}", "controller.negotiation_iterations=2")
    assert run.scenario.radio is not None
    radio = TeamRadio(run.run, run.scenario.radio)
    following = plan(run, 1, 0)
    proposal = replace(following, negotiation=1)
    for one in (proposal, following):
        radio.send(one, ALL)
    reports = radio.advance(1, run.initial_state())
    assert reports["transmissions"] == 2
    assert sorted(reports["exchanges"]) == [0, 1]
    arrivals = np.array(reports["arrivals"])
    others = arrivals[:, 1:]  # agent 1 is no receiver of its own plans
    assert np.all((others > 0.0) & (others <= PERIOD_S))


def test_slots_of_one_tick_overlap_if_they_are_too_short() -> None:
    """With a cycle of one tick the last plans at 1 Mb/s arrive after the next tick."""
    short = "radio={standard='802.11b',rate_mbps=1.0,cycle_ticks=1}"
    assert REPLACED not in np.vstack([one.arrivals for one in reports_of(short)])
    assert max(one.arrivals.max() for one in reports_of(short)) > PERIOD_S


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
    busy_whole_s = sum(one.busy_s for one in reports_of(whole, *changes))
    busy_first_s = sum(one.busy_s for one in reports_of(first, *changes))
    least, most = FIRST_INPUT_SHARE
    assert least < busy_first_s / busy_whole_s < most


def test_a_long_message_takes_several_frames() -> None:
    """A message beyond the largest frame is cut; none is sent for nothing."""
    full = MESSAGE_BYTES
    assert frame_lengths(full - 1) == [full - 1]
    assert frame_lengths(full) == [full]
    assert frame_lengths(2 * full + 408) == [full, full, 408]


def test_plans_in_several_frames_arrive_with_the_last() -> None:
    """An agent of two UAVs with a long horizon sends three frames, and one arrival counts."""
    agents = 2
    frames_of_a_plan = 3
    pairs = ("radio={}", "agents.owned=[[1,2],[3,4]]", "controller.horizon=40")
    reports = reports_of(*pairs)
    frames = sum(one.transmissions for one in reports)
    plans = sum(len(one.agents) for one in reports)
    assert plans == agents * REPORTED_TICKS
    assert frames == frames_of_a_plan * plans

    # From the send to the arrival all frames have been on the air.
    plan_lengths = [len(encode(one)) for one in messages_of(*pairs) if isinstance(one, Plan)]
    lengths = frame_lengths(min(plan_lengths))
    assert len(lengths) == frames_of_a_plan
    rate_mbps = RadioSection().rate_mbps
    airtime_ns = sum(OFDM.message_airtime_ns(length, rate_mbps) for length in lengths)
    for one in reports:
        since_sent_s = one.arrivals - one.sent[:, None]
        assert np.all(since_sent_s[one.arrivals != UNREPORTED] > airtime_ns / NS_PER_S)


def test_equal_runs_have_equal_airtime_messages() -> None:
    """The radio draws from the seed alone."""
    settings = (ticks(TICKS), *CLOSED_LOOP, "radio={offsets='random',background=0.3}")
    first, again = recorded(setup(*settings)), recorded(setup(*settings))
    other = recorded(setup(*settings, "seed=1"))

    def reports(messages: list[Message]) -> list[bytes]:
        return [encode(one) for one in messages if isinstance(one, Airtime)]

    assert reports(first) == reports(again)
    assert reports(first) != reports(other)


# Rods that lean apart, by UAV: every pair of UAVs has another distance, beyond the reference of 1 m.
LEANING = ((-0.8, 0.0, 0.6), (0.0, -0.6, 0.8), (0.6, 0.0, 0.8), (0.0, 0.28, 0.96))


@pytest.mark.parametrize("owned", ["[[1,2],[3,4]]", "[[1,4],[2,3]]"])
@pytest.mark.parametrize(
    ("standard", "rate_mbps", "loss_1m_db"), [("802.11a", 6.0, 46.7), ("802.11b", 11.0, 40.2)]
)
@pytest.mark.parametrize(("above_db", "arrives"), [(-0.1, True), (0.1, False)])
def test_power_falls_with_the_distance_of_the_radios_in_flight(
    owned: str, standard: str, rate_mbps: float, loss_1m_db: float, above_db: float, arrives: bool
) -> None:
    """A plan is weak if its power is below the sensitivity; the radio of an agent is on its first UAV.

    Log-distance path loss; docs/record/radio.md.
    """
    run = setup(ticks(TICKS), f"agents.owned={owned}")
    x = run.initial_state().reshape(-1, 12).copy()
    x[1:, :3] = LEANING
    first, second = (run.run.positions_I(x.ravel())[group[0]] for group in run.owned)
    section = RadioSection(standard=standard, rate_mbps=rate_mbps, path_loss_exponent=3.5)  # type: ignore[arg-type]

    distance_m = float(np.linalg.norm(first - second))
    power_dbm = 10.0 * np.log10(section.power_mw) - loss_1m_db - 35.0 * np.log10(distance_m)
    section = section.model_copy(update={"sensitivity_dbm": float(power_dbm) + above_db})
    radio = TeamRadio(run.run, section)
    radio.send(plan(run, 1, 0), (1, 2))
    ((_, arrival),) = radio.advance(1, x.ravel())["arrivals"]
    assert arrival > 0.0 if arrives else arrival == -float(FrameResult.WEAK)


def test_the_channel_has_the_settings_of_the_section() -> None:
    """Each key of `[radio]` is that of the model, in mW, ratios and nanoseconds."""
    section = RadioSection(
        standard="802.11b",
        rate_mbps=2.0,
        delivery="unicast",
        attempts=3,
        queue_length=5,
        power_mw=20.0,
        path_loss_exponent=2.5,
        path_loss_1m_db=50.0,
        shadowing_db=4.0,
        noise_figure_db=9.0,
        sensitivity_dbm=-70.0,
        carrier_sense_dbm=-75.0,
        capture_db=6.0,
        computation_mean_s=0.004,
        computation_deviation_s=0.002,
    )
    assert channel_parameters(section, 8) == ChannelParameters(
        standard=DSSS,
        rate_mbps=2.0,
        unicast=True,
        queue_length=5,
        attempts=3,
        noise_mw=noise_mw(22e6, 9.0),
        sensitivity_mw=10.0**-7.0,
        carrier_sense_mw=10.0**-7.5,
        preamble_ratio=10.0**0.6,
        seed=8,
    )
    assert propagation_of(section, 8) == Propagation(
        power_mw=20.0, exponent=2.5, reference_loss_db=50.0, shadowing_db=4.0, seed=8
    )
    run = setup("seed=8")
    sends = send_times(run.run, section, PlanShape.of(run.run))
    assert (sends.computation_mean_ns, sends.computation_deviation_ns) == (4_000_000, 2_000_000)
    assert (sends.period_ns, sends.stations, sends.seed) == (50_000_000, AGENTS, 8)


def test_a_slot_holds_the_frames_of_all_receivers() -> None:
    """Unicast takes a frame and an acknowledgement for each of the other agents."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, "radio={delivery='unicast'}")
    slots = slot_lengths(run.run, PlanShape.of(run.run))
    assert slots is not None
    lengths = frame_lengths(slots.plan_bytes)
    needed_ns = occupied_ns(lengths, OFDM, RadioSection().rate_mbps, receivers=AGENTS - 1)
    assert slots.plan_s == needed_ns / NS_PER_S


def test_negotiated_plans_take_no_turns() -> None:
    """Each exchange has the slots of all agents, also where they are too short."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, SLOW, "controller.negotiation_iterations=2")
    slots = slot_lengths(run.run, PlanShape.of(run.run))
    assert slots is not None
    assert (slots.cycle_ticks, slots.slots, slots.are_enough) == (1, AGENTS, False)


def test_a_plan_in_several_frames_is_lost_for_the_first_reason() -> None:
    """Its second frame finds the queue full before its first one collides."""
    lost = (
        "radio={offsets='none',computation_deviation_s=0.0,queue_length=1}",
        "agents.owned=[[1,2],[3,4]]",
        "controller.horizon=40",
    )
    arrivals = np.vstack([one.arrivals for one in reports_of(*lost)])
    assert set(arrivals[arrivals != UNREPORTED]) == {-float(FrameResult.QUEUE)}


def test_a_plan_that_waits_is_sent_in_the_longer_slot() -> None:
    """Slots that grow for the numbers of a class move the turn of a plan that waits for it."""
    run = setup(ticks(TICKS), *CLOSED_LOOP, SLOW)
    section = run.scenario.radio
    assert section is not None
    radio = TeamRadio(run.run, section)
    radio.send(plan(run, AGENTS, 0), ALL)
    longer = replace(plan(run, 1, 1), data=np.zeros(512))
    radio.fit_slots([longer])

    sends = send_times(run.run, section, PlanShape.of(run.run).holding([longer]))
    before = send_times(run.run, section, PlanShape.of(run.run))
    sent_ns = sends.instant_ns(AGENTS - 1, 0)
    assert sent_ns > before.instant_ns(AGENTS - 1, 0)
    reports = [radio.advance(tick, run.initial_state()) for tick in range(1, sends.cycle + 1)]
    assert [sent_s for one in reports for sent_s in one["sent"]] == [sent_ns / NS_PER_S]
