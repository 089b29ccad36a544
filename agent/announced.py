"""What everybody has announced to do: received plans, shifted to any instant and held at their end."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from model.arrays import Array
from model.state import input_indices
from mpc.fail_safe import FailSafe
from mpc.settings import Limits
from protocol.wire.messages import Plan

# How a plan is laid along the horizon: shifted by its true age; by one tick, however old it is, as the paper has it; or
# its input for now, held.
Alignment = Literal["by_age", "by_one", "held"]

# Inputs of all UAVs by the shared control law, without corrections, at a tick and a state; None without such a law.
Law = Callable[[int, Array], Array | None]
# State at a tick of the past as it is estimated now, (n,); None where it is not known.
Past = Callable[[int], Array | None]

# Plans kept per agent: enough to know the inputs of the past over any delay worth flying with.
KEPT_PLANS = 256


class AnnouncedInputs:
    """The plans of all agents as one agent knows them.

    Args:
        owned: 0-based UAVs of agent 1, agent 2, ...
        u_hover: What a UAV is taken to do before its first plan arrives, (4 N,).
        fail_safe: What a UAV does after the last plan of an agent that is gone.
        alignment: How the others' plans are laid along the horizon.
        own: Agent whose plans are its own, so always laid by their age, 1-based; 0 for none.
        law: What the others do after the first step of a plan, besides its corrections.
        past: Estimates, for what that law gave at the first step of a plan.
        limits: Bounds of the actuators, which that law keeps to.

    Attributes:
        gone: Agents that make no more plans.
        law_since: Tick from which on the shared control law is the present team's.
        failed_since: Tick at which a UAV last failed: every agent knows and follows the control law of the UAVs that
            are left from then on, and what was announced before counts up to then.
    """

    def __init__(
        self,
        owned: Sequence[Sequence[int]],
        u_hover: Array,
        fail_safe: FailSafe | None = None,
        alignment: Alignment = "by_age",
        own: int = 0,
        law: Law = lambda _tick, _x: None,
        past: Past = lambda _tick: None,
        limits: Limits | None = None,
    ) -> None:
        self.gone: set[int] = set()
        self.law_since = 0
        self.failed_since = 0
        self._law, self._past = law, past
        uavs = sum(map(len, owned))
        self._bounds = None if limits is None else (limits.lower(uavs), limits.upper(uavs))
        self._alignment, self._own = alignment, own
        self._u_hover = u_hover
        self._owned, self._fail_safe = owned, fail_safe
        self._columns = {agent: input_indices(uavs) for agent, uavs in enumerate(owned, start=1)}
        # By agent, ascending in the tick they were made at; the end is what is asked for.
        self._plans: dict[int, list[Plan]] = {agent: [] for agent in self._columns}
        # Of agents that left without the others having their last plan: its start, and the inputs it is taken to hold.
        self._played_on: dict[int, tuple[int, Array]] = {}

    def add(self, plan: Plan) -> None:
        """Keep a plan, whatever order it arrives in; a second plan of the same tick is ignored."""
        plans = self._plans[plan.agent]
        at = bisect_left(plans, plan.tick, key=_made_at)
        if at == len(plans) or plans[at].tick != plan.tick:
            plans.insert(at, plan)
        if len(plans) > KEPT_PLANS:
            del plans[0]

    def forget(self, agent: int) -> None:
        """An agent starts anew: what it planned before does not count any more."""
        self._plans[agent].clear()
        self._played_on.pop(agent, None)

    def leave(self, agent: int, start: int, inputs: Array) -> None:
        """An agent has left, and its last plan is not here: what its actuators are taken to play on.

        Args:
            agent: 1-based.
            start: First instant of the inputs.
            inputs: Of all UAVs, (N_p, 4 N).
        Source: docs/equations.md (32b).
        """
        self._played_on[agent] = start, inputs[:, self._columns[agent]]

    def has(self, agent: int, tick: int) -> bool:
        """Whether the plan an agent made at a tick is here."""
        plans = self._plans[agent]
        at = bisect_left(plans, tick, key=_made_at)
        return at < len(plans) and plans[at].tick == tick

    def newest(self, agent: int, before: int) -> Plan | None:
        """The newest plan of an agent made before a tick."""
        return next((plan for plan in reversed(self._plans[agent]) if plan.tick < before), None)

    def sequence(self, start: int, steps: int, before: int) -> Array:
        """Announced inputs of all UAVs from a tick on, each newest plan laid along the horizon, held at its end.

        Of an agent that is gone, hover follows the end.

        Args:
            start: First instant.
            steps: N_p.
            before: Only plans made before this tick count: what arrived early must not be used early.
        Returns: (N_p, 4 N).
        Source: docs/equations.md (32); paper, section IV-A.
        """
        U = np.repeat(self._u_hover[None], steps, axis=0)
        for agent, columns in self._columns.items():
            played_on = self._played_on.get(agent)
            if played_on is not None:
                entries = played_on[1][max(start - played_on[0], 0) :][:steps]
                U[: len(entries), columns] = entries
                continue
            plan = self.newest(agent, before)
            if plan is not None:
                entries = self._entries(plan.inputs, plan, start, steps)
                U[: len(entries), columns] = entries
                if agent not in self.gone:  # after its end the actuators of those hold hover thrust
                    U[len(entries) :, columns] = plan.inputs[-1]
        return U

    def of_another_law(self, before: int) -> list[int]:
        """Agents whose newest plan is from before the shared law last changed, and who still follow it."""
        newest = {agent: self.newest(agent, before) for agent in self._columns if agent not in self.gone}
        return [
            agent
            for agent, plan in newest.items()
            if plan is not None and self.failed_since <= plan.tick < self.law_since
        ]

    def corrections(self, start: int, steps: int, before: int) -> Array:
        """Announced corrections to the shared law from a tick on, shifted, zero after their end.

        Args:
            start: First instant.
            steps: N_p.
            before: Only plans made before this tick count.
        Returns: (N_p, 4 N); zero where none were announced.
        Source: docs/equations.md (32).
        """
        c = np.zeros((steps, len(self._u_hover)))
        for agent, columns in self._columns.items():
            plan = self.newest(agent, before)
            if plan is not None and agent not in self.gone and plan.tick >= self.failed_since:
                entries = self._entries(plan.corrections, plan, start, steps)
                c[: len(entries), columns] = entries
        return c

    def at(self, tick: int, before: int, x: Array | None = None) -> Array:
        """Inputs taken to be in force over [t_k, t_{k+1}): of each agent's plans that had started, the newest.

        That plan's first input was applied as announced. Later ones have been replaced by plans that are not here:
        with a shared control law, the first one changed by what that law makes of the way of the state since, and of
        the corrections announced. What the sender takes for external forces cancels out of the difference.

        Args:
            tick: k.
            before: Only plans made before this tick count.
            x: State at t_k, (n,), if the law of the others and the fail-safe of those that are gone are to be part of
                it.
        Returns: (4 N,).
        Source: docs/equations.md (32), (32a).
        """
        u = self._u_hover.copy()
        for agent, columns in self._columns.items():
            plans = reversed(self._plans[agent])
            plan = next((p for p in plans if p.tick < before and p.start_tick <= tick), None)
            if plan is None:
                continue
            begun, inputs = plan.start_tick, plan.inputs
            if agent in self._played_on and tick >= self._played_on[agent][0]:
                begun, inputs = self._played_on[agent]
            step = tick - begun
            if agent in self.gone and step >= len(inputs):
                if x is not None and self._fail_safe is not None:
                    u[columns] = np.concatenate([self._fail_safe.inputs(uav, x) for uav in self._owned[agent - 1]])
                continue
            u[columns] = inputs[min(step, len(inputs) - 1)]
            replaced = step > 0 and agent != self._own and agent not in self.gone
            if plan.tick < self.failed_since:
                replaced = replaced and tick >= self.failed_since
            else:
                replaced = replaced and plan.tick >= self.law_since
            if replaced and x is not None:
                by_law = self._by_law(plan, tick, x)
                if by_law is not None:
                    u[columns] = by_law[columns]
        return u if self._bounds is None else np.clip(u, *self._bounds)

    def _by_law(self, plan: Plan, tick: int, x: Array) -> Array | None:
        """Inputs of an agent by the shared control law some steps after the first one of a plan of its.

        Args:
            plan: Of the agent.
            tick: Now.
            x: State now, (n,).
        Returns: (4 N,), of which the plan's columns have a meaning; None where there is no such law.
        Source: docs/equations.md (32a).
        """
        u = self._law(tick, x)
        if u is None or plan.tick < self.failed_since or not len(plan.corrections):
            return u
        u, columns, step = u.copy(), self._columns[plan.agent], tick - plan.start_tick
        if step < len(plan.corrections):
            u[columns] += plan.corrections[step]
        began = self._past(plan.start_tick)
        then = None if began is None else self._law(plan.start_tick, began)
        if then is not None:
            # What the sender knew otherwise, such as external forces, shows at the first step.
            u[columns] += plan.inputs[0] - then[columns] - plan.corrections[0]
        return u

    def _entries(self, sequence: Array, plan: Plan, start: int, steps: int) -> Array:
        """What of a plan's inputs or corrections is taken for the steps of the horizon, as far as it goes."""
        skipped = start - plan.start_tick
        if self._alignment == "by_age" or plan.agent == self._own or plan.agent in self.gone:
            return sequence[max(skipped, 0) :][:steps]
        if self._alignment == "held":
            return np.repeat(sequence[max(skipped, 0) :][:1], steps, axis=0)
        return sequence[max(min(skipped, 1), 0) :][:steps]


def _made_at(plan: Plan) -> int:
    return plan.tick
