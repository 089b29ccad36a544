"""The path that one agent follows, with a planner that only notes what it is given."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.agent.planning.test_sight import ALONG_M, row
from tests.support.runs import measurement, plan, ready, setup
from tests.transport.flights.test_obstacles_seen import GO, wall
from transport.agent.planning.followed_path import FollowedPath
from transport.agent.received import Received
from transport.model.arrays import Array
from transport.model.physics.obstacles import Obstacle
from transport.protocol.admission.targets_in_plans import carried_by
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Note, Plan, Target
from transport.protocol.wire.outbox import Outbox

SHORT_HORIZON = "controller.horizon=5"
ALL = frozenset({1, 2, 3, 4})
HERE_SINCE = dict.fromkeys(ALL, 0)
TOLD_TICK = 20
AWAY_M = 0.4
FROM_M = 1e-9  # of a payload at rest: rounding


class Noting:
    """A planner that notes the runs that it is to follow."""

    share_alone = 0.0

    def __init__(self) -> None:
        self.followed: list[TeamRun] = []
        self.seen: list[tuple[Obstacle, ...]] = []
        self.announced = 0

    def follow(self, run: TeamRun) -> None:
        """Note a run."""
        self.followed.append(run)

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Note obstacles."""
        self.seen.append(seen)

    def announce(self) -> None:
        """Count."""
        self.announced += 1


def path_of(run: Setup, agent: int) -> tuple[FollowedPath, Noting]:
    """Return the path of an agent, and its planner."""
    planner: Any = Noting()
    return FollowedPath(run.run, agent, planner), planner


def target(*to: int, x: float = AWAY_M, **changes: Any) -> Target:
    """Return a target of tick 20 that some agents, or all, are told."""
    fields: dict[str, Any] = {
        "sender": "coordinator",
        "incarnation": 0,
        "sequence": 0,
        "tick": TOLD_TICK,
        "number": 1,
        "points": np.array([[x, 0.0, -10.0]]),
        "times": np.zeros(1),
        "approach_s": 5.0,
        "approach_ramp_s": 2.0,
        "way_s": 0.0,
        "way_ramp_s": 0.0,
        "to": to,
    }
    return Target(**{**fields, **changes})


def received(run: Setup, agent: int, k: int, *plans: Plan) -> Received:
    """Return what an agent has at tick k."""
    own = measurement(run, agent, k)
    return Received(
        measurement=own,
        measurements=[own],
        plans=plans,
        lost=0,
        measurements_lost=0,
        agents=ALL,
        off=frozenset(),
        released=frozenset(),
        failed_since=-1,
        ticks_since_start=k,
        started_ns=0,
    )


def begin(path: FollowedPath, run: Setup, agent: int, k: int, *plans: Plan) -> Sequence[Any]:
    """Begin tick k and return the notes."""
    return path.begin(received(run, agent, k, *plans), HERE_SINCE, Outbox(f"agent{agent}", 0))


def end_m(planner: Noting) -> float:
    """Return where the newest path ends, x, m."""
    maneuver = planner.followed[-1].maneuver
    return float(maneuver.path(np.array([maneuver.duration_s]))[0][0][0])


def carrying(run: Setup, sender: int, k: int, *targets: Target) -> Plan:
    """Return a plan that carries targets."""
    return replace(plan(run, sender, k), targets=tuple(map(encode, targets)))


@pytest.fixture
def run() -> Setup:
    """Return a team in hover for 15 s."""
    hover = "maneuver.phase=[{name='hover',duration_s=15,displacement_m=[0,0,0]}]"
    return setup(SHORT_HORIZON, hover)


@pytest.mark.parametrize("to", [(), (1,)], ids=["all", "this one"])
def test_a_target_that_the_agent_is_told_begins_at_its_tick(
    run: Setup, to: tuple[int, ...]
) -> None:
    """Not a tick before; the path ends at it, and is as before until it begins."""
    path, planner = path_of(run, 1)
    path.tell(target(*to))
    begin(path, run, 1, TOLD_TICK - 1)
    assert planner.followed == []
    assert begin(path, run, 1, TOLD_TICK) == []
    assert end_m(planner) == pytest.approx(AWAY_M)
    before_s = np.array([TOLD_TICK * run.settings.sampling_period_s])
    x_m = planner.followed[-1].maneuver.path(before_s)[0][0][0]
    assert abs(x_m - run.maneuver.path(before_s)[0][0][0]) < FROM_M


def test_a_target_that_others_are_told_is_followed_once_a_plan_carries_it(run: Setup) -> None:
    """It is not known from the coordinator; heard late, it leads where it does for those who were told."""
    told, planner_told = path_of(run, 2)
    told.tell(target(2))
    begin(told, run, 2, TOLD_TICK)

    path, planner = path_of(run, 1)
    path.tell(target(2))
    begin(path, run, 1, TOLD_TICK)
    assert planner.followed == []
    late = TOLD_TICK + 7
    begin(path, run, 1, late, carrying(run, 2, late - 1, target(2)))
    instants_s = run.settings.sampling_period_s * np.arange(late, late + 60.0)
    np.testing.assert_array_equal(
        planner.followed[-1].maneuver.path(instants_s)[0],
        planner_told.followed[-1].maneuver.path(instants_s)[0],
    )
    # Repeated by the next plan it changes nothing.
    begin(path, run, 1, late + 1, carrying(run, 2, late, target(2)))
    assert len(planner.followed) == 1


@pytest.mark.parametrize(
    ("heard", "reason"),
    [
        (target(1, 2), "expected one told to agent1"),
        (target(2, x=1e4), "expected a target within reach"),
    ],
    ids=["not told to it", "out of reach"],
)
def test_a_target_that_cannot_be_is_refused_with_one_note(
    run: Setup, heard: Target, reason: str
) -> None:
    """One note for each sender, however many of its plans carry it; the path stays."""
    path, planner = path_of(run, 1)
    notes = [
        note
        for k in (TOLD_TICK + 1, TOLD_TICK + 2)
        for note in begin(path, run, 1, k, carrying(run, 2, k - 1, heard))
    ]
    (note,) = notes
    assert isinstance(note, Note)
    assert reason in note.problem
    assert "in a plan of agent2" in note.problem
    assert planner.followed == []


def test_a_plan_carries_what_some_were_told_and_a_proposal_does_not(run: Setup) -> None:
    """The plan of a tick has the target until it is reached; a proposal of a negotiation never."""
    path, _ = path_of(run, 1)
    path.tell(target(1))
    begin(path, run, 1, TOLD_TICK)
    made = plan(run, 1, TOLD_TICK)
    proposal = replace(made, negotiation=1)
    told, proposed = path.with_targets([made, proposal], TOLD_TICK)
    assert isinstance(told, Plan)
    assert [(one.tick, one.to) for one in carried_by(told)] == [(TOLD_TICK, (1,))]
    assert proposed is proposal


def test_a_confirmed_target_waits_until_all_on_the_roster_have_it(run: Setup) -> None:
    """Agents 2 to 4 got it at ticks 21, 22 and 23: it begins at the tick at which the last is heard of."""
    confirmed = setup(SHORT_HORIZON, "controller.targets=confirmed")
    path, planner = path_of(confirmed, 1)
    path.tell(target(1))
    begin(path, confirmed, 1, TOLD_TICK)
    assert planner.announced == 1
    for got in (1, 2, 3):
        k = TOLD_TICK + got + 1
        assert planner.followed == []
        others = tuple(range(2, 2 + got))
        ticks = tuple(TOLD_TICK + one - 1 for one in others)
        heard = target(1, informed=(1, *others), got=(TOLD_TICK, *ticks))
        begin(path, confirmed, 1, k, carrying(confirmed, others[-1], k - 1, heard))
    assert len(planner.followed) == 1
    (told,) = path.with_targets([plan(confirmed, 1, k)], k)
    assert isinstance(told, Plan)
    assert [one.begins for one in carried_by(told)] == [TOLD_TICK + 4]


STOPS = (
    *("controller.prediction=closed_loop", "controller.silence=stop", SHORT_HORIZON),
    "maneuver.phase=[{name='way',duration_s=15,displacement_m=[6,0,0]}]",
)


def places_m(run: Setup | TeamRun, first: int, count: int = 40) -> Array:
    """Return where the payload is to be at ticks from one on, x, m."""
    times_s = run.settings.sampling_period_s * np.arange(first, first + float(count))
    return np.asarray(run.maneuver.path(times_s)[0][:, 0])


@pytest.mark.parametrize(("share_alone", "stops"), [(0.5, False), (0.6, True)])
def test_an_agent_that_is_mostly_alone_stops_its_path(*, share_alone: float, stops: bool) -> None:
    """It goes on as long after, and its plans tell by how much it is behind, also without any target."""
    slow = setup(*STOPS)
    path, planner = path_of(slow, 1)
    begin(path, slow, 1, 0)
    planner.share_alone = share_alone
    begin(path, slow, 1, 100)
    assert len(planner.followed) == int(stops)
    planner.share_alone = 0.0
    begin(path, slow, 1, 145)
    made = plan(slow, 1, 145)
    (told,) = path.with_targets([made], 145)
    assert isinstance(told, Plan)
    assert told.lag == (45 if stops else 0)
    if stops:
        after = 200
        found_m = places_m(planner.followed[-1], after + 45)
        np.testing.assert_allclose(found_m, places_m(slow, after), atol=1e-6)
    else:
        assert planner.followed == []
        assert told is made


def test_an_agent_that_returns_is_where_the_others_are() -> None:
    """Behind at once, as its UAVs have not flown by its own path; one that was there falls back slowly."""
    slow = setup(*STOPS)
    for returns in (False, True):
        path, planner = path_of(slow, 1)
        begin(path, slow, 1, 0)
        if returns:
            path.return_to_roster(100)
        heard = replace(plan(slow, 2, 99), lag=12)
        begin(path, slow, 1, 100, heard)
        is_there = np.allclose(places_m(planner.followed[-1], 100), places_m(slow, 88), atol=1e-6)
        assert is_there is returns
        found_m = places_m(planner.followed[-1], 160)
        np.testing.assert_allclose(found_m, places_m(slow, 148), atol=1e-6)


def got_by(path: FollowedPath, run: Setup, k: int) -> dict[int, dict[int, int]]:
    """Return by number of each target that waits, which agents got it at which ticks."""
    (told,) = path.with_targets([plan(run, 1, k)], k)
    assert isinstance(told, Plan)
    return {
        one.number: dict(zip(one.informed, one.got, strict=True))
        for one in carried_by(told)
        if not one.begins
    }


def test_targets_wait_by_what_is_known_of_the_others() -> None:
    """New agents are announced once, a target all are told begins at once, and older ones are forgotten with it."""
    confirmed = setup(SHORT_HORIZON, "controller.targets=confirmed")
    path, planner = path_of(confirmed, 1)
    first, later = target(1), target(2, number=2, informed=(2,), got=(TOLD_TICK,))
    path.tell(first)
    begin(path, confirmed, 1, TOLD_TICK)
    assert (planner.announced, planner.followed) == (1, [])
    heard = [
        replace(first, informed=(2,), got=(TOLD_TICK,)),
        later,
    ]
    for k in (TOLD_TICK + 1, TOLD_TICK + 2):
        begin(path, confirmed, 1, k, carrying(confirmed, 2, k - 1, *heard))
        assert planner.announced == 3
    own, others = {1: TOLD_TICK}, {2: TOLD_TICK}
    expected = {1: own | others, 2: {1: TOLD_TICK + 1} | others}
    assert got_by(path, confirmed, TOLD_TICK + 2) == expected
    path.return_to_roster(30)
    assert got_by(path, confirmed, 30) == {1: {1: 30} | others, 2: {1: 30} | others}

    # Another agent knows that all have the newer one.
    begun = replace(later, begins=31)
    begin(path, confirmed, 1, 32, carrying(confirmed, 3, 31, begun))
    assert (len(planner.followed), got_by(path, confirmed, 32)) == (1, {})
    begin(path, confirmed, 1, 33, carrying(confirmed, 2, 32, *heard))
    assert (planner.announced, got_by(path, confirmed, 33)) == (3, {})

    for_all, planner = path_of(confirmed, 1)
    for_all.tell(target())
    begin(for_all, confirmed, 1, TOLD_TICK + 1)
    assert (len(planner.followed), planner.announced) == (1, 0)


@pytest.mark.parametrize("since", [TOLD_TICK, TOLD_TICK + 1])
def test_an_agent_that_was_not_there_can_be_told_by_plans(run: Setup, since: int) -> None:
    """From its first tick on it would have been told itself."""
    path, planner = path_of(run, 1)
    k = TOLD_TICK + 5
    heard = received(run, 1, k, carrying(run, 2, k - 1, target(1, 2)))
    notes = path.begin(heard, {**HERE_SINCE, 1: since}, Outbox("agent1", 0))
    assert bool(notes) is (since == TOLD_TICK)
    assert len(planner.followed) == 1 - len(notes)


def seeing(path: FollowedPath, run: Setup, k: int, *plans: Plan) -> list[str]:
    """Begin a tick at which the wall is seen, and return the texts of the notes."""
    at_tick = received(run, 1, k, *plans)
    own = replace(at_tick.measurement, seen=np.array([row()]))
    notes = path.begin(replace(at_tick, measurement=own), HERE_SINCE, Outbox("agent1", 0))
    return [note.problem for note in notes if isinstance(note, Note)]


def test_each_path_is_compared_once_with_what_is_seen() -> None:
    """A target keeps clear of it at once; the next one, that leads through it, is answered by another."""
    run = ready("precise", GO % 1, wall(ALONG_M, 2.0))
    path, planner = path_of(run, 1)
    stops = "sees obstacle 1, no way round it in time: stops before it"
    assert seeing(path, run, 50) == [stops]
    assert [len(seen) for seen in planner.seen] == [1]
    made = planner.followed[-1].maneuver.targets[-1]
    assert made.brakes
    assert made.since_s == pytest.approx(2.5)
    assert seeing(path, run, 51) == []
    (told,) = path.with_targets([plan(run, 1, 51)], 51)
    assert isinstance(told, Plan)
    assert [(one.to, one.brakes) for one in carried_by(told)] == [((1,), True)]

    through = np.array([[9.6, 7.2, -10.0]])
    path.tell(target(tick=60, points=through, number=2))
    assert seeing(path, run, 60) == [stops]
    assert seeing(path, run, 61) == []
    assert (len(planner.seen), len(planner.followed)) == (1, 3)


def test_a_rest_before_an_obstacle_does_not_wait_for_the_others() -> None:
    """The agent brakes at once, and its target begins when all have it, at their progress then."""
    run = ready("precise", GO % 1, wall(ALONG_M, 2.0), "controller.targets=confirmed")
    path, planner = path_of(run, 1)
    seeing(path, run, 50)
    assert planner.announced == len(planner.followed) == 1
    (told,) = path.with_targets([plan(run, 1, 50)], 50)
    assert isinstance(told, Plan)
    (made,) = carried_by(told)
    assert (made.informed, made.got, made.begins) == ((1,), (50,), 0)
    have = replace(made, informed=(1, 2, 3, 4), got=(50, 51, 52, 52))
    assert seeing(path, run, 53, carrying(run, 4, 52, have)) == []
    (told,) = path.with_targets([plan(run, 1, 53)], 53)
    assert isinstance(told, Plan)
    (begun,) = carried_by(told)
    progress_s = planner.followed[0].maneuver.progress(53 * run.settings.sampling_period_s)
    assert begun.begins == math.ceil(progress_s / run.settings.sampling_period_s - 1e-6)
