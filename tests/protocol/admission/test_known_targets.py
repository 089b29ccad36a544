"""Targets told to some agents spread over random networks, through deaths and new starts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support import runs
from transport.model.path.target_and_stop import Slowing
from transport.protocol.admission import known_targets
from transport.protocol.admission.known_targets import KnownTargets
from transport.protocol.admission.targets_in_plans import place_of
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.codec import decode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Target
from transport.protocol.wire.outbox import Outbox

HOVER = "maneuver.phase=[{name='hover',duration_s=20,displacement_m=[0,0,0]}]"
RUN = runs.ready("resilient", HOVER)
M = 8
FIRST, SECOND, END = 20, 40, 200  # ticks


def message(run: Setup, tick: int, number: int, place: Sequence[float]) -> Target:
    """Return the coordinator's message for a target."""
    section = requested(TargetSection, {"points_m": [[*place]], "to": [1]})
    fields = target_fields(run, section, tick)
    return Outbox("coordinator", 0).stamp(Target, number=number, **fields)


def three() -> list[Target]:
    """Return a target, and two later ones of one tick."""
    targets: list[Target] = []
    run = RUN
    for tick, place in ((FIRST, (1, 0, -10)), (SECOND, (0, 1, -10)), (SECOND, (1, 1, -11))):
        targets.append(message(run, tick, len(targets) + 1, place))
        run = run.after([targets[-1]])
    return targets


class Team:
    """Agents that send what they carry at every tick, over links with a delay, ticks, and losses."""

    def __init__(self, passes: np.ndarray, delay: int, rng: np.random.Generator) -> None:
        self._passes = passes  # probability by sender and receiver, (M, M)
        self._delay = delay
        self._rng = rng
        self.agents = {agent: KnownTargets(RUN.run) for agent in range(1, M + 1)}

    def run(
        self,
        told: Mapping[int, Sequence[tuple[int, Target]]],
        deaths: Mapping[int, int],
        starts: Mapping[int, int],
    ) -> None:
        """Run until `END`; agents are told targets by tick, die, or start anew, by agent, at a tick."""
        sent: dict[int, list[tuple[int, tuple[bytes, ...]]]] = {}
        for tick in range(FIRST, END):
            for agent in [agent for agent in self.agents if deaths.get(agent) == tick]:
                del self.agents[agent]
            for agent in self.agents:
                if starts.get(agent) == tick:
                    self.agents[agent] = KnownTargets(RUN.run)
            for agent, target in told.get(tick, ()):
                if agent in self.agents:
                    self.agents[agent].add(msgspec.structs.replace(target, to=(agent,)))
            for sender, carried in sent.get(tick - self._delay, ()):
                for receiver, known in self.agents.items():
                    if self._rng.random() < self._passes[sender - 1, receiver - 1]:
                        for data in carried:
                            heard: Any = decode(data)
                            known.add(heard)
            sent[tick] = [(agent, known.carried(tick)) for agent, known in self.agents.items()]


def test_all_end_at_the_newest_target_that_one_of_them_knows() -> None:
    """Two agents are told other targets at one tick, three die, two start anew: those left have one path.

    A target is lost only with all agents that have heard of it.
    """
    rng = np.random.default_rng(68)
    targets = three()
    newest = set()
    for _ in range(25):
        shuffled = [int(agent) for agent in rng.permutation(M) + 1]
        dead, again, left = shuffled[:3], shuffled[3:5], np.array(shuffled[3:]) - 1
        first, second, third = (int(agent) for agent in rng.integers(1, M + 1, 3))
        passes = rng.uniform(0.1, 1.0, (M, M)) * (rng.random((M, M)) < 0.4)
        # Those left form a ring, so that each hears of what any of them knows.
        passes[left, np.roll(left, 1)] = 0.5

        team = Team(passes, int(rng.integers(1, 6)), rng)
        team.run(
            told={
                FIRST: [(first, targets[0])],
                SECOND: [(second, targets[1]), (third, targets[2])],
            },
            deaths={agent: int(rng.integers(FIRST, 60)) for agent in dead},
            starts={agent: int(rng.integers(FIRST, 80)) for agent in again},
        )
        places = {known.newest for known in team.agents.values()}
        assert len(places) == 1
        newest |= places
        paths = [known.setup.X_ref[END:] for known in team.agents.values()]
        assert all((path == paths[0]).all() for path in paths)
    # The third target, mostly; others where all that knew it are gone.
    assert max(newest) == place_of(targets[2])
    assert len(newest) > 1


def path_of(*known_in_order: Target | Slowing) -> np.ndarray:
    """Return the path of an agent that has heard of targets, and lost time, in an order."""
    known = KnownTargets(RUN.run)
    for one in known_in_order:
        if isinstance(one, Slowing):
            known.slow(one)
        else:
            known.add(one)
    return known.setup.X_ref


SLOWING = Slowing(since_s=3.0, ramp_s=1.0, lost_s=0.5)


def test_the_order_in_which_targets_are_heard_of_does_not_matter() -> None:
    """The path is that of the coordinator, which tells them one by one; time is lost along all of it."""
    told = three()
    np.testing.assert_array_equal(path_of(*told), RUN.run.after(told).X_ref)
    slowed = path_of(*told, SLOWING)
    assert (slowed != path_of(*told)).any()
    for order in (told[::-1], [told[1], told[2], told[0]]):
        np.testing.assert_array_equal(path_of(*order), path_of(*told))
        np.testing.assert_array_equal(path_of(order[0], SLOWING, *order[1:]), slowed)


def test_a_loss_of_time_that_began_at_the_same_time_is_replaced() -> None:
    """It is the same stop, whose length is known better."""
    longer = replace(SLOWING, lost_s=1.0)
    later = replace(SLOWING, since_s=4.0)
    told = three()
    np.testing.assert_array_equal(path_of(*told, SLOWING, longer), path_of(*told, longer))
    assert (path_of(*told, SLOWING, later) != path_of(*told, later)).any()


def test_a_target_is_known_from_its_first_tick_on() -> None:
    """Of two first ticks the earlier one counts; before all targets is their place where none is known."""
    known = KnownTargets(RUN.run)
    assert known.newest == (-1, 0)
    one = three()[0]
    waiting = msgspec.structs.replace(one, begins=FIRST + 9)
    assert known.add(waiting)
    assert (known.knows(waiting), known.knows(one)) == (True, False)
    assert known.add(one)
    assert known.knows(waiting)
    assert not known.add(waiting)
    assert known.newest == place_of(one)


def test_the_number_of_known_targets_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sender may invent any; known ones may still begin earlier."""
    monkeypatch.setattr(known_targets, "MAX_TARGETS", 2)
    first, second, third = three()
    known = KnownTargets(RUN.run)
    assert known.add(first)
    assert known.add(msgspec.structs.replace(second, begins=SECOND + 9))
    assert not known.add(third)
    assert known.add(second)


@pytest.mark.parametrize(("distance_m", "is_refused"), [(199.0, False), (201.0, True)])
def test_a_target_is_within_reach(distance_m: float, is_refused: bool) -> None:
    """At 100 m/s at most in the time of its approach, less one ramp."""
    target = msgspec.structs.replace(
        three()[0],
        points=np.array([[0.0, 0.0, -10.0 - distance_m]]),
        approach_s=5.0,
        approach_ramp_s=3.0,
    )
    if not is_refused:
        KnownTargets(RUN.run).check(target)
        return
    with pytest.raises(MessageError, match="within reach, got one 201 m away in 2 s"):
        KnownTargets(RUN.run).check(target)


def test_a_plan_carries_what_its_path_depends_on() -> None:
    """Those before a target until it is reached; told to some, and followed; at most the newest eight."""
    first, second, third = three()
    known = KnownTargets(RUN.run)
    told = msgspec.structs.replace(first, incarnation=2, sequence=9)
    for target in (told, second):
        known.add(target)

    def numbers(tick: int, *unconfirmed: Target) -> list[int]:
        carried: list[Any] = [decode(data) for data in known.carried(tick, unconfirmed)]
        assert {(one.incarnation, one.sequence) for one in carried} <= {(0, 0)}
        return [one.number for one in carried]

    period_s = RUN.settings.sampling_period_s
    reached = SECOND + math.ceil(second.approach_s / period_s - 1e-9)
    assert numbers(SECOND) == numbers(reached - 1) == [1, 2]
    assert numbers(reached) == [2]
    waiting = [msgspec.structs.replace(third, number=number) for number in range(3, 13)]
    assert numbers(reached, *waiting) == [*range(5, 13)]

    for_all = KnownTargets(RUN.run)
    for_all.add(msgspec.structs.replace(first, to=()))
    assert for_all.carried(SECOND) == ()
