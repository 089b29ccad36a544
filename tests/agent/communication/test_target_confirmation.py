"""Targets followed once all on the roster have them: docs/equations.md, "Targets told to some"."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from tests.support.messages import sample
from transport.agent.communication.target_confirmation import Unconfirmed
from transport.protocol.wire.messages import Target

M = 4
TOLD = 5  # tick
TARGET: Target = sample(Target, tick=TOLD, number=1, to=(1,), informed=(), got=(), begins=0)


@dataclass
class Team:
    """Agents that send what they carry every tick, over links with a delay, ticks, and losses."""

    delay: int
    passes: np.ndarray  # probability by sender and receiver, (M, M)
    rng: np.random.Generator
    has: dict[int, int] = field(default_factory=dict)  # tick at which each agent got the target
    follows: dict[int, int] = field(default_factory=dict)  # and from which on it follows it
    begins: dict[int, int] = field(default_factory=dict)  # first tick of its motion, as it knows it
    members: Sequence[int] = ()  # on the roster

    def run(
        self, ticks: int, since: Sequence[int] = (), deaths: Mapping[int, int] | None = None
    ) -> None:
        """Run some ticks; an agent whose `since` is later starts anew there, without what it had.

        By `deaths` an agent is off the roster from a tick on.
        """
        self.members = range(1, len(self.passes) + 1)
        since = since or (0,) * len(self.passes)
        agents = {agent: Unconfirmed(agent) for agent in self.members}
        decided: dict[int, Target] = {}
        sent: dict[int, list[tuple[int, Target]]] = {}
        for tick in range(TOLD, TOLD + ticks):
            for agent in [agent for agent in agents if (deaths or {}).get(agent) == tick]:
                del agents[agent]
                decided.pop(agent, None)
                self.follows.pop(agent, None)
                self.begins.pop(agent, None)
                self.members = [member for member in self.members if member != agent]
            for agent, start in enumerate(since, start=1):
                if start == tick and agent in agents:
                    agents[agent] = Unconfirmed(agent)
                    decided.pop(agent, None)
                    self.has.pop(agent, None)
                    self.follows.pop(agent, None)
            if tick == TOLD and 1 in agents:
                self._take(agents, decided, 1, TARGET, tick)
            for sender, target in sent.get(tick - self.delay, []):
                for receiver in agents:
                    is_heard = self.rng.random() < self.passes[sender - 1, receiver - 1]
                    # What was sent before a start is not for it.
                    if receiver != sender and is_heard and tick - self.delay >= since[receiver - 1]:
                        self._take(agents, decided, receiver, target, tick)

            began = {agent: start if tick >= start else 0 for agent, start in enumerate(since, 1)}
            for agent, unconfirmed in agents.items():
                for target in unconfirmed.confirmed(tick, self.members, began):
                    self._take(agents, decided, agent, target, tick)
            sent[tick] = [
                (agent, target)
                for agent, unconfirmed in agents.items()
                for target in ([decided[agent]] if agent in decided else unconfirmed.carried())
            ]

    def _take(
        self,
        agents: dict[int, Unconfirmed],
        decided: dict[int, Target],
        agent: int,
        target: Target,
        tick: int,
    ) -> None:
        self.has.setdefault(agent, tick)
        known = decided.get(agent)
        if not target.begins:
            if known is None:
                agents[agent].take(target, tick)
            return
        if known is not None and known.begins <= target.begins:
            return
        decided[agent] = target
        self.begins[agent] = target.begins
        self.follows.setdefault(agent, tick)
        # No agent follows it before all on the roster have it.
        assert self.has.keys() >= set(self.members)
        agents[agent].forget((target.tick, target.number))


def links(*pairs: tuple[int, int]) -> np.ndarray:
    """Return links that pass all between some agents, in both directions, and nothing else."""
    passes = np.zeros((M, M))
    for one, other in pairs:
        passes[one - 1, other - 1] = passes[other - 1, one - 1] = 1.0
    return passes


@pytest.mark.parametrize("delay", [1, 4])
def test_start_up_on_networks_without_loss(delay: int) -> None:
    """Fully meshed: all at 2 d, from d on. A chain of h hops: from h d on, and d later each hop back."""
    mesh = Team(delay, np.ones((M, M)), np.random.default_rng(0))
    mesh.run(10 * delay)
    assert mesh.follows == mesh.begins == dict.fromkeys(range(1, M + 1), TOLD + 2 * delay)

    chain = Team(delay, links((1, 2), (2, 3), (3, 4)), np.random.default_rng(0))
    chain.run(10 * delay)
    assert chain.follows == {agent: TOLD + (3 + 4 - agent) * delay for agent in range(1, 5)}
    assert chain.begins == dict.fromkeys(range(1, M + 1), TOLD + 3 * delay)


def test_no_agent_follows_what_another_has_not_heard_of() -> None:
    """On 300 random networks, a third of them cut: all end with the start of the first one, or none starts."""
    rng = np.random.default_rng(68)
    followed = 0
    for _ in range(300):
        passes = rng.random((M, M)) * (rng.random((M, M)) < 0.6)
        team = Team(int(rng.integers(1, 8)), passes, rng)
        team.run(400)
        # From each agent to each other one, over links that pass something.
        reaches = np.linalg.matrix_power((passes > 0.05) + np.eye(M), M) > 0.0
        if reaches.all():
            assert len(team.follows) == M
            assert set(team.begins.values()) == {min(team.follows.values())}
        followed += bool(team.follows)
    assert 30 < followed < 300


def test_an_agent_that_starts_anew_has_to_hear_it_anew() -> None:
    """What the others know of the process before it does not count: the target waits for the new one."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        delay = int(rng.integers(1, 6))
        passes = 0.3 * np.ones((M, M))
        restart = TOLD + int(rng.integers(1, 3 * delay))
        team = Team(delay, passes, rng)
        team.run(400, since=(0, 0, 0, restart))
        assert team.follows.keys() == set(range(1, M + 1))


def test_eight_agents_with_deaths_and_new_starts() -> None:
    """All that are left begin together, or none does: the one that was told may die right after it."""
    rng = np.random.default_rng(8)
    followed = 0
    for _ in range(100):
        passes = rng.uniform(0.1, 1.0, (8, 8))
        dead = [1, *(int(agent) for agent in rng.choice(range(2, 9), 2, replace=False))]
        team = Team(int(rng.integers(1, 6)), passes, rng)
        team.run(
            300,
            since=[int(start) for start in rng.choice([0, TOLD + 3, TOLD + 12], 8)],
            deaths={agent: TOLD + int(rng.integers(0, 15)) for agent in dead},
        )
        assert set(team.follows) in (set(), set(team.members))
        assert len(set(team.begins.values())) <= 1
        followed += bool(team.follows)
    assert 50 < followed < 100


def test_start_up_with_loss_is_at_most_that_of_messages_without_gossip() -> None:
    """The shares of starts within 2 d + m ticks, and within d + m of the first one, are at least (76b)."""
    loss, delay, runs = 0.5, 2, 400
    rng = np.random.default_rng(9)
    starts = []
    spreads = []
    for _ in range(runs):
        team = Team(delay, np.full((M, M), 1.0 - loss), rng)
        team.run(200)
        starts.append(team.follows[1] - TOLD)
        spreads.append(max(team.follows.values()) - min(team.follows.values()))
    for m in range(12):
        # The told agent hears from each other one that it has it: two geometric times in a row.
        one = 1.0 - loss ** (m + 1) * (1.0 + (m + 1) * (1.0 - loss))
        bound = max(0.0, 1.0 - (M - 1) * (1.0 - one))
        noise = 3.0 * np.sqrt(0.25 / runs)
        assert np.mean(np.array(starts) <= 2 * delay + m) >= bound - noise
        within = max(0.0, 1.0 - (M - 1) * loss ** (m + 1))
        assert np.mean(np.array(spreads) <= delay + m) >= within - noise
