"""Targets told to some agents travel with plans (docs/reference/protocol.md, "Targets told to some")."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support import logs, runs
from tests.support.nodes import AgentNode, refused
from transport.agent.communication.target_confirmation import Unconfirmed
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.replay.replay_difference import Comparison
from transport.analysis.replay.replay_of_agent import Replay
from transport.analysis.summary_assembly import summarise
from transport.flight.memory import simulate
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.physics.obstacles import clearances
from transport.model.state import R0
from transport.protocol.admission.known_targets import KnownTargets
from transport.protocol.admission.targets_in_plans import carried_by, check_carried, place_of
from transport.protocol.scenario.scenario_file import read_scenario, with_settings
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import (
    RequestError,
    ScenarioError,
    requested,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.scenario.teams.team_of_any_size import Team, given_values, resized
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Message, Note, Plan, PlantState, Target
from transport.protocol.wire.outbox import Outbox

HOVER = "maneuver.phase=[{name='hover',duration_s=%g,displacement_m=[0,0,0]}]"
TOLD_S, TOLD_TICK = 1.0, 20
TO_FIRST = ",to=[1]"
AWAY_M = 1e-3  # less is no difference between two motions
REACHED_M = 0.05
SETTLED_M = 0.2  # some seconds after a longer way, with delay and loss


def to(*agents: int, at_s: float = TOLD_S, x: float = 0.4) -> str:
    """Return a target that some agents are told, as an entry of a list."""
    return f"{{at_s={at_s},points_m=[[{x},0,-10]],to={list(agents)}}}"


def targets(*entries: str) -> str:
    """Return the setting of targets."""
    return f"maneuver.target=[{','.join(entries)}]"


def far(count: int, told: str) -> str:
    """Return the setting of the first of three targets 2 to 4 m apart."""
    places = ((1, "2,0,-10"), (4, "2,3,-10"), (7, "-1,2,-11"))[:count]
    return targets(*(f"{{at_s={at_s},points_m=[[{place}]]{told}}}" for at_s, place in places))


def cut(*links: tuple[int, int], delay_s: float) -> str:
    """Return the setting of links between four agents of which only some pass messages, late."""
    passing = {*links, *((b, a) for a, b in links)}
    every = [(a, b) for a in range(1, 5) for b in range(1, 5) if a != b]
    overrides = [
        f"{{from='agent{a}',to='agent{b}',{f'delay_s={delay_s}' if (a, b) in passing else 'loss=1.0'}}}"
        for a, b in every
    ]
    return f"links.override=[{','.join(overrides)}]"


@lru_cache
def flown(name: str, *settings: str) -> RunLog:
    """Return the log of a run in memory."""
    return logs.log_of(runs.recorded(runs.ready(name, *settings)))


def first_carried(log: RunLog) -> dict[int, int]:
    """Return the tick of the first plan of each agent that carries a target."""
    first: dict[int, int] = {}
    for plan in log.of(Plan):
        if plan.targets:
            first.setdefault(plan.agent, plan.tick)
    return first


def last_carried(log: RunLog) -> dict[int, list[tuple[int, int]]]:
    """Return tick and number of the targets in the last plan of each agent."""
    return {plan.agent: [place_of(one) for one in carried_by(plan)] for plan in log.of(Plan)}


def positions(log: RunLog) -> Array:
    """Return the positions of the payload, (K, 3), m."""
    return np.array([one.x[R0] for one in log.of(PlantState)])


CHAIN = (1, 2), (2, 3), (3, 4)
STAR = (1, 2), (2, 3), (2, 4)


@pytest.mark.parametrize(
    ("links", "hops", "ticks"),
    [(CHAIN, (0, 1, 2, 3), 1), (CHAIN, (0, 1, 2, 3), 3), (STAR, (0, 1, 2, 2), 10)],
    ids=["chain-1", "chain-3", "star-10"],
)
def test_the_time_until_all_know_is_hops_times_delay(
    links: Sequence[tuple[int, int]], hops: Sequence[int], ticks: int
) -> None:
    """To a tick, also on links of which most are cut: a plan is used a delay after it was sent."""
    cuts = cut(*links, delay_s=0.05 * ticks)
    log = flown("resilient", HOVER % 7, targets(to(1)), cuts)
    expected = {agent: TOLD_TICK + ticks * hop for agent, hop in enumerate(hops, start=1)}
    assert first_carried(log) == expected
    run = runs.ready("resilient", HOVER % 7, targets(to(1)), cuts)
    (target,) = summarise(AnalysedRun.of(run, log))["targets"]
    assert target["known_s"] == pytest.approx(0.05 * ticks * max(hops))


@pytest.mark.slow
def test_eight_follow_a_target_that_one_is_told_and_go_round_a_wall() -> None:
    """On a network with delay and loss: all know it within a second, and it is reached, past what two of them see."""
    path = runs.SCENARIOS / "resilient.toml"
    team = resized(read_scenario(path), Team(uavs=8, group=1), path.name)
    wall = "obstacle=[{kind='box',at_m=[1.6,-1.5,-10],size_m=[0.2,1.5,8],margin_m=0.3,seen_within_m=1.2}]"
    changes = HOVER % 18, targets(to(8, x=4.0)), wall, "links.delay_s=0.1", "links.loss=0.2"
    scenario = with_settings(given_values(team), changes, path.name)
    run = Setup.of(scenario, path.name)
    log = logs.log_of(runs.recorded(run))
    first = first_carried(log)
    assert first.keys() == set(range(1, 9))
    assert first[8] == TOLD_TICK
    assert max(first.values()) < TOLD_TICK + 20
    x = np.array([one.x for one in log.of(PlantState)])
    uavs_m = clearances(run.system, run.obstacles[0], x)[:, :8]
    assert uavs_m.min() > 0.3
    swing = positions(log)[-40:].mean(axis=0)
    assert np.linalg.norm(swing - [4.0, 0.0, -10.0]) < SETTLED_M


CONFIRMED = "controller.targets=confirmed"


def first_followed(log: RunLog) -> dict[int, tuple[int, int]]:
    """Return by agent the tick of the first plan that says it follows a target, and the target's first tick."""
    first: dict[int, tuple[int, int]] = {}
    for plan in log.of(Plan):
        for target in carried_by(plan):
            if target.begins:
                first.setdefault(plan.agent, (plan.tick, target.begins))
    return first


def test_confirmed_targets_begin_together_on_a_chain() -> None:
    """From the tick at which the last one has it, as soon as that is known; the payload arrives."""
    log = flown("resilient", HOVER % 8, targets(to(1)), cut(*CHAIN, delay_s=0.1), CONFIRMED)
    begins = TOLD_TICK + 3 * 2
    expected = {agent: (begins + 2 * (4 - agent), begins) for agent in range(1, 5)}
    assert first_followed(log) == expected
    assert abs(positions(log)[-1][0] - 0.4) < REACHED_M


def test_confirmed_targets_wait_for_an_agent_that_cannot_hear_or_is_off_the_roster() -> None:
    """Cut off, the path before goes on for all; the target begins once the agent is back, or gone."""
    alone = "links.partition=[{between=['agent4'],start_s=0.5,end_s=%g}]"
    log = flown("resilient", HOVER % 9, targets(to(1)), alone % 20, CONFIRMED)
    assert first_followed(log) == {}
    assert first_carried(log).keys() == {1, 2, 3}
    run = runs.ready("resilient", HOVER % 9, targets(to(1)), alone % 20, CONFIRMED)
    assert [one["known_s"] for one in summarise(AnalysedRun.of(run, log))["targets"]] == [None]
    assert np.abs(positions(log)[:, 0]).max() < 0.1

    log = flown("resilient", HOVER % 9, targets(to(1)), alone % 3, CONFIRMED)
    assert {begins for _, begins in first_followed(log).values()} == {61}
    assert len(first_followed(log)) == 4

    death = "faults.event=[{at_s=3.0,do='kill',target='agent4'}]"
    settings = (alone % 20, death, "clock.on_agent_loss='continue'", CONFIRMED)
    log = flown("resilient", HOVER % 9, targets(to(1)), *settings)
    assert first_followed(log).keys() == {1, 2, 3}
    # The agents on the roster had it long before, and begin once they know that these are all.
    assert {begins for _, begins in first_followed(log).values()} == {61}


def starts(log: RunLog) -> dict[tuple[int, int], dict[int, int]]:
    """Return by target and agent the tick of the first plan that says it follows the target."""
    first: dict[tuple[int, int], dict[int, int]] = {}
    for plan in log.of(Plan):
        for target in carried_by(plan):
            if target.begins:
                first.setdefault(place_of(target), {}).setdefault(plan.agent, plan.tick)
    return first


@pytest.mark.slow
def test_a_collision_at_heavy_loss_comes_from_starts_that_are_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A run with 90 % loss in which UAVs touch: agents begin a motion more than a second apart.

    With the same draws, and each motion begun everywhere at the tick of the last agent, UAVs keep their distance.
    """
    settings = (far(2, TO_FIRST), "links.loss=0.9", CONFIRMED, "seed=4")
    run = runs.ready("precise", HOVER % 14, *settings)
    messages: list[Message] = []
    assert simulate(run, messages.append).outcome == "collided"
    log = logs.log_of(messages)
    begun = starts(log)
    longest = max(max(ticks.values()) - min(ticks.values()) for ticks in begun.values())
    assert 0.05 * longest == pytest.approx(1.15)

    last = {place: max(ticks.values()) for place, ticks in begun.items()}

    def confirmed(self: Unconfirmed, tick: int, *_: object) -> list[Target]:
        due = [place for place in last if self.has(place) and tick >= last[place]]
        waiting = {place_of(target): target for target in self.carried()}
        for place in due:
            self.forget(place)
        return [
            msgspec.structs.replace(waiting[place], informed=(), got=(), begins=last[place])
            for place in due
        ]

    monkeypatch.setattr(Unconfirmed, "confirmed", confirmed)
    equal = logs.log_of(runs.recorded(run))
    assert {place: set(ticks.values()) for place, ticks in starts(equal).items()} == {
        place: {tick} for place, tick in last.items()
    }
    assert summarise(AnalysedRun.of(run, equal))["separation_min_m"] > 0.45


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_a_silence_while_a_target_is_confirmed_does_not_make_the_path_jump(ticks: int) -> None:
    """All have it a tick after it was told, and know that one tick later: a silence then leaves no agent behind.

    The motion begins when the first agent knows that all have it, not when the last one got it.
    """
    from_s = TOLD_S + 0.05 * ticks
    cuts = ",".join(
        f"{{between=['agent{agent}'],start_s={from_s},end_s={from_s + 4.0}}}" for agent in (1, 2, 3)
    )
    settings = (targets(to(1, x=2.0)), f"links.partition=[{cuts}]", CONFIRMED)
    log = flown("precise", HOVER % 11, *settings)
    begins = {begins for _, begins in first_followed(log).values()}
    silent = round(from_s / 0.05)
    assert begins == ({TOLD_TICK + 2} if ticks == 2 else {silent + 80 + (2 if ticks == 0 else 1)})
    assert abs(positions(log)[-1][0] - 2.0) < REACHED_M
    to_all = flown("precise", HOVER % 11, targets(to(x=2.0)))
    largest_m, given_m = (np.abs(np.diff(positions(one)[:, 0])).max() for one in (log, to_all))
    # No faster than the target's motion; three times as fast with a jump.
    assert largest_m < 1.05 * given_m


def test_two_told_at_the_same_tick_end_at_the_same_target() -> None:
    """The one with the larger number is the newest for all."""
    log = flown("resilient", HOVER % 8, targets(to(2, x=0.4), to(4, x=-0.4)), "links.delay_s=0.1")
    last = last_carried(log)
    assert {tuple(places)[-1] for places in last.values()} == {(TOLD_TICK, 2)}
    assert len(last) == 4
    assert abs(positions(log)[-1][0] + 0.4) < REACHED_M


def test_a_target_survives_the_agent_that_was_told() -> None:
    """Another one has heard of it by one plan; the agent comes back and learns it, as a late one does."""
    events = (
        f"faults.event=[{{at_s={TOLD_S + 0.1},do='kill',target='agent2'}},"
        "{at_s=4.0,do='restart',target='agent2'}]"
    )
    settings = (targets(to(2)), events, "clock.on_agent_loss='continue'", "links.delay_s=0.1")
    log = flown("resilient", HOVER % 13, *settings)
    assert last_carried(log) == {agent: [(TOLD_TICK, 1)] for agent in range(1, 5)}
    assert abs(positions(log)[-1][0] - 0.4) < REACHED_M


@pytest.mark.parametrize(
    ("after_s", "arrives"), [(0.0, False), (0.05, True)], ids=["before", "after"]
)
def test_a_target_is_lost_only_before_its_first_plan(after_s: float, *, arrives: bool) -> None:
    """The agent that was told dies at that tick, or one later: one plan that carries it is enough."""
    death = f"faults.event=[{{at_s={TOLD_S + after_s},do='kill',target='agent2'}}]"
    settings = (targets(to(2)), death, "clock.on_agent_loss='continue'", "links.delay_s=0.1")
    log = flown("resilient", HOVER % 14, *settings)
    others = {1, 3, 4}
    assert first_carried(log).keys() - {2} == (others if arrives else set())
    # The load still swings.
    assert abs(positions(log)[-1][0] - (0.4 if arrives else 0.0)) < 0.15


def test_an_agent_that_hears_two_at_once_has_the_path_of_one_that_heard_both_in_turn() -> None:
    """Whatever was heard first: the path follows from the targets alone."""
    run = runs.ready("resilient", HOVER % 20)
    first = message(run, 20, points_m=[[1.0, 0.0, -10.0]], to=[1])
    second = message(run.after([first]), 40, number=2, points_m=[[0.0, 1.0, -10.0]], to=[1])
    paths = []
    for order in ((first, second), (second, first)):
        known = KnownTargets(run.run)
        assert all(known.add(target) for target in order)
        assert not known.add(first)
        paths.append(known.setup.X_ref)
        # Until the second is reached its path depends on the first, and plans carry both.
        assert len(known.carried(50)) == 2
        assert len(known.carried(300)) == 1
    assert (paths[0] == paths[1]).all()


def test_a_run_without_targets_for_some_has_plans_as_before() -> None:
    """Plans carry nothing, also where all agents are named."""
    for told in ((), (1, 2, 3, 4)):
        log = flown("resilient", HOVER % 7, targets(to(*told)))
        assert first_carried(log) == {}
        run = runs.ready("resilient", HOVER % 7, targets(to(*told)))
        assert [one["known_s"] for one in summarise(AnalysedRun.of(run, log))["targets"]] == [0.0]
        last = log.of(Plan)
        assert all(decode(encode(plan)) is not None and not plan.targets for plan in last)


def test_the_radio_carries_the_targets() -> None:
    """A plan is longer by the bytes of its targets."""
    log = flown("resilient", HOVER % 7, targets(to(1)))
    plan = next(plan for plan in log.of(Plan) if plan.targets)
    without = msgspec.structs.replace(plan, targets=())
    assert len(encode(plan)) - len(encode(without)) > len(plan.targets[0])


def message(run: Setup, tick: int, number: int = 1, **given: Any) -> Target:
    """Return the coordinator's message for a target."""
    fields = target_fields(run, requested(TargetSection, given), tick)
    return Outbox("coordinator", 0).stamp(Target, number=number, **fields)


RUN = runs.ready("resilient", HOVER % 20)
GOOD = message(RUN, 2, points_m=[[1.0, 0.0, -10.0], [1.0, 1.0, -10.0]], to=[3])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"points": np.array([[np.nan, 0.0, 0.0], [1.0, 1.0, 0.0]])}, "not_finite"),
        ({"points": np.array([[1e9, 0.0, 0.0], [1.0, 1.0, 0.0]])}, "out_of_range"),
        ({"points": np.zeros((2, 3))}, "out_of_range"),
        ({"points": np.zeros((300, 3)), "times": np.zeros(300)}, "wrong_shape"),
        ({"tick": 4}, "future"),
        ({"to": (7,)}, "unknown_agent"),
        ({"to": ()}, "unknown_agent"),
        ({"number": 10**6}, "out_of_range"),
        ({"approach_s": 1e9, "approach_ramp_s": 1.0}, "future"),
        ({"approach_s": -1.0}, "out_of_range"),
        ({"way_ramp_s": 0.0}, "out_of_range"),
        ({"times": np.array([0.0, 1e9])}, "out_of_range"),
        ({"sender": "agent3"}, "wrong_sender"),
        ({"begins": 2}, "wrong_shape"),
        ({"informed": (3,), "got": (2,)}, "wrong_shape"),
        ({"informed": (3,), "got": ()}, "wrong_shape"),
    ],
)
def test_a_plan_with_an_impossible_target_is_refused(changes: dict[str, Any], reason: str) -> None:
    """By every process, with the reason; a genuine one is admitted."""
    plan = runs.plan(RUN, 2, 3)
    carried = msgspec.structs.replace(GOOD, **changes)
    check_carried(msgspec.structs.replace(plan, targets=(encode(GOOD),)), RUN.rules.shape)
    with pytest.raises(MessageError) as refused:
        check_carried(msgspec.structs.replace(plan, targets=(encode(carried),)), RUN.rules.shape)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"informed": (7,), "got": (2,)}, "unknown_agent"),
        ({"informed": (3, 3), "got": (2, 2)}, "out_of_range"),
        ({"informed": (3,), "got": (4,)}, "future"),
        ({"informed": (3,), "got": (1,)}, "past"),
        ({"begins": 4}, "future"),
    ],
)
def test_a_confirmation_that_cannot_be_is_refused(changes: dict[str, Any], reason: str) -> None:
    """Of unknown agents, twice of one, or of ticks to come or before the target."""
    run = runs.ready("resilient", HOVER % 20, CONFIRMED)
    plan = runs.plan(run, 2, 3)
    carried = msgspec.structs.replace(GOOD, **changes)
    with pytest.raises(MessageError) as refused:
        check_carried(msgspec.structs.replace(plan, targets=(encode(carried),)), run.rules.shape)
    assert refused.value.reason == reason


def test_what_a_plan_carries_is_bounded() -> None:
    """Neither many targets nor long ones nor the same twice, nor bytes that are none."""
    plan = runs.plan(RUN, 2, 3)
    one = encode(GOOD)
    too_many: list[tuple[bytes, ...]] = [(one,) * 9, (b"\x07" * 20_000,)]
    for carried in too_many:
        with pytest.raises(MessageError) as refused:
            decode(encode(msgspec.structs.replace(plan, targets=carried)))
        assert refused.value.reason == "out_of_range"
    for carried in ((one, one), (b"no target",), (encode(plan),)):
        with pytest.raises(MessageError):
            check_carried(msgspec.structs.replace(plan, targets=carried), RUN.rules.shape)


def test_who_is_told_is_checked() -> None:
    """Agents of the run, of UAVs without processes of their own."""
    with pytest.raises(ScenarioError, match="expected agents 1 to 4, got 7"):
        runs.ready("resilient", HOVER % 7, targets(to(7)))
    with pytest.raises(RequestError, match="to"):
        requested(TargetSection, {"points_m": [[0, 0, -9]], "to": [0]})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({}, "has not been told"), ({"to": (1,), "points": GOOD.points + 1e5}, "within reach")],
)
def test_what_only_the_receiver_can_judge_is_noted_and_not_followed(
    changes: dict[str, Any], reason: str
) -> None:
    """A target in its own name, and one out of reach; the plan counts, and the note names the sender."""
    told = runs.setup("controller.horizon=5")
    node = AgentNode(told, 3)
    node.receive(runs.roster(), 0)
    carried = (encode(msgspec.structs.replace(GOOD, **changes)),)
    problems: list[str] = []
    for k in range(5):
        for agent in (1, 2, 4) if k else ():
            plan = runs.plan(told, agent, k - 1)
            carries = agent == 1 and k > 2
            node.receive(msgspec.structs.replace(plan, targets=carried if carries else ()), 0)
        made = node.receive(runs.measurement(told, 3, k), 0)
        problems += [note.problem for note in made if isinstance(note, Note)]
        assert [plan.targets for plan in made if isinstance(plan, Plan)] == [()]
    assert len(problems) == 1
    assert "in a plan of agent1" in problems[0]
    assert reason in problems[0]
    assert refused(node) == []


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rms_m"), [("precise", 0.1), ("resilient", 0.02)])
def test_three_targets_on_a_late_and_lossy_network(name: str, rms_m: float) -> None:
    """With 200 ms and 30 % loss the payload is where it is if all are told at once; and it replays."""
    late = (HOVER % 14, "links.delay_s=0.2", "links.loss=0.3")
    some = (far(3, TO_FIRST), *late)
    log = flown(name, *some)
    away_m = positions(log) - positions(flown(name, far(3, ""), *late))
    assert np.sqrt((away_m**2).sum(axis=1).mean()) < rms_m
    assert np.abs(away_m).max() > AWAY_M

    run = runs.ready(name, *some)
    summary = summarise(AnalysedRun.of(run, log))
    assert len(summary["targets"]) == 3
    assert summary["attitude_max_deg"] < 2.0
    again, comparison = Replay(run, log, 3), Comparison()
    for step in again.steps():
        comparison.add(step)
    assert comparison.identical == comparison.plans == 280
    assert not [note.problem for note in log.of(Note) if "target" in note.problem]
