"""The path that one agent follows, with a planner that only notes what it is given."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.runs import measurement, plan, setup
from transport.agent.planning.followed_path import FollowedPath
from transport.agent.received import Received
from transport.protocol.admission.targets_in_plans import carried_by
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Note, Plan, Target
from transport.protocol.wire.node_interface import Outbox

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
        self.announced = 0

    def follow(self, run: TeamRun) -> None:
        """Note a run."""
        self.followed.append(run)

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
