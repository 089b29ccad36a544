"""Targets told to some agents spread over random networks, through deaths and new starts."""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from tests.support import runs
from transport.protocol.admission.known_targets import KnownTargets
from transport.protocol.admission.targets_in_plans import place_of
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.codec import decode
from transport.protocol.wire.messages import Target
from transport.protocol.wire.node_interface import Outbox

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
